"""Recordings of devices that can be imported: frames as stored, depth often coarser than color."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from framework.data import Camera, Float32, Float64, UInt8
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import CameraAxes, PoseReading
from framework.errors import FrameError, errors_of
from framework.geometry import nearest_rigid

SMALLEST_SIDE = 2  # px, of a depth image that can be resampled
UNSURE, FAIRLY_SURE, SURE = 0, 1, 2  # confidence, as ARKit's low, medium and high

_ARKIT = PoseReading(camera_axes=CameraAxes.OPENGL)


@dataclass(frozen=True)
class DeviceFrame:
    """One frame as it was stored. Raises FrameError if its parts do not fit."""

    name: Path | str  # its file, for messages
    timestamp: float  # s
    camera: Camera  # of the color image
    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (h, w) m along z, 0 = no reading; with the field of view of color
    confidence: UInt8 | None = None  # (h, w), UNSURE to SURE, of the depth; None = not known
    T_world_camera: Float64 | None = None  # (4, 4), None = not known
    up: Float64 | None = None  # (3,) unit vector against gravity in the camera, from a sensor; None = not known

    def __post_init__(self) -> None:
        if not np.isfinite(self.timestamp):
            raise FrameError(f"{self.name}: the timestamp is not finite")
        if self.color.shape[:2] != self.camera.shape:
            found, expected = (f"{width}x{height}" for height, width in (self.color.shape[:2], self.camera.shape))
            raise FrameError(f"{self.name}: color is {found}, the camera's is {expected}")
        if min(self.depth.shape) < SMALLEST_SIDE:
            raise FrameError(f"{self.name}: depth is {self.depth.shape[1]}x{self.depth.shape[0]} px, too small")
        if self.confidence is not None and self.confidence.shape != self.depth.shape:
            raise FrameError(f"{self.name}: confidence has the shape {self.confidence.shape}, depth {self.depth.shape}")


StoredFrame = Callable[[], DeviceFrame]  # reads a frame; raises DataError if it cannot be used


@dataclass(frozen=True)
class Source:
    """A recording that can be imported. Its frames must be read in order, and may be skipped."""

    format: str  # for the user
    frames: Iterable[StoredFrame]  # in order of time
    count: int  # of the frames
    posed: bool  # it has poses; a frame without one is skipped then
    distortion: Distortion | None = None  # of the lens, in color and depth alike; None = a pinhole


@dataclass(frozen=True)
class Format:
    """A format of recordings."""

    name: str  # for the command line
    needs: str  # what identifies it, for the user
    recognized: Callable[[Path], bool]  # True for a recording in this format
    open: Callable[..., Source]  # of the path, and of the topics if it has some; raises DataError, with the file
    has_topics: bool = False


def arkit_pose(where: Path | str, T_world_arkit: Float64) -> Float64:
    """Return T_world_camera (4, 4) of a pose with ARKit's camera axes. Raises DataError, with `where`."""
    with errors_of(where):
        return _ARKIT.pose(nearest_rigid(T_world_arkit))


def arkit_up(T_world_camera: Float64) -> Float64:
    """Return up (3,) in the camera of a pose in ARKit's world, whose y axis is against gravity.

    This is ARConfiguration.WorldAlignment.gravity, the default.
    """
    return np.array(T_world_camera[1, :3])


def meters(raw: NDArray[np.uint16]) -> Float32:
    """Return depth (h, w) in m of stored millimeters, with 0 for 65535, which several sensors write for no reading."""
    return np.where(raw == np.iinfo(np.uint16).max, 0, raw).astype(np.float32) / np.float32(1000)


def readings(depth: NDArray[np.floating]) -> Float32:
    """Return stored meters (h, w) as float32, with 0 for values that are not positive and finite."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
