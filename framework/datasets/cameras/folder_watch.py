"""Live frames from a folder that another program writes during mapping.

The layout is that of `dataset=rgbd_folder`:

    camera.json         as in an RGB-D folder; may appear after the start, but must not change afterwards
    color/000000.jpg    JPEG or PNG, 8-bit
    depth/000000.png    uint16, registered to color, along z; 0 or 65535 = no reading
    end                 an empty file, written after the last frame

A frame is complete when both of its files exist, in any order. To write a file, use a temporary name that begins with a
dot, then rename the file. Frame numbers must increase. A frame is skipped if it is still incomplete when a later frame
is complete or the sequence ends. Files of earlier frames can be deleted during the run. The run ends with an error if
the folder, `color` or `depth` is removed, or if camera.json gets other values.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from framework.config.validation import check_bounds
from framework.data import LARGEST_INDEX, Frame
from framework.datasets.calibration.camera_json import StoredCamera, json_object, stored_camera
from framework.datasets.calibration.raw_images import Calibration, check_max_depth
from framework.datasets.frames.numbered_images import check_one_number, number_of
from framework.datasets.frames.sequence_reader import StoredImages
from framework.errors import DataError, FrameError
from framework.files.atomic_write import MAX_TEXT, read_bytes
from framework.files.image_files import check_image, read_image_file
from framework.files.search_paths import folder_of
from framework.interfaces import FrameReader, LiveVideo
from framework.runtime.frame_stream import steady_time
from framework.sensors.noise_models import SensorChoice, SensorKind

COLOR, DEPTH = (".jpg", ".jpeg", ".png"), (".png",)
LONGEST_WAIT = 86_400.0  # s, limit of both timeouts
MIN_REST = 3.0  # minimum pause between polls, as a multiple of the last poll's duration; listing a folder can be slow
CLOCK_TICK = 1e-6  # s, minimum difference between the timestamps of two frames of the same poll

log = logging.getLogger(__name__)


@dataclass
class FolderWatch(LiveVideo):
    """Frames from a folder that another program writes during mapping."""

    root: Path  # existing folder of frames from another program, relative to the working or project directory
    idle_timeout: float = 0.0  # maximum time without a new frame before the run ends, s, in [0, 86400]; 0 = unlimited
    camera_timeout: float = 30.0  # maximum wait for camera.json, s, in [0, 86400]
    poll_interval: float = 0.01  # interval between polls of the folder, s, in [0.001, 0.1]
    max_depth: float = 10.0  # maximum depth, m, >= 0; farther readings are dropped; 0 = unlimited
    # depth sensor, which selects the noise model: AUTO (from camera.json, else KINECT_V1), EXACT (rendered depth),
    # KINECT_V1, REALSENSE_D435, TIME_OF_FLIGHT or PHONE_LIDAR
    sensor: SensorChoice = SensorChoice.AUTO

    def __post_init__(self) -> None:
        waits = (0.0, LONGEST_WAIT)
        check_bounds(self, idle_timeout=waits, camera_timeout=waits, poll_interval=(0.001, 0.1))
        check_max_depth(self.max_depth)
        self.folder = folder_of(Path(self.root))
        if not self.folder.is_dir():
            raise DataError(f"dataset.root: expected an existing folder, got {self.folder}")
        self.name = self.folder.resolve().name

    def frames(self) -> Generator[FrameReader | FrameError | None]:
        path = self.folder / "camera.json"
        content, stored = yield from self._camera(path)
        calibration = Calibration(stored.camera, path, stored.depth_scale, self.max_depth, stored.distortion)
        sensor = self.sensor.kind(stored.sensor)
        arrivals = Arrivals(self.folder)
        last_time, last_arrival = 0.0, time.monotonic()
        while True:
            began = time.monotonic()
            # checked before the images, so that all files written before `end` are read
            over = (self.folder / "end").exists() or 0 < self.idle_timeout < began - last_arrival
            self._check_root()
            arrivals.look()
            if _content(path) != content:  # checked after the images, so that all of them are older than a change
                content, found = yield from self._camera(path)
                _check_unchanged(path, stored, found)
            for number, images in arrivals.take(to_the_end=over):
                last_time, last_arrival = max(steady_time(), last_time + CLOCK_TICK), began
                if isinstance(images, FrameError):
                    yield images
                else:
                    yield partial(_read, number, images, last_time, calibration, sensor)
            if over:
                return
            yield None
            time.sleep(min(max(self.poll_interval, MIN_REST * (time.monotonic() - began)), 0.1))

    def _camera(self, path: Path) -> Generator[None, None, tuple[bytes, StoredCamera]]:
        """Wait for a complete camera.json, and return its content and calibration."""
        deadline = time.monotonic() + self.camera_timeout
        while True:
            self._check_root()
            try:
                content = read_bytes(path, MAX_TEXT)
                values = json_object(path, content)
                break
            except DataError as error:
                if time.monotonic() > deadline:
                    raise DataError(
                        f"{error}; write this file within dataset.camera_timeout={self.camera_timeout:g} s"
                    ) from error
            yield None
            time.sleep(self.poll_interval)
        return content, stored_camera(path, values)

    def _check_root(self) -> None:
        """Raise DataError if the folder was removed or cannot be read."""
        try:
            self.folder.stat()
        except OSError as error:
            raise DataError(
                f"dataset.root: expected the folder {self.folder} until the end of the run, got an error "
                f"({error.strerror}); write a file `end` into it to end the run"
            ) from error


def _content(path: Path) -> bytes:
    """Return the content of a file, or nothing if it cannot be read."""
    try:
        return read_bytes(path, MAX_TEXT)
    except DataError:
        return b""


def _check_unchanged(path: Path, stored: StoredCamera, found: StoredCamera) -> None:
    """Raise DataError if the calibration in camera.json differs from that at the start of the run."""
    before, now = ({**vars(one.camera), **one._asdict()} for one in (stored, found))
    for key, value in before.items():
        if key != "camera" and now[key] != value:
            raise DataError(
                f"{path}: {key}: expected {value} as at the start of the run, got {now[key]}; map the frames of the "
                "other camera in another run"
            )


def _read(number: int, images: StoredImages, timestamp: float, calibration: Calibration, sensor: SensorKind) -> Frame:
    try:
        color = calibration.color(images.color(), images.color_name)
        depth = calibration.depth(images.depth(), images.depth_name)
    except FrameError as error:  # without its cause, because `Arrivals` detects lost storage
        raise FrameError(str(error)) from None
    name = images.image_name
    return Frame(number, timestamp, color, depth, calibration.camera, sensor=sensor, image_name=name)


class Arrivals:
    """Detector of new frames in a folder."""

    def __init__(self, folder: Path) -> None:
        self._color, self._depth = NewImages(folder / "color", COLOR), NewImages(folder / "depth", DEPTH)
        self._last = -1  # number of the last complete or skipped frame
        self._halves: set[int] = set()  # numbers of skipped frames with only one image so far

    def look(self) -> None:
        """List the files that appeared since the last call."""
        self._color.look()
        self._depth.look()

    def take(self, to_the_end: bool) -> Iterator[tuple[int, StoredImages | FrameError]]:
        """Yield the new frames among the listed files in ascending order.

        Each item consists of the frame number and either the complete images or the reason for skipping the frame.

        Args:
            to_the_end: True = include all frames; False = include frames up to the newest complete frame.
        """
        color, depth = self._color.waiting, self._depth.waiting
        both, any_of = sorted(color.keys() & depth.keys()), sorted(color.keys() | depth.keys())
        newest = next((n for n in reversed(both) if _damage(color[n], depth[n]) is None), -1)
        newest = max(newest, self._last)  # a frame that arrives after a later frame is skipped
        for number in any_of if to_the_end else [number for number in any_of if number <= newest]:
            color_file, depth_file = color.pop(number, None), depth.pop(number, None)
            if number in self._halves:  # the second image of a skipped frame
                self._halves.remove(number)
                continue
            if color_file is None or depth_file is None:
                self._halves.add(number)
            if number <= self._last:
                found = f"{color_file or depth_file}: expected a frame number > {self._last}, got {number}"
                yield number, FrameError(found)
                continue
            self._last = number
            if color_file is None or depth_file is None:
                until = f"before frame {newest}" if newest > number else "before the end"
                found = f"{color_file or depth_file}: expected the frame's other image {until}, got none"
                yield number, FrameError(found)
            elif number != newest and (damage := _damage(color_file, depth_file)) is not None:
                yield number, damage
            else:
                yield number, StoredImages.of_files(color_file, depth_file)


class NewImages:
    """Images in a folder that are not yet assigned to frames."""

    def __init__(self, folder: Path, suffixes: Sequence[str]) -> None:
        self.folder, self.suffixes = folder, suffixes
        self.waiting: dict[int, Path] = {}  # by frame number
        self._names: set[str] = set()
        self._exists = False  # True once the folder has been listed
        self._first: Path | None = None

    def look(self) -> None:
        """Add the images that appeared since the last call.

        Raises:
            DataError: The folder was removed or cannot be read, or the names differ in more than one number, so that
                their order is ambiguous.
        """
        try:
            with os.scandir(self.folder) as entries:
                names = {entry.name for entry in entries}
        except OSError as error:
            if isinstance(error, FileNotFoundError) and not self._exists:
                return  # it may appear later
            raise DataError(
                f"{self.folder}: expected a folder of images until the end of the run, got an error ({error.strerror})"
            ) from error
        self._exists = True
        new, self._names = names - self._names, names
        for name in sorted(new):
            path = self.folder / name
            if name.startswith(".") or path.suffix.lower() not in self.suffixes:
                continue
            number = number_of(path)
            if number is None or number >= LARGEST_INDEX:
                message = "%s: expected a frame number below 2^53 at the end of the name, got %r; image ignored"
                log.warning(message, self.folder, name)
                continue
            self._first = self._first or path
            check_one_number([self._first, path])
            self.waiting[number] = path


def _damage(*paths: Path) -> FrameError | None:
    """Return the error of the first incomplete image, or None if all images are complete."""
    try:
        for path in paths:
            check_image(path, read_image_file(path))
    except FrameError as error:
        return error
    return None
