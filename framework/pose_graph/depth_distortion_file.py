"""The correction of depth of a run: depth_distortion.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from framework.errors import DataError
from framework.files.json_file import read_json, write_json
from framework.files.manifest import verified
from framework.sensors.depth_distortion import NODES, DepthDistortion

MAX_CORRECTION = 1.0  # 1/m, maximum absolute correction in a file


def write_depth_distortion(path: Path, distortion: DepthDistortion) -> None:
    """Write a correction of depth."""
    height, width = distortion.shape
    write_json(path, {"width": width, "height": height, "corrections_per_m": distortion.nodes.tolist()})


def read_depth_distortion(path: Path) -> DepthDistortion | None:
    """Read a correction of depth; None = the file does not exist, because depth was not corrected.

    Raises:
        DataError: The file is invalid.
    """
    if not path.exists():
        return None
    with verified(path):
        content = read_json(path)
    try:
        nodes = np.array(content["corrections_per_m"], np.float64)
        shape = int(content["height"]), int(content["width"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: expected width, height and corrections_per_m, got an error ({error})") from error
    if nodes.shape != NODES or min(shape) < 1 or not (np.abs(nodes) <= MAX_CORRECTION).all():
        raise DataError(
            f"{path}: expected {NODES[0]} x {NODES[1]} corrections of at most {MAX_CORRECTION:g} 1/m and a positive "
            f"image size, got shape {nodes.shape} and size {shape}"
        )
    return DepthDistortion(nodes, shape)
