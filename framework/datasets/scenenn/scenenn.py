"""SceneNN dataset (Hua et al., 3DV 2016).

Rooms were scanned with an Asus Xtion or a Kinect v2:

    NNN/image/image00001.png    8-bit color, numbered from 1
    NNN/depth/depth00001.png    uint16, mm, registered to color
    NNN/timestamp.txt           optional: number, timestamps of color and depth (microseconds)
    NNN/trajectory.log          T_world_camera, m; the pose with id i belongs to image i + 1
    NNN/NNN.ply, NNN/NNN.xml    optional: mesh with vertex labels, and the class of each label
    intrinsic/asus.ini          fx, fy, cx, cy; a file with intrinsics in NNN/, such as camera.json, takes precedence
    release.txt                 optional, one line: annotation release
    synthesize.json             parameters of `instancemap synthesize`, only in synthetic scenes

The images are extracted from oni/NNN.oni by the official playback or by `instancemap convert-oni`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np

from framework.data import AnnotatedObjects, Camera
from framework.datasets.calibration.own_camera import own_camera
from framework.datasets.frames.numbered_images import first_size, numbered_images, paired_images
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, StoredImages
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.datasets.ground_truth.labeled_recording import LabeledRecording
from framework.datasets.scenenn.scene_files import TrajectoryLog, read_intrinsics, read_timestamps, read_trajectory_log
from framework.datasets.scenenn.scenenn_annotation import LARGEST_ID, Annotated, read_annotation
from framework.detection.domain import RENDERED_ROOMS
from framework.errors import DataError
from framework.files.atomic_write import path_exists, read_text
from framework.files.image_files import read_color
from framework.files.ply import found_property, read_ply
from framework.sensors.noise_models import SensorKind
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

DEPTH_SCALE = 1000.0  # units per meter
MADE_BY = "synthesize.json"  # only in the root folder of synthetic scenes

NYU40_NAMES = {
    "fridge": "refridgerator",
    "structure": "otherstructure",
    "furniture": "otherfurniture",
    "prop": "otherprop",
}
"""Names of NYU40 with another spelling in SceneNN. SceneNN also writes underscores for spaces."""

log = logging.getLogger(__name__)


class SceneNNIntrinsics(Enum):
    """Intrinsics files of SceneNN, with the kind of the depth sensor as value."""

    ASUS = SensorKind.KINECT_V1
    KINECT2 = SensorKind.TIME_OF_FLIGHT


@dataclass
class SceneNN(LabeledRecording):
    """A SceneNN sequence, or a synthetic scene from `instancemap synthesize` in the same format.

    A frame is unusable if an image is missing, or if the sequence has a trajectory without a valid pose for the frame.
    """

    scene: str = "011"  # number of the scene
    intrinsics: SceneNNIntrinsics = SceneNNIntrinsics.ASUS  # intrinsics file
    # name of the annotation release, shown in tables, because the results of the two releases differ; "" = content of
    # ROOT/release.txt
    release: str = ""

    def open(self) -> Contents:
        if (self.root / MADE_BY).is_file():
            self.domain = RENDERED_ROOMS
        number = self.folder.resolve().name
        colors = numbered_images(self.folder / "image", (".png", ".jpg", ".jpeg"))
        images = paired_images(colors, numbered_images(self.folder / "depth", (".png",)))
        log_file = self.folder / "trajectory.log"
        poses = read_trajectory_log(log_file) if path_exists(log_file) else None
        times = _optional_times(self.folder / "timestamp.txt", list(images))
        self.load_mesh([self.folder / f"{number}.ply", self.folder / f"{number}.xml"], read_labeled_mesh)
        self.annotation = self.release or _named_release(self.root) if self.mesh else ""
        frames = [_recorded(pair, k - 1, poses, times.get(k)) for k, pair in images.items()]
        own = own_camera(self.name, self.folder, list(colors.values()), DEPTH_SCALE)
        if own is not None:
            camera, depth_scale, distortion, sensor = own.stored
            frames = [replace(frame, images=own.images(frame.images)) for frame in frames]
            return Contents(camera, own.source, depth_scale, frames, distortion, sensor)
        intrinsics = self.root / "intrinsic" / f"{self.intrinsics.name.lower()}.ini"
        log.info("%s: camera from %s", self.name, intrinsics)
        camera = Camera(*first_size(colors.values(), read_color), *read_intrinsics(intrinsics))
        return Contents(camera, "the first color image", DEPTH_SCALE, frames, sensor=self.intrinsics.value)


def _recorded(
    images: StoredImages, pose_id: int, poses: TrajectoryLog | None, times: tuple[float, float] | None
) -> RecordedFrame:
    """Return a frame with its pose and timestamps.

    Args:
        images: The images of the frame.
        pose_id: The id of the pose in trajectory.log.
        poses: The poses; None = no trajectory.
        times: The timestamps of color and depth, s; None = unknown.
    """
    color, depth = times or (None, None)
    timestamp = pose_id / FRAME_RATE if depth is None else depth
    T_world_camera = poses.poses.get(pose_id) if poses else None
    if poses is None or T_world_camera is not None:
        return RecordedFrame(images, timestamp, T_world_camera, color_timestamp=color, depth_timestamp=depth)
    why = poses.unusable.get(pose_id, "expected a pose in trajectory.log, got none")
    return RecordedFrame(images, timestamp, error=f"{images.color_name}: {why}")


def _optional_times(path: Path, images: Sequence[int]) -> Mapping[int, tuple[float, float]]:
    """Return the timestamps of color and depth, s, by image number.

    The result is empty if the timestamps of any image are missing.
    """
    if not path_exists(path):
        return {}
    times = read_timestamps(path)
    without = [k for k in images if k not in times]
    if not without:
        return times
    message = (
        "%s: expected timestamps of all images, got none for %d of %d images (first: %d); using a frame rate of %g Hz"
    )
    log.warning(message, path, len(without), len(images), without[0], FRAME_RATE)
    return {}  # recorded timestamps are not mixed with those of a constant frame rate


def read_labeled_mesh(mesh: Path, annotation: Path) -> LabeledMesh:
    """Read the mesh with its labels as instances.

    Instances of the nine evaluated classes have COCO names. Labels without a name or an annotation have the class None,
    so that detections there are not evaluated. Label 0 and labels of other classes, such as wall, become instance 0, so
    that detections there are false positives. `LabeledMesh.annotated` contains all labels, with the names of NYU40.

    Raises:
        DataError: A file cannot be read, or the mesh has no labels.
    """
    ply = read_ply(mesh)
    labels = ply.properties.get("label")
    if labels is None or labels.dtype.kind not in "iu":
        raise DataError(f"{mesh}: expected an integer vertex property 'label', got {found_property(ply, labels)}")
    if len(labels) and (int(labels.min()) < 0 or int(labels.max()) > LARGEST_ID):
        raise DataError(f"{mesh}: label: expected values in [0, {LARGEST_ID}], got {labels.min()} to {labels.max()}")
    names = {one.id: one for one in read_annotation(annotation)}
    present, inverse = np.unique(labels.astype(np.int32), return_inverse=True)
    unlisted = set(present.tolist()) - names.keys() - {0}
    if unlisted:
        message = (
            "%s: expected an entry in %s for each label, got none for %d labels, such as %d; these labels are not "
            "evaluated"
        )
        log.warning(message, mesh, annotation.name, len(unlisted), min(unlisted))
    class_names: dict[int, str | None] = {}
    own_names: dict[int, str | None] = {}
    ids = np.zeros(len(present), np.int32)
    for k, label in enumerate(present.tolist()):
        nyu_class = _nyu_class(names.get(label))
        if label:
            own_names[label] = NYU40_NAMES.get(nyu_class, nyu_class.replace("_", " ")) or None
        if label and (not nyu_class or nyu_class in SCENENN_TO_COCO):
            ids[k] = label
            class_names[label] = SCENENN_TO_COCO.get(nyu_class)
    annotated = AnnotatedObjects(present.astype(np.int32)[inverse], own_names, {})
    classes = tuple(SCENENN_TO_COCO.values())
    return LabeledMesh(ply.vertices, ply.triangles, ids[inverse], class_names, classes, annotated)


def _nyu_class(label: Annotated | None) -> str:
    """Return the NYU class of a label, or "" if unknown."""
    if label is None or not label.text.strip():
        return ""
    name = label.nyu_class.strip().lower()
    return "" if name == "unknown" else name


def _named_release(root: Path) -> str:
    path = root / "release.txt"
    text = read_text(path) if path_exists(path) else ""
    return text.strip().partition("\n")[0].strip() or "not named"
