"""Copies of real recordings in which one convention differs from the format."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.datasets.frames.sequence_reader import Recording
from framework.files.tum_trajectory import write_tum

IDENTITY = np.eye(4)


def write_damaged(
    place: Path,
    sound: Recording,
    pose: Callable[[Float64], Float64] = lambda T: T,
    scale: float = 1.0,
    depth_late: int = 0,
    poses_late: int = 0,
    frames: int = 10_000,
) -> Path:
    """Write an RGB-D folder with wrong poses, depth scale or delays.

    Args:
        place: Folder to write.
        sound: Valid recording; the written images are links to its files.
        pose: Function that converts each stored pose (4, 4).
        scale: Factor of the depth scale.
        depth_late: Delay of the depth images, in frames.
        poses_late: Delay of the poses, in frames.
        frames: Maximum number of frames.
    """
    recorded = sound.contents.frames[:frames]
    usable = range(max(depth_late, poses_late, 0), len(recorded) + min(depth_late, poses_late, 0))
    for name in ("color", "depth"):
        (place / name).mkdir(parents=True)
    for k in usable:
        images, other = recorded[k].images, recorded[k - depth_late].images
        for folder, path in (("color", Path(images.color_name)), ("depth", Path(other.depth_name))):
            (place / folder / f"{k:06d}{path.suffix}").symlink_to(path.resolve())
    camera = sound.camera
    content = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    content["depth_scale"] = sound.contents.depth_scale * scale
    if sound.contents.distortion is not None:
        content["distortion"] = list(astuple(sound.contents.distortion))
    (place / "camera.json").write_text(json.dumps(content))
    poses = [recorded[k - poses_late].T_world_camera for k in usable]
    known = [IDENTITY if T is None else T for T in poses]
    write_tum(place / "poses.txt", [recorded[k].timestamp for k in usable], [pose(T) for T in known])
    return place
