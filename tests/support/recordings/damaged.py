"""Copies of real recordings in which one convention differs from the format."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Float64
from framework.datasets.frames.conventions import CameraAxes
from framework.datasets.frames.sequence_reader import Recording
from framework.files.tum_trajectory import write_tum
from framework.geometry import inverse

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


def in_axes(axes: CameraAxes) -> Callable[[Float64], Float64]:
    """Return a function that converts a camera pose to other camera axes."""
    T_axes_camera = np.eye(4)
    T_axes_camera[:3, :3] = axes.R_axes_camera
    return lambda T_world_camera: T_world_camera @ inverse(T_axes_camera)


def scalar_first(T: Float64) -> Float64:
    """Return the pose that results if a quaternion in the order w x y z is read as x y z w."""
    misread = T.copy()
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    misread[:3, :3] = Rotation.from_quat((w, x, y, z)).as_matrix()
    return misread


def in_millimeters(T: Float64) -> Float64:
    moved = T.copy()
    moved[:3, 3] *= 1000
    return moved


def inverted_opengl(T: Float64) -> Float64:
    return inverse(in_axes(CameraAxes.OPENGL)(T))
