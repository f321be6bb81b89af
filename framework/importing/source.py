"""What an importer reads: frames as a device stored them, depth often coarser than colour."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Camera, Float32, Float64, UInt8
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import CameraAxes, PoseReading
from framework.errors import FrameError, errors_of
from framework.geometry import nearest_rigid

SMALLEST_SIDE = 2  # px, of a depth image that can be brought to another size
UNSURE, FAIRLY_SURE, SURE = 0, 1, 2  # confidence, as ARKit's low, medium and high

_ARKIT = PoseReading(camera_axes=CameraAxes.OPENGL)


@dataclass(frozen=True)
class DeviceFrame:
    """One frame as it was stored. Raises FrameError when its parts do not fit."""

    name: Path | str  # of what it was read from, for messages
    timestamp: float  # s
    camera: Camera  # of the colour image
    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (h, w) m along z, 0 = no reading; of the same field of view as colour
    confidence: UInt8 | None = None  # (h, w), UNSURE to SURE, of the depth; None = not told
    T_world_camera: Float64 | None = None  # (4, 4), None = not known
    up: Float64 | None = None  # (3,) unit vector against gravity in the camera, by a sensor; None = none tells

    def __post_init__(self) -> None:
        if not np.isfinite(self.timestamp):
            raise FrameError(f"{self.name}: the timestamp is not finite")
        if self.color.shape[:2] != self.camera.shape:
            found = f"{self.color.shape[1]}x{self.color.shape[0]}"
            raise FrameError(
                f"{self.name}: colour is {found}, the camera's is {self.camera.width}x{self.camera.height}"
            )
        if min(self.depth.shape) < SMALLEST_SIDE:
            raise FrameError(f"{self.name}: depth is {self.depth.shape[1]}x{self.depth.shape[0]} px, too small")
        if self.confidence is not None and self.confidence.shape != self.depth.shape:
            raise FrameError(f"{self.name}: confidence has the shape {self.confidence.shape}, depth {self.depth.shape}")


StoredFrame = Callable[[], DeviceFrame]  # reads a frame; raises DataError when that one cannot be used


@dataclass(frozen=True)
class Source:
    """A recording that can be imported. Its frames are to be read in their order, and may be left out."""

    format: str  # for the person
    frames: Iterable[StoredFrame]  # in order of time
    count: int  # of the frames
    posed: bool  # whether poses come with it; a frame without one is then left out
    distortion: Distortion | None = None  # of the lens, in colour and depth alike; None = a pinhole


def arkit_pose(where: Path | str, T_world_arkit: Float64) -> Float64:
    """T_world_camera (4, 4) of a pose of ARKit's camera, with y up and z backward. Raises DataError, naming `where`."""
    with errors_of(where):
        return _ARKIT.pose(nearest_rigid(T_world_arkit))


def arkit_up(T_world_camera: Float64) -> Float64:
    """(3,) up in the camera, by a pose in ARKit's own world: its y is against gravity as motion sensors tell it.

    That is ARConfiguration.WorldAlignment.gravity, which is the default.
    """
    return np.array(T_world_camera[1, :3])


def metres(raw: np.typing.NDArray[np.uint16]) -> Float32:
    """(h, w) m of stored millimetres; 65535, which several sensors write for no reading, becomes 0."""
    return np.where(raw == np.iinfo(np.uint16).max, 0, raw).astype(np.float32) / np.float32(1000)


def readings(depth: np.typing.NDArray[np.floating]) -> Float32:
    """Stored metres (h, w) as float32, what is no positive finite number as 0."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
