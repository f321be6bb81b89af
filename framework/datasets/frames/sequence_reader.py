"""Base class of dataset readers."""

from __future__ import annotations

import logging
import math
import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from framework.config.validation import require
from framework.data import (
    Camera,
    Float32,
    Float64,
    Frame,
    FrameTruth,
    ReferenceTrajectory,
    SceneTruth,
    UInt8,
    UInt16,
)
from framework.datasets.calibration.raw_images import Calibration, check_max_depth
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import (
    AUTO,
    LONGEST_COLOR_DELAY,
    DepthReading,
    PoseReading,
    check_depth_scale,
    color_delay_of,
)
from framework.datasets.frames.odometry import KEY as ODOMETRY_KEY
from framework.datasets.frames.odometry import Odometry, OdometryFile
from framework.datasets.frames.world_offset import as_setting, world_offset_of
from framework.datasets.ground_truth.labeled_mesh import unseen
from framework.datasets.ground_truth.named_truth import KEY, NamedTruth, read_named_truth
from framework.errors import ConfigError, DataError, FrameError
from framework.files.depth_files import read_depth
from framework.files.folders.restartable_folder import check_finished
from framework.files.image_files import read_color
from framework.files.search_paths import folder_of
from framework.files.storage import check_storage
from framework.geometry import FARTHEST
from framework.interfaces import RGBDSequence
from framework.sensors.noise_models import SensorChoice, SensorKind

FRAME_RATE = 30.0  # Hz, for recordings without valid timestamps

TO_THE_END = -1  # value of `stop` for the end of the sequence
_STREAM = zlib.crc32(b"share")  # separates this random stream from others with the same seed

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredImages:
    """The color and depth images of a frame, read on demand.

    The images are registered to each other. Reading them can raise FrameError.
    """

    color_name: Path | str  # file, and position in the file, for messages
    depth_name: Path | str
    color: Callable[[], UInt8]  # (H, W, 3) RGB
    depth: Callable[[], UInt16 | Float32]  # (H, W) in depth units of the recording; no reading = 0, 65535 or no number

    @classmethod
    def of_files(cls, color: Path, depth: Path) -> StoredImages:
        """Return the images in a JPEG or PNG file and a depth file."""
        return cls(color, depth, partial(read_color, color), partial(read_depth, depth))

    @property
    def image_name(self) -> str:
        """File name of the color image, "" for an image without a file of its own."""
        return self.color_name.name if isinstance(self.color_name, Path) else ""


@dataclass(frozen=True)
class RecordedFrame:
    """One frame of a recording, with images that are read on demand."""

    images: StoredImages
    timestamp: float  # s
    T_world_camera: Float64 | None = None  # (4, 4), None = unknown
    error: str = ""  # reason why the frame is unusable; "" = usable
    up: Float64 | None = None  # (3,) unit up vector in the camera frame, from a sensor; None = unknown
    color_timestamp: float | None = None  # s, of the color image; None = `timestamp`
    depth_timestamp: float | None = None  # s, of the depth image; None = `timestamp`

    @property
    def depth_time(self) -> float:
        """Timestamp of the depth image, s."""
        return self.timestamp if self.depth_timestamp is None else self.depth_timestamp

    @classmethod
    def posed(cls, images: StoredImages, timestamp: float, pose: Callable[[], Float64 | None]) -> RecordedFrame:
        """Return a frame with the pose that `pose` returns.

        If `pose` raises DataError, the frame is unusable and contains the error message.
        """
        try:
            return cls(images, timestamp, pose())
        except DataError as error:
            check_storage(error)
            return cls(images, timestamp, error=str(error))


@dataclass(frozen=True)
class Contents:
    """All frames of a recording and their calibration."""

    camera: Camera
    camera_source: Path | str  # file or parameter with the camera, for messages
    depth_scale: float  # units per meter
    frames: Sequence[RecordedFrame]
    distortion: Distortion | None = None  # lens distortion of color and depth; None = pinhole camera
    sensor: SensorKind = SensorKind.KINECT_V1  # kind of the depth sensor


@dataclass
class Recording(RGBDSequence):
    """An RGB-D video on disk.

    A subclass implements `open`, which lists all frames. This class selects frames and reads their images. If
    `ground_truth` is set, its mesh replaces the ground truth of the recording.

    Opening an invalid recording raises DataError. Reading an invalid frame raises FrameError, and the pipeline skips
    the frame. If the storage is no longer available, reading raises StorageError, which ends the run.
    """

    root: Path  # folder of the recording or of the scenes, relative to the working or project directory
    scene: str = ""  # subfolder of root; "" = root itself
    start: int = 0  # index of the first frame
    stop: int = TO_THE_END  # index of the first frame after the selection, >= 0; -1 = end of the sequence
    stride: int = 1  # step between selected frames, in frames, >= 1; 1 = every frame
    frame_fraction: float = 1.0  # randomly selected fraction of the frames, in (0, 1]; 1 = all frames
    seed: int = 0  # seed of the random frame selection, >= 0
    max_depth: float = 10.0  # maximum depth, m, >= 0; farther readings are dropped; 0 = unlimited
    # ground truth for the evaluation: labeled mesh (PLY with instances.json) or run directory; None = ground truth of
    # the recording
    ground_truth: Path | None = None
    time_unit: float = 1.0  # length of one unit of the stored timestamps, s, in [1e-9, 1]; 1e-9 = nanoseconds
    # depth sensor, which selects the noise model: AUTO (from the recording, else KINECT_V1), EXACT (rendered depth),
    # KINECT_V1, REALSENSE_D435, TIME_OF_FLIGHT or PHONE_LIDAR
    sensor: SensorChoice = SensorChoice.AUTO
    pose_reading: PoseReading = field(default_factory=PoseReading)
    depth_reading: DepthReading = field(default_factory=DepthReading)
    # delay of color relative to depth at equal timestamps, s, in [-0.2, 0.2]; positive = color captured later; AUTO =
    # estimated during the run, 0 until then
    color_delay: str = AUTO
    # origin of the mapped world frame, "x y z" in the world frame of the poses, m; subtracted from all poses; AUTO = 0,
    # or a multiple of 1000 m near the cameras if they are farther than 10 km
    world_offset: str = AUTO
    odometry_file: OdometryFile = field(default_factory=OdometryFile)

    def __post_init__(self) -> None:
        check_selection(self.start, self.stop, self.stride, self.frame_fraction)
        check_max_depth(self.max_depth)
        require(1e-9 <= self.time_unit <= 1, "dataset.time_unit", self.time_unit, "a value in [1e-9, 1] s")
        color_delay_of(self.color_delay)
        self.root = folder_of(Path(self.root))
        self.folder = self.root / self.scene
        if not self.folder.is_dir():
            project = "" if self.root.is_absolute() else ", found in neither the working nor the project directory"
            raise DataError(f"dataset.root: expected an existing folder, got {self.folder}{project}")
        check_finished(self.folder)
        self.name = self.folder.resolve().name
        self.named_truth = None if self.ground_truth is None else read_named_truth(Path(self.ground_truth))
        stored = self.open()
        timed = [_in_seconds(frame, self.time_unit) for frame in stored.frames]
        depth_scale = self.depth_reading.depth_scale or stored.depth_scale
        check_depth_scale(f"{stored.camera_source}: depth scale", depth_scale)
        posed = self._posed_frames(delay_poses(timed, self.pose_reading.pose_delay))
        ordered = _in_order_of_time(self.name, _with_plausible_image_times(self.name, posed))
        frames = delay_depth(ordered, self.depth_reading.depth_delay)
        self.contents = replace(stored, frames=frames, depth_scale=depth_scale)
        self.camera = stored.camera
        self.sensor_kind = self.sensor.kind(stored.sensor)
        self.calibration = Calibration(
            self.camera, stored.camera_source, depth_scale, self.max_depth, stored.distortion
        )
        self.chosen = choose_frames(len(frames), self.start, self.stop, self.stride, self.frame_fraction, self.seed)
        self._check_first_image()
        self.odometry = self.odometry_file.read()
        if self.odometry is not None:
            self._check_odometry(self.odometry)
        if self.ground_truth is not None and any(self.world_origin):
            self.named_truth = read_named_truth(Path(self.ground_truth), self.world_origin)
        if self.named_truth is not None:
            self.annotation = self.named_truth.name
            self._check_truth_poses(self.named_truth)

    def _posed_frames(self, frames: Sequence[RecordedFrame]) -> list[RecordedFrame]:
        """Return the frames with poses in the default convention, relative to the world offset."""
        converted = [_converted(frame, self.pose_reading) for frame in frames]
        poses = [one.T_world_camera for one in converted if one.T_world_camera is not None]
        positions = np.array([T[:3, 3] for T in poses]).reshape(-1, 3)
        offset = world_offset_of(self.world_offset, positions)
        self.world_origin = tuple(offset.tolist())
        if offset.any():
            log.info("%s: all coordinates are relative to %s", self.name, as_setting(offset))
        return [_relative(frame, offset) for frame in converted]

    @abstractmethod
    def open(self) -> Contents:
        """Return the contents of `self.folder`.

        Raises:
            DataError: A file is missing or invalid.
        """

    def truth_in(self, index: int) -> FrameTruth | None:
        """Return the recording's own ground-truth instances in a frame, or None if unknown.

        Args:
            index: The index of the frame in the recording.
        """
        return None

    def constant_color_delay(self) -> float | None:
        return color_delay_of(self.color_delay)

    def own_scene_truth(self) -> SceneTruth | None:
        """Return the recording's own ground-truth instances, or None without an annotation."""
        return None

    def scene_truth(self) -> SceneTruth | None:
        """Return the ground-truth instances and a trajectory in the same world frame.

        The result is None without an annotation or without poses.
        """
        named = self.named_truth
        truth = self.own_scene_truth() if named is None else named.mesh.scene_truth()
        if truth is None:
            return None
        trajectory = self._given_trajectory() if named is None or named.trajectory is None else named.trajectory
        if not len(trajectory.timestamps):
            expected = "expected given poses in the world frame of the ground truth, got none"
            log.warning("%s: %s; instances not evaluated", self.name, expected)
            return None
        return replace(truth, trajectory=trajectory)

    def __len__(self) -> int:
        return len(self.chosen)

    def has_poses(self) -> bool:
        frames = [self.contents.frames[index] for index in self.chosen]
        # frames with an invalid pose count; their error is raised when they are read
        return any(recorded.T_world_camera is not None or recorded.error for recorded in frames)

    def __getitem__(self, k: int) -> Frame:
        index = self.chosen[k]
        recorded = self.contents.frames[index]
        if recorded.error:
            raise FrameError(f"frame {index}: {recorded.error}")
        try:
            return self._read_frame(index, recorded)
        except FrameError as error:
            check_storage(error, self.folder)
            raise

    def _read_frame(self, index: int, recorded: RecordedFrame) -> Frame:
        return Frame(
            index=index,
            timestamp=recorded.timestamp,
            color=self.calibration.color(recorded.images.color(), recorded.images.color_name),
            depth=self.metric_depth(index),
            camera=self.camera,
            T_world_camera=recorded.T_world_camera,
            truth=self._frame_truth(index),
            up=recorded.up,
            color_timestamp=recorded.color_timestamp,
            depth_timestamp=recorded.depth_timestamp,
            sensor=self.sensor_kind,
            T_odom_camera=None if self.odometry is None else self.odometry.at(recorded.depth_time),
            image_name=recorded.images.image_name,
        )

    def image_names(self) -> Mapping[int, str]:
        return {k: recorded.images.image_name for k, recorded in enumerate(self.contents.frames)}

    def metric_depth(self, index: int) -> Float32:
        """Return the depth (H, W), m, of a frame, 0 = no reading.

        Args:
            index: The index of the frame in the recording.

        Raises:
            FrameError: The image cannot be read or has the wrong size.
        """
        images = self.contents.frames[index].images
        return self.calibration.depth(images.depth(), images.depth_name)

    def _frame_truth(self, index: int) -> FrameTruth | None:
        if self.named_truth is None:
            return self.truth_in(index)
        recorded = self.contents.frames[index]
        T_world_camera = self.named_truth.pose(recorded.timestamp, recorded.T_world_camera)
        if T_world_camera is None:
            return unseen(self.camera, f"frame {index}: expected a pose to render ground-truth instances, got none")
        return self.named_truth.mesh.seen_by(self.camera, T_world_camera)

    def _given_trajectory(self) -> ReferenceTrajectory:
        posed = [one for one in self.contents.frames if one.T_world_camera is not None and not one.error]
        times = np.array([one.timestamp for one in posed], np.float64)
        return ReferenceTrajectory(times, np.array([one.T_world_camera for one in posed]).reshape(-1, 4, 4), given=True)

    def _check_truth_poses(self, named: NamedTruth) -> None:
        """Raise ConfigError if no selected frame has a pose in the world frame of `ground_truth`."""
        frames = [self.contents.frames[index] for index in self.chosen]
        if any(named.pose(one.timestamp, one.T_world_camera) is not None for one in frames):
            return
        if named.trajectory is None:
            expected = "expected given poses in the world frame of the mesh, got a recording without poses"
            raise ConfigError(f"{KEY}: {expected}; add poses, or set {KEY} to a run directory of this recording")
        expected = "expected a run of this recording, got a run without a pose at the time of any selected frame"
        raise ConfigError(f"{KEY}: {expected}; set another run, or select other frames")

    def _check_odometry(self, odometry: Odometry) -> None:
        """Log the number of selected frames without odometry. Raise DataError if no frame has odometry."""
        times = np.array([self.contents.frames[index].depth_time for index in self.chosen])
        missing = int(np.count_nonzero(~odometry.covers(times)))
        if missing == len(times):
            begin, end = odometry.timestamps[[0, -1]]
            raise DataError(
                f"{ODOMETRY_KEY}: expected poses at the times of the frames ({times[0]:.3f} to {times[-1]:.3f} s), got "
                f"poses from {begin:.3f} to {end:.3f} s; convert the timestamps to s on the clock of the frames"
            )
        if missing:
            log.warning("%s: %d of %d frames have no odometry", self.name, missing, len(times))

    def _check_first_image(self) -> None:
        """Raise FrameError if the images of the first selected frame have the wrong size."""
        images = self.contents.frames[self.chosen[0]].images
        for name, read in ((images.color_name, images.color), (images.depth_name, images.depth)):
            try:
                shape = read().shape
            except FrameError:
                continue  # a damaged or invalid image is counted when the frame is read
            self.calibration.check_size(name, shape)


def delay_poses(frames: Sequence[RecordedFrame], delay: int) -> Sequence[RecordedFrame]:
    """Return the frames with the poses of the frames `delay` frames later.

    A frame has an error if there is no such pose.
    """
    moved = []
    for frame, other in _with_later(frames, delay):
        error = frame.error or (other.error if other else f"expected a pose at an offset of {delay} frames, got none")
        moved.append(replace(frame, T_world_camera=other.T_world_camera if other else None, error=error))
    return moved


def delay_depth(frames: Sequence[RecordedFrame], delay: int) -> Sequence[RecordedFrame]:
    """Return the frames with the depth images of the frames `delay` frames later.

    A frame has an error if there is no such depth image.
    """
    moved = []
    for frame, other in _with_later(frames, delay):
        if other:
            images = replace(frame.images, depth_name=other.images.depth_name, depth=other.images.depth)
            moved.append(_without_image_times(replace(frame, images=images)) if delay else frame)
        else:
            error = frame.error or f"expected a depth image at an offset of {delay} frames, got none"
            moved.append(replace(frame, error=error))
    return moved


def _without_image_times(frame: RecordedFrame) -> RecordedFrame:
    return replace(frame, color_timestamp=None, depth_timestamp=None)


def _with_plausible_image_times(name: str, frames: Sequence[RecordedFrame]) -> Sequence[RecordedFrame]:
    """Remove the separate timestamps of color and depth if any of them are implausible."""
    offsets = [
        frame.color_timestamp - frame.depth_timestamp
        for frame in frames
        if frame.color_timestamp is not None and frame.depth_timestamp is not None
    ]
    largest = max(offsets, key=abs, default=0.0)
    if abs(largest) <= LONGEST_COLOR_DELAY:
        return frames
    message = "%s: expected timestamps of color and depth within %g s of each other, got %.6g s; using one timestamp"
    log.warning(message, name, LONGEST_COLOR_DELAY, largest)
    return [_without_image_times(frame) for frame in frames]


def _with_later(frames: Sequence[RecordedFrame], delay: int) -> Iterator[tuple[RecordedFrame, RecordedFrame | None]]:
    """Yield each frame together with the frame `delay` frames later, or None without such a frame."""
    for k, frame in enumerate(frames):
        yield frame, frames[k + delay] if 0 <= k + delay < len(frames) else None


def _in_seconds(frame: RecordedFrame, unit: float) -> RecordedFrame:
    """Return a frame with timestamps in s from timestamps in units of `unit` s."""
    if unit == 1:
        return frame
    color, depth = (None if time is None else unit * time for time in (frame.color_timestamp, frame.depth_timestamp))
    return replace(frame, timestamp=unit * frame.timestamp, color_timestamp=color, depth_timestamp=depth)


def _converted(recorded: RecordedFrame, reading: PoseReading) -> RecordedFrame:
    """Convert the pose of a frame to the default convention. A frame has an error instead if this is impossible."""
    if recorded.T_world_camera is None:
        return recorded
    try:
        return replace(recorded, T_world_camera=reading.pose(recorded.T_world_camera))
    except DataError as reason:
        return RecordedFrame(recorded.images, recorded.timestamp, error=f"{recorded.images.color_name}: {reason}")


def _relative(recorded: RecordedFrame, offset: Float64) -> RecordedFrame:
    """Subtract a world offset (3,) from the position of a frame.

    A frame has an error instead if the pose is more than FARTHEST m from the offset.
    """
    T_world_camera = recorded.T_world_camera
    if T_world_camera is None:
        return recorded
    if offset.any():
        T_world_camera = T_world_camera.copy()
        T_world_camera[:3, 3] -= offset
    distance = math.hypot(*T_world_camera[:3, 3])
    if distance <= FARTHEST:
        return replace(recorded, T_world_camera=T_world_camera)
    expected = f"expected a pose within {FARTHEST:g} m of dataset.world_offset"
    error = f"{recorded.images.color_name}: {expected}, got {distance:.6g} m"
    return RecordedFrame(recorded.images, recorded.timestamp, error=error)


def _in_order_of_time(name: str, frames: Sequence[RecordedFrame]) -> Sequence[RecordedFrame]:
    """Replace the timestamps by a constant frame rate if they do not increase."""
    times = [recorded.timestamp for recorded in frames if not recorded.error]
    if all(a < b for a, b in pairwise(times)):
        return frames
    log.warning(
        "%s: expected increasing timestamps, got repeated or decreasing ones; using a frame rate of %g Hz",
        name,
        FRAME_RATE,
    )
    return [replace(_without_image_times(recorded), timestamp=k / FRAME_RATE) for k, recorded in enumerate(frames)]


def check_selection(start: int, stop: int, stride: int, frame_fraction: float = 1.0) -> None:
    """Raise ConfigError if a parameter of the frame selection is invalid."""
    require(start >= 0, "dataset.start", start, "at least 0")
    above = f"a value above dataset.start ({start}), or {TO_THE_END} for the end"
    require(stop == TO_THE_END or stop > start, "dataset.stop", stop, above)
    require(stride >= 1, "dataset.stride", stride, "at least 1")
    require(0 < frame_fraction <= 1, "dataset.frame_fraction", frame_fraction, "a value in (0, 1]")


def choose_frames(
    count: int, start: int, stop: int, stride: int, frame_fraction: float = 1.0, seed: int = 0
) -> Sequence[int]:
    """Return the indices of the selected frames in ascending order.

    The same `seed` always selects the same frames. At least one frame is selected.

    Args:
        count: The number of frames in the recording.
        start: The index of the first frame.
        stop: The index after the last frame; TO_THE_END = to the end.
        stride: The step between frames; 1 = every frame.
        frame_fraction: The fraction of these frames that is selected at random, in (0, 1]; 1 = all frames.
        seed: The seed of the random selection.

    Raises:
        ConfigError: A parameter is invalid, or `start` is beyond the last frame.
    """
    check_selection(start, stop, stride, frame_fraction)
    if start >= count:
        raise ConfigError(f"dataset.start: expected a frame from 0 to {count - 1}, got {start}")
    require(seed >= 0, "seed", seed, "at least 0")
    chosen = range(start, count if stop == TO_THE_END else min(stop, count), stride)
    if frame_fraction == 1:
        return chosen
    kept = max(1, round(frame_fraction * len(chosen)))
    order = np.random.default_rng([seed, _STREAM]).permutation(len(chosen))
    return tuple(chosen[k] for k in np.sort(order[:kept]).tolist())
