"""What the readers of recordings share: a reader says what there is, and this chooses frames and reads their images."""

from __future__ import annotations

import logging
import math
import re
import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from framework.data import Array, Camera, Float32, Frame, FrameTruth
from framework.datasets.calibration.raw_images import Calibration, check_max_depth
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import DepthReading, PoseReading
from framework.datasets.frames.stored_frames import RecordedFrame, StoredImages
from framework.errors import ConfigError, DataError, FrameError
from framework.files.search_paths import folder_of
from framework.interfaces import RGBDSequence

FARTHEST = 1e4  # m from the world's origin, of a pose; beyond, neighbouring float32 numbers are 1 mm apart
FRAME_RATE = 30.0  # Hz, of recordings without timestamps, or with some that cannot be

TO_THE_END = -1  # value of `stop`
_STREAM = zlib.crc32(b"share")  # a random stream of its own, beside all that a dataset draws from the same seed

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Contents:
    """All that a recording holds, before any frame is chosen."""

    camera: Camera
    camera_source: Path | str  # what says so, for messages
    depth_scale: float  # units a metre
    frames: Sequence[RecordedFrame]
    distortion: Distortion | None = None  # of the camera's lens, in colour and depth alike; None = a pinhole


@dataclass
class Recording(RGBDSequence):
    """An RGB-D video on disk. A subclass says what is there (`open`), and what is known of the truth.

    Faults of the whole recording raise DataError when it is opened; faults of one frame raise FrameError when that
    frame is read, so that the pipeline counts it and goes on.
    """

    root: Path  # the folder, or the folder of the scenes; a relative one in the working, else in the project folder
    scene: str = ""  # sub-folder of root; "" = root itself
    start: int = 0  # first frame
    stop: int = TO_THE_END  # the frame to stop before; -1 = to the end
    stride: int = 1  # take every stride-th frame
    frame_fraction: float = 1.0  # in (0, 1], share of these frames, chosen at random with `seed`
    seed: int = 0  # of the random selection
    max_depth: float = 10.0  # m; farther readings become "no reading"; 0 = keep all
    pose_reading: PoseReading = field(default_factory=PoseReading)
    depth_reading: DepthReading = field(default_factory=DepthReading)

    def __post_init__(self) -> None:
        check_selection(self.start, self.stop, self.stride, self.frame_fraction)
        check_max_depth(self.max_depth)
        self.root = folder_of(Path(self.root))
        self.folder = self.root / self.scene
        if not self.folder.is_dir():
            project = "" if self.root.is_absolute() else ", neither here nor in a checkout of the project"
            raise DataError(f"dataset.root: the folder {self.folder} does not exist{project}")
        self.name = self.folder.resolve().name
        self.contents = stored = self._read(self.open())
        self.camera = stored.camera
        self.calibration = Calibration(
            self.camera, stored.camera_source, stored.depth_scale, self.max_depth, stored.distortion
        )
        self.chosen = choose_frames(
            len(self.contents.frames), self.start, self.stop, self.stride, self.frame_fraction, self.seed
        )
        self._check_first_image()

    def _read(self, stored: Contents) -> Contents:
        """What is stored, as it is meant."""
        posed = [_posed(recorded, self.pose_reading) for recorded in self.pose_reading.frames(stored.frames)]
        frames = self.depth_reading.frames(_in_order_of_time(self.name, posed))
        return replace(stored, frames=frames, depth_scale=self.depth_reading.depth_scale or stored.depth_scale)

    @abstractmethod
    def open(self) -> Contents:
        """What `self.folder` holds. Raises DataError, naming the file, when that is no such recording."""

    def truth_in(self, index: int) -> FrameTruth | None:
        """The true instances in frame `index`, counted before any is chosen; None where nobody labelled them."""
        return None

    def __len__(self) -> int:
        return len(self.chosen)

    def has_poses(self) -> bool:
        frames = [self.contents.frames[index] for index in self.chosen]
        # a frame whose pose is no pose says so when it is read
        return any(recorded.T_world_camera is not None or recorded.fault for recorded in frames)

    def __getitem__(self, k: int) -> Frame:
        index = self.chosen[k]
        recorded = self.contents.frames[index]
        if recorded.fault:
            raise FrameError(f"frame {index}: {recorded.fault}")
        return Frame(
            index=index,
            timestamp=recorded.timestamp,
            color=self.calibration.color(recorded.images.color(), recorded.images.color_name),
            depth=self.metric_depth(index),
            camera=self.camera,
            T_world_camera=recorded.T_world_camera,
            truth=self.truth_in(index),
            up=recorded.up,
        )

    def metric_depth(self, index: int) -> Float32:
        """(H, W) m, 0 = no reading. Raises FrameError."""
        images = self.contents.frames[index].images
        return self.calibration.depth(images.depth(), images.depth_name)

    def _check_first_image(self) -> None:
        """A first image of the wrong size means that all are: better said at once than by skipping every frame."""
        images = self.contents.frames[self.chosen[0]].images
        for name, read in ((images.color_name, images.color), (images.depth_name, images.depth)):
            try:
                shape = read().shape
            except FrameError:
                continue  # damaged or of a wrong type: counted when the frame is read
            if fault := self.calibration.fault_of_size(name, shape):
                raise DataError(fault)


def _posed(recorded: RecordedFrame, reading: PoseReading) -> RecordedFrame:
    """The frame with the pose that is meant, or with a fault where that is farther off than anything is mapped."""
    if recorded.T_world_camera is None:
        return recorded
    T_world_camera = reading.pose(recorded.T_world_camera)
    distance = math.hypot(*T_world_camera[:3, 3])
    if distance <= FARTHEST:
        return replace(recorded, T_world_camera=T_world_camera)
    fault = f"{recorded.images.color_name}: its pose is {distance:.6g} m from the origin, more than {FARTHEST:g}"
    return RecordedFrame(recorded.images, recorded.timestamp, fault=fault)


def _in_order_of_time(name: str, frames: Sequence[RecordedFrame]) -> Sequence[RecordedFrame]:
    """The frames, at 30 Hz where the times of those that can be used do not grow."""
    times = [recorded.timestamp for recorded in frames if not recorded.fault]
    if all(a < b for a, b in pairwise(times)):
        return frames
    log.warning("%s: the times do not grow from frame to frame; frames are taken to come at %g Hz", name, FRAME_RATE)
    return [replace(recorded, timestamp=k / FRAME_RATE) for k, recorded in enumerate(frames)]


def check_selection(start: int, stop: int, stride: int, frame_fraction: float = 1.0) -> None:
    """Raises ConfigError unless the parameters can choose frames at all."""
    if start < 0:
        raise ConfigError(f"dataset.start must be 0 or positive, found {start}")
    if stop != TO_THE_END and stop <= start:
        raise ConfigError(
            f"dataset.stop must be above dataset.start ({start}), or {TO_THE_END} for the end; found {stop}"
        )
    if stride < 1:
        raise ConfigError(f"dataset.stride must be at least 1, found {stride}")
    if not 0 < frame_fraction <= 1:  # NaN is neither
        raise ConfigError(f"dataset.frame_fraction must be in (0, 1], found {frame_fraction}")


def choose_frames(
    count: int, start: int, stop: int, stride: int, frame_fraction: float = 1.0, seed: int = 0
) -> Sequence[int]:
    """The frame numbers chosen of `count` frames, ascending: as a Python slice chooses, and of those a random fraction.

    The same `seed` selects the same frames, at least one. Raises ConfigError when no frame is left.
    """
    check_selection(start, stop, stride, frame_fraction)
    if start >= count:
        raise ConfigError(f"dataset.start is {start}, but the sequence has only {count} frames (0 to {count - 1})")
    if seed < 0:
        raise ConfigError(f"seed must be 0 or positive, found {seed}")
    chosen = range(start, count if stop == TO_THE_END else min(stop, count), stride)
    if frame_fraction == 1:
        return chosen
    kept = np.random.default_rng([seed, _STREAM]).permutation(len(chosen))[
        : max(1, round(frame_fraction * len(chosen)))
    ]
    return tuple(chosen[k] for k in np.sort(kept).tolist())


def numbered_images(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """The folder's images by the number in which their names end, in the order of these numbers.

    Raises DataError when there is none, a name has no number, two have the same, or the names differ in other digits,
    too: the decimals of a time are no order.
    """
    if not folder.is_dir():
        raise DataError(f"the folder {folder} is missing")
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        number = number_of(path)
        if number is None:
            raise DataError(f"{path}: the file name must end in the frame's number, like 000000{path.suffix}")
        if number in files:
            raise DataError(f"{path} and {files[number].name} have the same frame number {number}")
        files[number] = path
    check_one_number(list(files.values()))
    if not files:
        raise DataError(f"{folder} holds no image ({', '.join(suffixes)})")
    return dict(sorted(files.items()))


def paired_images(
    colors: Mapping[int, Path],
    depths: Mapping[int, Path],
    color_name: Callable[[int], Path],
    depth_name: Callable[[int], Path],
) -> dict[int, StoredImages]:
    """The images of each frame by its number; reading one that is missing raises FrameError, with the expected name."""
    return {
        k: StoredImages.of_files(colors.get(k) or color_name(k), depths.get(k) or depth_name(k))
        for k in sorted(colors.keys() | depths.keys())
    }


def first_size(paths: Iterable[Path], read: Callable[[Path], Array]) -> tuple[int, int]:
    """(width, height) px of the first image that can be read. Raises DataError if none can."""
    faults = []
    for path in paths:
        try:
            height, width = read(path).shape[:2]
        except FrameError as error:
            faults.append(str(error))
            continue
        return width, height
    raise DataError(f"no image can be read: {faults[0]}")


def number_of(path: Path) -> int | None:
    """The number in which the name of an image ends; None = there is none."""
    digits = path.stem[len(_before_number(path)) :]
    return int(digits) if digits else None


def check_one_number(files: Sequence[Path]) -> None:
    """Raises DataError when the names of images differ in more than the number in which they end."""
    for path in files:
        before, of_first = _before_number(path), _before_number(files[0])
        if before != of_first and re.search("[0-9]", before + of_first):
            raise DataError(
                f"{path.parent}: {files[0].name} and {path.name} differ in more than one number; number the frames in "
                "their order, 000000.png, 000001.png ..."
            )


def _before_number(path: Path) -> str:
    return path.stem.rstrip("0123456789")
