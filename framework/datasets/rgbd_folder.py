"""A folder of colour and depth images: how users bring their own data.

    camera.json         {"width", "height", "fx", "fy", "cx", "cy", "depth_scale"}; metres = value / depth_scale
    color/000000.jpg    JPEG or PNG, 8-bit
    depth/000000.png    uint16, registered to colour, along z; 0 or 65535 = no reading
    poses.txt           optional; TUM format, T_world_camera, one line a frame: timestamp tx ty tz qx qy qz qw
    instance/000000.png, instances.json     optional ground truth: uint16 ids, {"<id>": {"name", "class"}}

Files belong together by the number in their names; the numbers may start anywhere and have gaps. Line k of poses.txt
(comments and empty lines not counted) is the k-th frame in the order of these numbers.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera, Float32, Float64, Frame, FrameTruth, Int32, SceneTruth
from framework.datasets.frame_selection import TO_THE_END, check_selection, choose_frames
from framework.datasets.image_files import read_color, read_uint16
from framework.errors import ConfigError, DataError, FrameError
from framework.evaluation.scene_truth import LabeledDepth, fuse_scene_truth
from framework.interfaces import RGBDSequence
from framework.trajectory_file import TumLine, read_tum_lines

FRAME_RATE = 30.0  # Hz, for the timestamps of a folder without poses.txt
NO_READING = 65535  # uint16 that several sensors write instead of 0

log = logging.getLogger(__name__)


@dataclass
class RgbdFolder(RGBDSequence):
    """An RGB-D video in a folder of images, with poses and instance ground truth where there are files for them.

    Faults of the whole sequence (a file or key that is missing, counts that differ, an unreadable line of poses.txt)
    raise DataError here; faults of one frame raise FrameError when that frame is read.
    """

    root: Path  # the folder, or the folder of the scenes
    scene: str = ""  # sub-folder of root; "" = root itself
    start: int = 0  # first frame
    stop: int = TO_THE_END  # the frame to stop before; -1 = to the end
    stride: int = 1  # take every stride-th frame
    share: float = 1.0  # in (0, 1], share of these frames, chosen at random with `seed`
    seed: int = 0  # of the share
    max_depth: float = 10.0  # m; farther readings become "no reading"; 0 = keep all
    truth_voxel: float = 0.02  # m, spacing of the ground-truth surface points

    def __post_init__(self) -> None:
        check_selection(self.start, self.stop, self.stride, self.share)
        if not (math.isfinite(self.max_depth) and self.max_depth >= 0):
            raise ConfigError(f"dataset.max_depth must be 0 (keep all) or positive metres, found {self.max_depth}")
        if not self.truth_voxel > 0:
            raise ConfigError(f"dataset.truth_voxel must be positive metres, found {self.truth_voxel}")
        self.folder = Path(self.root).expanduser() / self.scene
        if not self.folder.is_dir():
            raise DataError(f"dataset.root: the folder {self.folder} does not exist")
        self.name = self.folder.resolve().name
        self.camera, self.depth_scale = _read_camera(self.folder / "camera.json")
        self._color = _numbered(self.folder / "color", (".jpg", ".jpeg", ".png"))
        self._depth = _numbered(self.folder / "depth", (".png",))
        self._numbers = list(self._color)
        _check_same_frames(self._color, self._depth)
        self._poses = _read_poses(self.folder / "poses.txt", len(self._numbers))
        self._class_names, self._instance = self._read_instances()
        self._chosen = choose_frames(len(self._numbers), self.start, self.stop, self.stride, self.share, self.seed)
        self._check_first_image()

    def __len__(self) -> int:
        return len(self._chosen)

    def __getitem__(self, k: int) -> Frame:
        index = self._chosen[k]
        color = read_color(self._color[self._numbers[index]])
        self._check_size(self._color, index, color.shape[:2])
        timestamp, T_world_camera = self._pose(index)
        return Frame(
            index=index,
            timestamp=timestamp,
            color=color,
            depth=self._read_depth(index),
            camera=self.camera,
            T_world_camera=T_world_camera,
            truth=self._read_truth(index),
        )

    def scene_truth(self) -> SceneTruth | None:
        """The chosen frames' depth, fused with its instance ids; None without instances or poses.

        Frames that cannot be read are left out. The points are as exact as the depth images.
        """
        if not self._instance or self._poses is None:
            return None
        return fuse_scene_truth(self._labeled_depth(), self._class_names, self.truth_voxel)

    def _labeled_depth(self) -> Iterator[LabeledDepth]:
        for index in self._chosen:
            try:
                depth, truth, (_, T_world_camera) = self._read_depth(index), self._read_truth(index), self._pose(index)
            except FrameError as error:
                log.warning("ground truth: left out %s", error)
                continue
            if truth is not None and T_world_camera is not None:
                yield LabeledDepth(depth, truth.instance_ids, self.camera, T_world_camera)

    def _read_depth(self, index: int) -> Float32:
        raw = read_uint16(self._depth[self._numbers[index]])
        self._check_size(self._depth, index, raw.shape)
        depth = raw.astype(np.float32)
        depth /= np.float32(self.depth_scale)
        depth[raw == NO_READING] = 0
        if self.max_depth:
            depth[depth > self.max_depth] = 0
        return depth

    def _read_truth(self, index: int) -> FrameTruth | None:
        if not self._instance:
            return None
        path = self._instance[self._numbers[index]]
        ids: Int32 = read_uint16(path).astype(np.int32)
        self._check_size(self._instance, index, ids.shape)
        unknown = [int(i) for i in np.flatnonzero(np.bincount(ids.ravel())) if i and i not in self._class_names]
        if unknown:
            raise FrameError(f"{path}: instance {unknown[0]} is not in {self.folder / 'instances.json'}")
        return FrameTruth(ids, self._class_names)

    def _pose(self, index: int) -> tuple[float, Float64 | None]:
        if self._poses is None:
            return index / FRAME_RATE, None
        line = self._poses[index]
        try:
            return line.timestamp, line.pose()
        except DataError as error:
            raise FrameError(f"frame {index}: {error}") from error

    def _read_instances(self) -> tuple[dict[int, str | None], dict[int, Path]]:
        folder, names = self.folder / "instance", self.folder / "instances.json"
        if not folder.is_dir() and not names.is_file():
            return {}, {}
        if not names.is_file():
            raise DataError(f"{folder} is there, but {names} is missing: it names the class of each instance")
        class_names = _read_class_names(names)
        images = _numbered(folder, (".png",))
        _check_same_frames(self._color, images)
        return class_names, images

    def _check_size(self, files: dict[int, Path], index: int, shape: tuple[int, ...]) -> None:
        if shape != self.camera.shape:
            raise FrameError(f"{files[self._numbers[index]]} is {_size(shape)}, but {self._expected_size()}")

    def _expected_size(self) -> str:
        return f"{self.folder / 'camera.json'} says {_size(self.camera.shape)}; colour, depth and camera must agree"

    def _check_first_image(self) -> None:
        """A first image of the wrong size means that all are: better said at once than by skipping every frame."""
        index = self._chosen[0]
        for files, read in ((self._color, read_color), (self._depth, read_uint16)):
            try:
                shape = read(files[self._numbers[index]]).shape[:2]
            except FrameError:
                continue  # damaged or of a wrong type: counted when the frame is read
            if shape != self.camera.shape:
                raise DataError(f"{files[self._numbers[index]]} is {_size(shape)}, but {self._expected_size()}")


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise DataError(f"{path} is missing; an RGB-D folder needs camera.json, color/ and depth/ (see README)")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} must hold a JSON object, found {type(content).__name__}")
    return content


def _read_camera(path: Path) -> tuple[Camera, float]:
    """The camera and the depth scale (units per metre)."""
    content = _read_json(path)
    values: dict[str, float] = {}
    for key in ("width", "height", "fx", "fy", "cx", "cy", "depth_scale"):
        if key not in content:
            raise DataError(f"{path}: the key {key!r} is missing")
        value = content[key]
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DataError(f"{path}: {key} must be a number, found {value!r}")
        values[key] = value
    for key in ("width", "height"):
        if values[key] != int(values[key]):
            raise DataError(f"{path}: {key} must be a whole number of pixels, found {values[key]}")
    if values["depth_scale"] <= 0:
        raise DataError(f"{path}: depth_scale must be positive (depth units per metre), found {values['depth_scale']}")
    width, height = int(values["width"]), int(values["height"])
    try:
        camera = Camera(width, height, values["fx"], values["fy"], values["cx"], values["cy"])
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    return camera, values["depth_scale"]


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """The folder's images by the number in their names, in the order of these numbers."""
    if not folder.is_dir():
        raise DataError(f"the folder {folder} is missing")
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        digits = path.stem[len(path.stem.rstrip("0123456789")) :]
        if not digits:
            raise DataError(f"{path}: the file name must end in the frame's number, like 000000{path.suffix}")
        if int(digits) in files:
            raise DataError(f"{path} and {files[int(digits)].name} have the same frame number {int(digits)}")
        files[int(digits)] = path
    if not files:
        raise DataError(f"{folder} holds no image ({', '.join(suffixes)})")
    return dict(sorted(files.items()))


def _check_same_frames(color: dict[int, Path], other: dict[int, Path]) -> None:
    """Raises DataError, naming the first frame that has no partner, unless both hold the same frame numbers."""
    unmatched = sorted(color.keys() ^ other.keys())
    if not unmatched:
        return
    first = unmatched[0]
    alone, missing = (color, other) if first in color else (other, color)
    folder_alone, folder_missing = (next(iter(files.values())).parent for files in (alone, missing))
    raise DataError(
        f"{folder_alone} holds {len(alone)} images and {folder_missing} {len(missing)}: frame {first} "
        f"({alone[first].name}) is not in {folder_missing.name}/; {len(unmatched)} frames have no partner"
    )


def _read_poses(path: Path, frames: int) -> list[TumLine] | None:
    """Each frame's line, which may be no pose; None without the file."""
    if not path.is_file():
        return None
    poses = read_tum_lines(path)
    if len(poses) != frames:
        raise DataError(
            f"{path} holds {len(poses)} poses, but color/ holds {frames} frames: one line a frame is needed"
        )
    return poses


def _read_class_names(path: Path) -> dict[int, str | None]:
    class_names: dict[int, str | None] = {}
    for key, entry in _read_json(path).items():
        if not key.isdecimal() or not 0 < int(key) < 2**16:
            raise DataError(f"{path}: an instance id is a whole number from 1 to 65535, found {key!r}")
        if not isinstance(entry, dict) or not isinstance(entry.get("class"), str | None):
            raise DataError(f'{path}: instance {key} must be {{"name": ..., "class": name or null}}, found {entry!r}')
        class_names[int(key)] = entry.get("class")
    return class_names
