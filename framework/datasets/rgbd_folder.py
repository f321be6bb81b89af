"""RGB-D videos as folders of color and depth images.

This is the format for your own data:

    camera.json         {"width", "height", "fx", "fy", "cx", "cy", "depth_scale"}; meters = value / depth_scale;
                        optional "distortion": [k1, k2, p1, p2, k3] of all images, which are undistorted on reading;
                        optional "sensor": kind of the depth sensor, such as "REALSENSE_D435"; default "KINECT_V1"
    color/000000.jpg    JPEG or PNG, 8-bit
    depth/000000.png    uint16, registered to color, along z; 0 or 65535 = no reading; or .tif, .tiff or .npy of
                        uint16; or .tif, .tiff, .npy or .exr of floats, which are in meters
    poses.txt           optional; TUM format, T_world_camera, one line per frame: timestamp tx ty tz qx qy qz qw; or
                        EuRoC or KITTI format; only zeros = unknown
    pose/000000.txt     optional, without poses.txt; T_world_camera, a 4x4 matrix per frame
    timestamps.txt      optional; color depth, one line per frame: timestamps of the two images, s, or one for both;
                        or times.txt
    gravity.txt         optional; x y z, one line per frame: up direction in the camera frame, from a sensor;
                        nan nan nan = unknown
    instance/000000.png, instances.json     optional ground truth: uint16 ids, {"<id>": {"name", "class"}}; class = a
                                            COCO name or another name, null = unknown

The files of a frame have the same number in their names. Numbers may start at any value and have gaps. Names with
timestamps, such as 1305031102.175304.png, are invalid. Line k of poses.txt, timestamps.txt and gravity.txt belongs to
the k-th frame in ascending order. Comments and empty lines are not counted. EXIF orientations are not applied.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from framework.data import DeferredTruth, Float64, FrameTruth, Int32, SceneTruth
from framework.datasets.calibration.camera_json import read_camera
from framework.datasets.frames.numbered_images import numbered_images
from framework.datasets.frames.pose_folder import POSE_FOLDERS, read_pose_folder
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, Recording, StoredImages
from framework.datasets.ground_truth.named_truth import read_class_names
from framework.datasets.ground_truth.scene_truth import LabeledDepth, check_truth_voxel, fuse_scene_truth
from framework.errors import DataError, FrameError
from framework.files.atomic_write import path_exists
from framework.files.depth_files import DEPTH_SUFFIXES, FARTHEST, read_depth
from framework.files.image_files import UPRIGHT, decode_uint16, exif_orientation, read_image_file
from framework.files.number_lines import read_gravity, read_image_times
from framework.files.pose_lines import PoseLine, read_pose_lines
from framework.files.storage import check_storage
from framework.files.tum_trajectory import TumLine

TIMES = ("timestamps.txt", "times.txt")  # names of the file with timestamps, in order of preference
LARGEST_ID = 2**16 - 1  # maximum instance id; instance-ID images are uint16

_POSES = re.compile("traj|.*pose", re.IGNORECASE)  # matches names of files that probably contain poses

Entry = TypeVar("Entry")
log = logging.getLogger(__name__)


@dataclass
class RgbdFolder(Recording):
    """An RGB-D video in a folder of images, with optional poses and instance ground truth."""

    ground_truth_spacing: float = 0.02  # spacing of the ground-truth surface points, m, in [0.001, 1]

    def __post_init__(self) -> None:
        check_truth_voxel(self.ground_truth_spacing)
        super().__post_init__()

    def open(self) -> Contents:
        path = self.folder / "camera.json"
        if not path.is_file():
            expected = "expected a camera next to color/ and depth/, got no such file"
            raise DataError(f"{path}: {expected}; write it as in docs/tutorials/own_data.md")
        camera, depth_scale, distortion, sensor = read_camera(path)
        color = numbered_images(self.folder / "color", (".jpg", ".jpeg", ".png"))
        has_png = any((self.folder / "depth").glob("*.[pP][nN][gG]"))  # other files may be copies of the same images
        depth = numbered_images(self.folder / "depth", (".png",) if has_png else DEPTH_SUFFIXES)
        _check_same_frames(color, depth)
        _log_orientation(next(iter(color.values())))
        if self._is_float(list(depth.values())):
            depth_scale = 1.0
        self._class_names, self._instances = self._read_instances(color)
        lines = _read_optional(self.folder / "poses.txt", _pose_lines, "poses", len(color))
        ups = _read_optional(self.folder / "gravity.txt", read_gravity, "directions", len(color))
        times = None
        for name in TIMES:
            times = times or _read_optional(self.folder / name, read_image_times, "timestamps", len(color))
        poses = self._read_poses(lines, list(color))
        self._has_poses = poses is not None
        frames = []
        for k, number in enumerate(color):
            images = StoredImages.of_files(color[number], depth[number])
            color_time, depth_time = times[k] if times else (None, None)
            timestamp = k / FRAME_RATE if color_time is None else color_time
            if lines and not math.isnan(lines[k].timestamp):
                timestamp = lines[k].timestamp
            frame = RecordedFrame.posed(images, timestamp, poses[k] if poses else lambda: None)
            up = ups[k] if ups else None
            frames.append(replace(frame, up=up, color_timestamp=color_time, depth_timestamp=depth_time))
        return Contents(camera, path, depth_scale, frames, distortion, sensor)

    def _read_poses(
        self, lines: Sequence[PoseLine] | None, numbers: Sequence[int]
    ) -> Sequence[Callable[[], Float64 | None]] | None:
        """Return the pose of each frame from poses.txt or from a folder of matrices, or None without poses.

        Poses of zeros are unknown.
        """
        if lines is None:
            poses = read_pose_folder(self.folder, numbers)
            unread = sorted(path.name for path in self.folder.iterdir() if _POSES.match(path.name))
            if poses is None and unread and unread[0] not in POSE_FOLDERS:
                expected = "expected poses in poses.txt or pose/"
                log.warning("%s: %s, got %s, which is not read", self.folder, expected, ", ".join(unread))
            return poses
        unread = sorted(name for name in POSE_FOLDERS if (self.folder / name).is_dir())
        if unread:
            log.info("%s: poses are read from poses.txt; %s/ is not read", self.folder, unread[0])
        zeros = sum(line.is_zero for line in lines)
        if zeros:
            where = self.folder / "poses.txt"
            log.warning("%s: %d of %d poses contain only zeros and count as unknown", where, zeros, len(lines))
        return None if zeros == len(lines) else [_pose_of(line) for line in lines]

    def _is_float(self, paths: Sequence[Path]) -> bool:
        """Return True if depth images contain floats in meters.

        Raises:
            DataError: The first readable image contains another unit than meters.
        """
        if all(path.suffix.lower() == ".png" for path in paths):
            return False
        for path in paths:
            try:
                depth = read_depth(path)
            except FrameError:
                continue  # a damaged image is counted when the frame is read
            if depth.dtype == np.uint16:
                return False
            found = depth[np.isfinite(depth) & (depth > 0)]
            middle = float(np.median(found)) if len(found) else 0.0
            if middle > FARTHEST and not self.depth_reading.depth_scale:
                raise DataError(
                    f"{path}: expected float depth in meters, got a median of {middle:.6g}; set "
                    "dataset.depth_scale=1000 if it is in millimeters, or 100 if it is in centimeters"
                )
            return True
        return False

    def truth_in(self, index: int) -> FrameTruth | None:
        if not self._instances:
            return None
        path = self._instances[index]
        data = read_image_file(path)

        def decode() -> Int32:
            ids: Int32 = self.calibration.labels(decode_uint16(path, data), path).astype(np.int32)
            unknown = [int(i) for i in np.flatnonzero(np.bincount(ids.ravel())) if i and i not in self._class_names]
            if unknown:
                raise FrameError(f"{path}: expected instance ids in {self.folder / 'instances.json'}, got {unknown[0]}")
            return ids

        origin = f"{hashlib.sha256(data).hexdigest()} {self.camera!r} {self.calibration.distortion!r}"
        return DeferredTruth(decode, self.camera.shape, self._class_names, origin, of_depth=False)

    def own_scene_truth(self) -> SceneTruth | None:
        """Return ground-truth points fused from the depth and instance images of the selected frames.

        The result is None without instances or poses. Unreadable frames are skipped.
        """
        if not self._instances or not self._has_poses:
            return None
        return fuse_scene_truth(self._labeled_depth(), self._class_names, self.ground_truth_spacing)

    def _labeled_depth(self) -> Iterator[LabeledDepth]:
        for index in self.chosen:
            recorded = self.contents.frames[index]
            try:
                if recorded.error:
                    raise FrameError(f"frame {index}: {recorded.error}")
                depth, truth = self.metric_depth(index), self.truth_in(index)
                ids = None if truth is None else truth.instance_ids
            except FrameError as error:
                check_storage(error, self.folder)
                log.warning("ground truth: frame skipped: %s", error)
                continue
            if ids is not None and recorded.T_world_camera is not None:
                yield LabeledDepth(depth, ids, self.camera, recorded.T_world_camera)

    def _read_instances(self, color: dict[int, Path]) -> tuple[dict[int, str | None], list[Path]]:
        """Return the class of each instance id and the path of each instance image.

        Both are empty if the folder has no ground truth or `ground_truth` is set.
        """
        folder, names = self.folder / "instance", self.folder / "instances.json"
        if self.named_truth is not None or (not path_exists(folder) and not path_exists(names)):
            return {}, []
        if not path_exists(names):
            raise DataError(f"{names}: expected the class of each instance in {folder}, got no such file")
        class_names = read_class_names(names, LARGEST_ID)
        images = numbered_images(folder, (".png",))
        _check_same_frames(color, images)
        return class_names, list(images.values())


def _pose_of(line: PoseLine) -> Callable[[], Float64 | None]:
    if line.is_zero:
        return lambda: None
    return line.pose if isinstance(line, TumLine) else line.stored_pose


def _log_orientation(path: Path) -> None:
    """Log the EXIF orientation of the first color image, which is not applied."""
    orientation = exif_orientation(path)
    if orientation != UPRIGHT:
        log.warning("%s: the EXIF orientation %d is not applied; the pixels are used as stored", path, orientation)


def _pose_lines(path: Path) -> list[PoseLine]:
    return list(read_pose_lines(path)[1])


def _check_same_frames(color: dict[int, Path], other: dict[int, Path]) -> None:
    """Raise DataError if two folders contain different frame numbers."""
    unmatched = sorted(color.keys() ^ other.keys())
    if not unmatched:
        return
    first = unmatched[0]
    alone, missing = (color, other) if first in color else (other, color)
    folder_alone, folder_missing = (next(iter(files.values())).parent for files in (alone, missing))
    raise DataError(
        f"{folder_missing}: expected the frames of {folder_alone} ({len(alone)} images), got {len(missing)} images and "
        f"none for frame {first} ({alone[first].name}); {len(unmatched)} frames unmatched"
    )


def _read_optional(path: Path, read: Callable[[Path], list[Entry]], name: str, frames: int) -> list[Entry] | None:
    """Return the entries of a file with one line per frame, or None if the file does not exist."""
    if not path_exists(path):
        return None
    entries = read(path)
    if len(entries) != frames:
        raise DataError(f"{path}: expected one line per frame, got {len(entries)} {name} for {frames} frames in color/")
    return entries
