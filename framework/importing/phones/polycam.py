"""Import of raw data from Polycam (developer mode, https://github.com/PolyCam/polyform).

    keyframes/images/1442008525605.jpg          8-bit color in sensor orientation; named by timestamp (microseconds)
    keyframes/cameras/1442008525605.json        fx, fy, cx, cy, width, height and t_00 ... t_23: ARKit's T_world_camera
    keyframes/corrected_cameras/, corrected_images/     same content with optimized poses, undistorted; missing if the
                                                        session was too long
    keyframes/depth/1442008525605.png           uint16 mm, 256x192; corrected_depth/ belongs to corrected_images/
    keyframes/confidence/1442008525605.png      uint8: 0 low, 255 high, other values medium (127 as documented, 54 in
                                                exports)

Corrected files are preferred. Optimized poses have another world frame than recorded poses, so they are used only if
all frames have one. The up direction is taken from the recorded poses, because the y axis of optimized poses is
undocumented.
"""

from __future__ import annotations

import logging
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Float64
from framework.datasets.calibration.camera_json import numbers_of, pinhole, read_json_object
from framework.errors import DataError
from framework.files.image_files import read_color, read_uint8, read_uint16
from framework.importing.source import DeviceFrame, Format, Source, arkit_pose, arkit_up, meters
from framework.sensors.noise_models import SensorKind

log = logging.getLogger(__name__)

MICROSECONDS = 1e6  # per second
LEVELS = (1, 255)  # minimum values of medium and high confidence
ROWS = [f"t_{row}{column}" for row in range(3) for column in range(4)]


def keyframes(path: Path) -> Path:
    """Return the folder with the keyframes."""
    return path / "keyframes" if (path / "keyframes").is_dir() else path


def recognized(path: Path) -> bool:
    """Return True if the path is a recording of Polycam."""
    return (keyframes(path) / "cameras").is_dir() and (keyframes(path) / "images").is_dir()


def open_source(path: Path) -> Source:
    """Open a recording.

    Raises:
        DataError: Depth images or camera files are missing.
    """
    folder = keyframes(path)
    stems = [entry.stem for entry in (folder / "cameras").glob("*.json")]
    stems = sorted((stem for stem in stems if re.fullmatch("[0-9]{1,18}", stem)), key=int)
    if not (folder / "depth").is_dir() or not stems:
        expected = "expected camera files in cameras/ and a folder depth/"
        found = "got no folder depth/" if stems else "got no camera files"
        raise DataError(
            f"{path}: {expected}, {found}; record with a LiDAR device, and export with Polycam's developer mode on"
        )
    optimized = [stem for stem in stems if (folder / f"corrected_cameras/{stem}.json").exists()]
    if 0 < len(optimized) < len(stems):
        log.warning(
            "%s: corrected_cameras/ has poses for only %d of %d frames; using the poses of cameras/ for all frames, "
            "because the two have different world frames",
            path, len(optimized), len(stems),
        )  # fmt: skip
    pose_folder = "corrected_cameras" if len(optimized) == len(stems) else "cameras"
    frames = [partial(_read, folder, stem, pose_folder) for stem in stems]
    return Source("Polycam", frames, len(frames), posed=True, sensor=SensorKind.PHONE_LIDAR)


def _read(folder: Path, stem: str, pose_folder: str) -> DeviceFrame:
    undistorted = (folder / f"corrected_images/{stem}.jpg").exists()
    color = read_color(folder / f"{'corrected_images' if undistorted else 'images'}/{stem}.jpg")
    corrected, as_recorded = folder / f"corrected_cameras/{stem}.json", folder / f"cameras/{stem}.json"
    posed = folder / f"{pose_folder}/{stem}.json"
    camera = corrected if undistorted and corrected.exists() else as_recorded
    corrected_depth = folder / f"corrected_depth/{stem}.png"
    depth = corrected_depth if undistorted and corrected_depth.exists() else folder / f"depth/{stem}.png"
    confidence = folder / f"confidence/{stem}.png"
    contents = {path: read_json_object(path) for path in {posed, camera, as_recorded}}
    height, width = color.shape[:2]
    return DeviceFrame(
        name=depth,
        timestamp=int(stem) / MICROSECONDS,
        camera=pinhole(camera, width, height, *numbers_of(camera, contents[camera], "fx", "fy", "cx", "cy")),
        color=color,
        depth=meters(read_uint16(depth)),
        confidence=np.digitize(read_uint8(confidence), LEVELS).astype(np.uint8) if confidence.exists() else None,
        T_world_camera=_pose(posed, contents[posed]),
        up=arkit_up(_pose(as_recorded, contents[as_recorded])),
    )


def _pose(path: Path, content: dict[str, Any]) -> Float64:
    """Return the pose T_world_camera (4, 4) in a camera file."""
    rows = np.reshape(numbers_of(path, content, *ROWS), (3, 4))
    return arkit_pose(path, np.vstack([rows, [[0, 0, 0, 1]]]))


FORMAT = Format("polycam", "a folder with keyframes/, exported from Polycam as raw data", recognized, open_source)
