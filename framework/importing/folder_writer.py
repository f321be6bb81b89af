"""Writer of RGB-D folders for `dataset=rgbd_folder`."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, astuple, dataclass, field
from itertools import chain, islice
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from framework.config.validation import require
from framework.data import MAX_PIXELS, Camera, Float64
from framework.datasets.calibration.camera_json import DISTORTION, SENSOR
from framework.datasets.calibration.color_registration import ColorRegistration
from framework.datasets.calibration.undistortion import Undistortion
from framework.errors import DataError, errors_of
from framework.files.folders.restartable_folder import check_startable, restartable_folder
from framework.files.image_files import write_image
from framework.files.json_file import write_json
from framework.files.number_lines import write_gravity, write_image_times
from framework.files.storage import check_storage
from framework.files.tum_trajectory import write_tum
from framework.importing.depth_resampling import upsampled
from framework.importing.phones.image_rotation import QUARTER, Turn
from framework.importing.source import SURE, UNSURE, DeviceFrame, Source

DEPTH_SCALE = 1000.0  # units per meter
LONGER_SIDE = 640  # px, default for written images; trackers and detectors are tuned for this size
JPEG_QUALITY = 95  # percent
ODOMETRY = "odometry.txt"  # file for dataset.odometry, which is not read by default
COMMAND = "import"
OWN_FILES = re.compile(r"color/\d{6,}\.jpg|depth/\d{6,}\.png|(poses|odometry|timestamps|gravity)\.txt|camera\.json")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Writing:
    """Options for writing an RGB-D folder."""

    width: int = 0  # width of the images before rotation, px, at most the stored width; 0 = 640 px for the longer side
    stride: int = 1  # step between frames; 1 = every frame
    confidence: int = 1  # minimum confidence of depth readings, 0, 1 or 2, for recordings with confidence images
    rotate: int = 0  # rotation of the written images, degrees clockwise, 0, 90, 180 or 270

    def __post_init__(self) -> None:
        require(0 <= self.width <= MAX_PIXELS, "--width", self.width, f"a value in [0, {MAX_PIXELS}] px")
        require(self.stride >= 1, "--stride", self.stride, "at least 1")
        require(self.rotate in range(0, 360, QUARTER), "--rotate", self.rotate, "0, 90, 180 or 270 degrees")
        require(UNSURE <= self.confidence <= SURE, "--confidence", self.confidence, "0, 1 or 2")

    @property
    def turned(self) -> Turn:
        """Rotation of the written images."""
        return Turn(self.rotate // QUARTER)

    def camera(self, stored: Camera) -> Camera:
        """Return the camera of the resized images before rotation."""
        factor = self.width / stored.width if self.width else LONGER_SIDE / max(stored.width, stored.height)
        return stored.scaled(min(1.0, factor))


@dataclass
class Written:
    """Frames and errors of a written RGB-D folder."""

    timestamps: list[float] = field(default_factory=list)  # s, of the written frames
    poses: list[Float64] = field(default_factory=list)  # T_world_camera (4, 4) of these frames; empty without poses
    errors: list[str] = field(default_factory=list)  # error message of each skipped frame
    depth_timestamps: list[float | None] = field(default_factory=list)  # s; None = the timestamp of color
    ups: list[Float64 | None] = field(default_factory=list)  # (3,) up direction in the unrotated camera frame

    def __str__(self) -> str:
        count = f"{len(self.timestamps)} frames"
        return f"{count}; skipped {len(self.errors)}, first error: {self.errors[0]}" if self.errors else count


def write_folder(source: Source, directory: Path, writing: Writing) -> Written:
    """Write the frames of a recording as an RGB-D folder.

    Unusable frames are skipped. The files of an interrupted import in the same folder are replaced.

    Raises:
        DataError: `directory` is not empty, no frame is usable, the lens does not fit the camera, or a file cannot be
            written.
        StorageError: The storage of the recording is no longer available.
    """
    check_startable(directory, COMMAND)
    written = Written()
    frames = _frames(source, writing.stride, written)
    first = next(frames, None)
    if first is None:
        reason = f"first error: {written.errors[0]}" if written.errors else "the recording has no frames"
        raise DataError(f"{source.format}: expected usable frames, got none; {reason}")
    # the focal length of phones varies, so all frames are resampled to the camera of the first frame
    camera = writing.camera(first[1].camera)
    if source.distortion:
        Undistortion(writing.turned.camera(camera), writing.turned.lens(source.distortion))  # raises if it does not fit
    with restartable_folder(directory, COMMAND, OWN_FILES):
        _write_files(source, chain([first], frames), directory, writing, camera, written)
    return written


def _write_files(
    source: Source,
    frames: Iterable[tuple[int, DeviceFrame]],
    directory: Path,
    writing: Writing,
    camera: Camera,
    written: Written,
) -> None:
    turn = writing.turned
    has_depth = False
    for name in ("color", "depth"):
        (directory / name).mkdir(exist_ok=True)
    for number, frame in frames:
        with errors_of(frame.name):
            color = ColorRegistration(frame.camera, camera).apply(frame.color)
        sure = frame.depth
        if frame.confidence is not None:
            sure = np.where(frame.confidence >= writing.confidence, frame.depth, np.float32(0))
        units = np.rint(upsampled(sure, frame.color, frame.camera, camera, color) * DEPTH_SCALE)
        depth = np.where(units < np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
        has_depth |= bool(depth.any())
        bgr = cv2.cvtColor(turn.image(color), cv2.COLOR_RGB2BGR)
        write_image(directory / f"color/{number:06d}.jpg", bgr, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
        write_image(directory / f"depth/{number:06d}.png", turn.image(depth), cv2.IMWRITE_PNG_COMPRESSION, 1)
        written.timestamps.append(frame.timestamp)
        if frame.T_world_camera is not None:
            written.poses.append(turn.pose(frame.T_world_camera))
        written.depth_timestamps.append(frame.depth_timestamp)
        written.ups.append(frame.up)
    if not has_depth:
        text = "%s: expected depth of at most %.3f m, got no reading in %d frames; check the unit of depth%s"
        limit, unsure = np.iinfo(np.uint16).max / DEPTH_SCALE, ", or set --confidence 0" if writing.confidence else ""
        log.warning(text, directory, limit, len(written.timestamps), unsure)
    if source.posed:
        write_tum(directory / "poses.txt", written.timestamps, written.poses)
    if source.odometry is not None:
        poses = [turn.pose(T) if source.odometry.of_camera else T for T in source.odometry.poses]
        write_tum(directory / ODOMETRY, source.odometry.timestamps, poses)
    if not source.posed or any(time is not None for time in written.depth_timestamps):
        pairs = zip(written.timestamps, written.depth_timestamps, strict=True)
        times = [(color, color if depth is None else depth) for color, depth in pairs]
        write_image_times(directory / "timestamps.txt", times)
    if any(up is not None for up in written.ups):
        ups = [None if up is None else turn.R_turned_camera @ up for up in written.ups]
        write_gravity(directory / "gravity.txt", ups)
    lens = {DISTORTION: list(astuple(turn.lens(source.distortion)))} if source.distortion else {}
    sensor = {SENSOR: source.sensor.name} if source.sensor else {}
    write_json(directory / "camera.json", asdict(turn.camera(camera)) | {"depth_scale": DEPTH_SCALE} | lens | sensor)


def _frames(source: Source, stride: int, written: Written) -> Iterator[tuple[int, DeviceFrame]]:
    """Yield the number and content of each usable frame, and collect the errors of the others."""
    chosen = islice(enumerate(source.frames), 0, None, stride)
    for number, stored in tqdm(chosen, total=-(-source.count // stride), unit=" frames", disable=None):
        try:
            frame = stored()
            if source.posed and frame.T_world_camera is None:
                raise DataError(f"{frame.name}: expected a pose, got none; --poses none imports without poses")
            if written.timestamps and frame.timestamp <= written.timestamps[-1]:
                expected = f"expected a timestamp > {written.timestamps[-1]:.6f} s"
                raise DataError(f"{frame.name}: {expected}, got {frame.timestamp:.6f} s")
        except DataError as error:
            check_storage(error, source.path)
            written.errors.append(str(error))
        else:
            yield number, frame
