"""Recordings of phones and sensors for import."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from framework.data import Camera, Float32, Float64, UInt8
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import CameraAxes, PoseReading
from framework.errors import FrameError, errors_of
from framework.geometry import nearest_rigid
from framework.sensors.noise_models import SensorKind

SMALLEST_SIDE = 2  # px, minimum side of a depth image for resampling
UNSURE, SURE = 0, 2  # ARKit's low and high confidence; 1 = medium

log = logging.getLogger(__name__)

_ARKIT = PoseReading(camera_axes=CameraAxes.OPENGL)


@dataclass(frozen=True)
class DeviceFrame:
    """One frame of a recording.

    Depth may have a lower resolution than color.

    Raises:
        FrameError: The images are inconsistent.
    """

    name: Path | str  # file of the frame, for messages
    timestamp: float  # s
    camera: Camera  # of the color image
    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (h, w) m along z, 0 = no reading; same field of view as color
    confidence: UInt8 | None = None  # (h, w), of the depth, from UNSURE to SURE; None = unknown
    T_world_camera: Float64 | None = None  # (4, 4), None = unknown
    up: Float64 | None = None  # (3,) unit up vector in the camera frame, from a sensor; None = unknown
    depth_timestamp: float | None = None  # s, of the depth image; None = `timestamp`

    def __post_init__(self) -> None:
        if not np.isfinite(self.timestamp):
            raise FrameError(f"{self.name}: expected a finite timestamp, got {self.timestamp}")
        if self.color.shape[:2] != self.camera.shape:
            found, expected = (f"{width}x{height}" for height, width in (self.color.shape[:2], self.camera.shape))
            raise FrameError(f"{self.name}: expected color of {expected} px as in the camera, got {found} px")
        if min(self.depth.shape) < SMALLEST_SIDE:
            expected = f"expected depth of at least {SMALLEST_SIDE}x{SMALLEST_SIDE} px"
            raise FrameError(f"{self.name}: {expected}, got {self.depth.shape[1]}x{self.depth.shape[0]} px")
        if self.confidence is not None and self.confidence.shape != self.depth.shape:
            expected = f"expected confidence of shape {self.depth.shape} as for depth"
            raise FrameError(f"{self.name}: {expected}, got {self.confidence.shape}")


@dataclass(frozen=True)
class StoredOdometry:
    """Odometry of a recording, at its own rate."""

    timestamps: Float64  # (L,) s, increasing
    poses: Sequence[Float64]  # T_odom_camera (4, 4), or T_odom_base if not `of_camera`
    of_camera: bool


StoredFrame = Callable[[], DeviceFrame]  # reads a frame; raises DataError if the frame is unusable


@dataclass(frozen=True)
class Source:
    """A recording for import.

    Frames must be read in order, but may be skipped.
    """

    format: str  # name for messages
    frames: Iterable[StoredFrame]  # in chronological order
    count: int  # number of frames
    posed: bool  # True if the recording has poses; frames without a pose are then skipped
    distortion: Distortion | None = None  # lens distortion of color and depth; None = pinhole camera
    sensor: SensorKind | None = None  # kind of the depth sensor; None = unknown
    odometry: StoredOdometry | None = None  # None = none
    path: Path | None = None  # file or folder of the recording; None = unknown


@dataclass(frozen=True)
class Format:
    """A recording format."""

    name: str  # for the command line
    needs: str  # characteristic files, for messages
    recognized: Callable[[Path], bool]  # True for a recording in this format
    open: Callable[..., Source]  # parameters: path, and topics and options if has_topics; raises DataError
    has_topics: bool = False  # True if `open` has the parameters topics and options


def warn_of_zeros(where: Path | str) -> None:
    """Log that all poses of a recording contain only zeros, which means that they are unknown."""
    log.warning("%s: expected camera poses, got only zeros; imported without poses", where)


def without_poses(source: Source) -> Source:
    """Return a recording without its poses. Up directions are kept."""

    def read(stored: StoredFrame) -> DeviceFrame:
        return replace(stored(), T_world_camera=None)

    return replace(source, frames=(partial(read, stored) for stored in source.frames), posed=False)


def arkit_pose(where: Path | str, T_world_arkit: Float64) -> Float64:
    """Convert a pose (4, 4) from ARKit's camera axes to T_world_camera (4, 4).

    Raises:
        DataError: The pose is invalid. The message contains `where`.
    """
    with errors_of(where):
        return _ARKIT.pose(nearest_rigid(T_world_arkit))


def arkit_up(T_world_camera: Float64) -> Float64:
    """Return the up direction (3,) in the camera frame for a pose (4, 4) in ARKit's world frame."""
    # the y axis points against gravity with the default ARConfiguration.WorldAlignment.gravity
    return np.array(T_world_camera[1, :3])


def meters(raw: NDArray[np.uint16], units_per_meter: float = 1000.0) -> Float32:
    """Convert stored depth (h, w) to m."""
    # some sensors write 65535 for pixels without a reading
    return np.where(raw == np.iinfo(np.uint16).max, 0, raw).astype(np.float32) / np.float32(units_per_meter)


def readings(depth: NDArray[np.floating]) -> Float32:
    """Convert depth (h, w), m, to float32 and replace invalid values with 0."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
