"""Writes a source as an RGB-D folder, which `dataset=rgbd_folder` reads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, field
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from framework.config.validation import require
from framework.data import MOST_PIXELS, Array, Camera, Float32, Float64, UInt16
from framework.datasets.calibration.camera_json import DISTORTION
from framework.datasets.calibration.color_registration import ColorRegistration
from framework.errors import DataError
from framework.files.atomic_write import written_whole
from framework.files.gravity_file import write_gravity
from framework.files.json_file import write_json
from framework.files.tum_trajectory import write_tum
from framework.importing.depth.depth_upsampling import upsampled
from framework.importing.phones.image_rotation import QUARTER, Turn
from framework.importing.source import SURE, UNSURE, DeviceFrame, Source, StoredFrame

DEPTH_SCALE = 1000.0  # units a metre
LONGER_SIDE = 640  # px, of the images that are written by default: what trackers and detectors are tuned for
JPEG_QUALITY = 95  # in percent


@dataclass(frozen=True)
class Writing:
    """How much of a source is written."""

    width: int = 0  # px, of the images before they are turned, at most as stored; 0 = the longer side gets LONGER_SIDE
    stride: int = 1  # every so many-th frame
    confidence: int = 1  # 0, 1 or 2: depth of a lower one is left out, where the source tells it
    turn: int = 0  # degrees clockwise, 0, 90, 180 or 270, of the images that are written

    def __post_init__(self) -> None:
        require(0 <= self.width <= MOST_PIXELS, "--width", self.width, f"0 or positive and at most {MOST_PIXELS} px")
        require(self.stride >= 1, "--stride", self.stride, "at least 1")
        require(self.turn in range(0, 360, QUARTER), "--turn", self.turn, "0, 90, 180 or 270 degrees")
        require(UNSURE <= self.confidence <= SURE, "--confidence", self.confidence, "0, 1 or 2")

    @property
    def turned(self) -> Turn:
        """How the images are turned."""
        return Turn(self.turn // QUARTER)

    def camera(self, stored: Camera) -> Camera:
        """That of the images which are written, before they are turned."""
        factor = self.width / stored.width if self.width else LONGER_SIDE / max(stored.width, stored.height)
        return stored.scaled(min(1.0, factor))


@dataclass
class Written:
    """What became of a source's frames."""

    timestamps: list[float] = field(default_factory=list)  # s, of the frames that were written
    poses: list[Float64] = field(default_factory=list)  # T_world_camera (4, 4) of them, none without poses
    faults: list[str] = field(default_factory=list)  # of each frame that was left out
    ups: list[Float64 | None] = field(default_factory=list)  # (3,) up in the camera of each as it was stored

    def __str__(self) -> str:
        said = f"{len(self.timestamps)} frames"
        return f"{said}; left out are {len(self.faults)}, the first: {self.faults[0]}" if self.faults else said


def check_new(directory: Path) -> None:
    """Raises DataError unless nothing is there, or an empty folder."""
    if directory.is_dir() and not any(directory.iterdir()):
        return
    if directory.exists() or directory.is_symlink():
        raise DataError(f"{directory} is there already, and not empty; choose another folder, or remove it")


def write_folder(source: Source, directory: Path, writing: Writing) -> Written:
    """Writes the frames, then their poses, up and the camera: a folder without camera.json is not finished.

    A frame that cannot be used is left out. Raises DataError when `directory` holds something, none can be used, or the
    disk does not take a file.
    """
    check_new(directory)
    written = Written()
    turn = writing.turned
    camera = None  # phones focus anew from frame to frame: all frames are brought to the first one's
    for number, frame in _frames(source, writing.stride, written):
        if camera is None:
            camera = writing.camera(frame.camera)
            for name in ("color", "depth"):
                (directory / name).mkdir(parents=True, exist_ok=True)
        color = ColorRegistration(frame.camera, camera).apply(frame.color)
        depth = upsampled(_sure(frame, writing.confidence), frame.color, frame.camera, camera, color)
        bgr = cv2.cvtColor(turn.image(color), cv2.COLOR_RGB2BGR)
        _write_image(directory / f"color/{number:06d}.jpg", bgr, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
        _write_image(directory / f"depth/{number:06d}.png", _stored(turn.image(depth)), cv2.IMWRITE_PNG_COMPRESSION, 1)
        written.timestamps.append(frame.timestamp)
        if frame.T_world_camera is not None:
            written.poses.append(turn.pose(frame.T_world_camera))
        written.ups.append(frame.up)
    if camera is None:
        raise DataError(f"no frame can be used; the first: {written.faults[0] if written.faults else 'there is none'}")
    if source.posed:
        write_tum(directory / "poses.txt", written.timestamps, written.poses)
    if any(up is not None for up in written.ups):
        ups = [None if up is None else turn.R_turned_camera @ up for up in written.ups]
        write_gravity(directory / "gravity.txt", ups)
    lens = {DISTORTION: list(astuple(turn.lens(source.distortion)))} if source.distortion else {}
    write_json(directory / "camera.json", asdict(turn.camera(camera)) | {"depth_scale": DEPTH_SCALE} | lens)
    return written


def _frames(source: Source, stride: int, written: Written) -> Iterator[tuple[int, DeviceFrame]]:
    """Number and content of each chosen frame that can be used; the faults of the others go to `written`."""
    chosen = islice(enumerate(source.frames), 0, None, stride)
    for number, stored in tqdm(chosen, total=-(-source.count // stride), unit=" frames", disable=None):
        try:
            yield number, _checked(stored, source.posed, written.timestamps[-1:])
        except DataError as error:
            written.faults.append(str(error))


def _checked(stored: StoredFrame, posed: bool, before: list[float]) -> DeviceFrame:
    frame = stored()
    if posed and frame.T_world_camera is None:
        raise DataError(f"{frame.name} has no pose")
    if before and frame.timestamp <= before[0]:
        raise DataError(f"{frame.name} is of {frame.timestamp:.6f} s, not later than the frame before")
    return frame


def _sure(frame: DeviceFrame, least: int) -> Float32:
    if frame.confidence is None:
        return frame.depth
    return np.where(frame.confidence >= least, frame.depth, np.float32(0))


def _stored(depth: Float32) -> UInt16:
    units = np.rint(depth * DEPTH_SCALE)
    return np.where(units < np.iinfo(np.uint16).max, units, 0).astype(np.uint16)


def _write_image(path: Path, image: Array, *parameters: int) -> None:
    _, data = cv2.imencode(path.suffix, image, parameters)
    with written_whole(path) as temporary:
        temporary.write_bytes(data.tobytes())
