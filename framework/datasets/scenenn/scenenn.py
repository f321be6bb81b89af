"""SceneNN (Hua et al., 3DV 2016): rooms scanned with an Asus Xtion or a Kinect v2, with labelled meshes.

    NNN/image/image00001.png    8-bit colour, from 1
    NNN/depth/depth00001.png    uint16, mm, registered to colour
    NNN/timestamp.txt           optional: number, time of colour, time of depth (microseconds)
    NNN/trajectory.log          T_world_camera, m; the pose with id i belongs to image i + 1
    NNN/NNN.ply, NNN/NNN.xml    optional: the mesh with a label for each vertex, and what the labels mean
    intrinsic/asus.ini          fx, fy, cx, cy
    release.txt                 optional, one line: the release of the annotation
    synthesize.json             only where `python -m framework synthesize` made it all: with which parameters

The images are those that the official play-back, or `python -m framework convert-oni`, extracts from oni/NNN.oni.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from framework.data import Camera
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, first_size, numbered_images, paired_images
from framework.datasets.frames.stored_frames import RecordedFrame, StoredImages
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh, LabeledRecording, mesh_of
from framework.datasets.scenenn.intrinsics import read_intrinsics
from framework.datasets.scenenn.scenenn_annotation import Annotated, read_annotation
from framework.datasets.scenenn.trajectory_log import TrajectoryLog, read_timestamps, read_trajectory_log
from framework.detection.domain import RENDERED_ROOMS
from framework.errors import DataError
from framework.files.atomic_write import is_there, read_text
from framework.files.image_files import read_color
from framework.files.ply import read_ply
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

DEPTH_SCALE = 1000.0  # units a metre
MOST_ID = np.iinfo(np.int32).max
MADE_BY = "synthesize.json"  # in the folder of rendered rooms

log = logging.getLogger(__name__)


class SceneNNSensor(StrEnum):
    """The camera of a recording: SceneNN has a file of intrinsics for each."""

    ASUS = "asus"
    KINECT2 = "kinect2"


@dataclass
class SceneNN(LabeledRecording):
    """A sequence of SceneNN, or of what `python -m framework synthesize` writes in its format.

    A frame that lacks an image, or a usable pose where there is a trajectory, cannot be used; a recording may have
    some. Truth is the labelled mesh, all of it, whatever frames are chosen.
    """

    scene: str = "011"  # the sequence
    sensor: SceneNNSensor = SceneNNSensor.ASUS  # names the file of intrinsics
    release: str = ""  # of the annotation, for tables: two exist and give other results; "" = what release.txt says

    def open(self) -> Contents:
        if (self.root / MADE_BY).is_file():
            self.domain = RENDERED_ROOMS
        number = self.folder.resolve().name
        colors = numbered_images(self.folder / "image", (".png", ".jpg", ".jpeg"))
        images = paired_images(
            colors,
            numbered_images(self.folder / "depth", (".png",)),
            lambda k: self.folder / "image" / f"image{k:05d}.png",
            lambda k: self.folder / "depth" / f"depth{k:05d}.png",
        )
        log_file = self.folder / "trajectory.log"
        poses = read_trajectory_log(log_file) if is_there(log_file) else None
        times = _optional_times(self.folder / "timestamp.txt", list(images))
        self.mesh = mesh_of([self.folder / f"{number}.ply", self.folder / f"{number}.xml"], read_labeled_mesh)
        if self.mesh is None and self.frame_ground_truth:
            raise DataError(f"dataset.frame_ground_truth needs {self.folder / number}.ply and .xml, the labelled mesh")
        self.annotation = self.release or _named_release(self.root) if self.mesh else ""
        frames = [_recorded(pair, k - 1, poses, times.get(k, (k - 1) / FRAME_RATE)) for k, pair in images.items()]
        ini = self.root / "intrinsic" / f"{self.sensor}.ini"
        fx, fy, cx, cy = read_intrinsics(ini)
        camera = Camera(*first_size(colors.values(), read_color), fx, fy, cx, cy)
        return Contents(camera, "the first colour image", DEPTH_SCALE, frames)


def _recorded(images: StoredImages, pose_id: int, poses: TrajectoryLog | None, timestamp: float) -> RecordedFrame:
    if poses is None:
        return RecordedFrame(images, timestamp)
    if pose_id in poses.poses:
        return RecordedFrame(images, timestamp, poses.poses[pose_id])
    why = poses.unusable.get(pose_id, "trajectory.log has no pose for it")
    return RecordedFrame(images, timestamp, fault=f"{images.color_name}: {why}")


def _optional_times(path: Path, images: Sequence[int]) -> Mapping[int, float]:
    """The times of all of these images, or of none: two clocks do not mix."""
    if not is_there(path):
        return {}
    times = read_timestamps(path)
    without = [k for k in images if k not in times]
    if not without:
        return times
    message = "%s has no time for %d of %d images, the first being %d: it is ignored, frames are taken to come at %g Hz"
    log.warning(message, path, len(without), len(images), without[0], FRAME_RATE)
    return {}


def read_labeled_mesh(mesh: Path, annotation: Path) -> LabeledMesh:
    """The mesh with its labels as instances: those of the nine classes under COCO's names.

    Labels that have no name, or that the annotation does not have, are instances of unknown class: what is found there
    is neither right nor wrong. Labels of other classes (wall, cabinet, ...) are known to be none of the nine: instance
    0, as is label 0. A detection of a class beyond the nine is neither right nor wrong. Raises DataError, naming the
    file, when one cannot be read or the mesh has no labels.
    """
    ply = read_ply(mesh)
    labels = ply.properties.get("label")
    if labels is None or labels.dtype.kind not in "iu":
        raise DataError(f"{mesh}: expected a vertex property `label` of whole numbers, found {sorted(ply.properties)}")
    if len(labels) and (labels.min() < 0 or labels.max() > MOST_ID):
        raise DataError(f"{mesh}: a label must be in [0, {MOST_ID}], found {labels.min()} to {labels.max()}")
    names = {one.id: one for one in read_annotation(annotation)}
    present, inverse = np.unique(labels.astype(np.int32), return_inverse=True)
    _warn_of_unlisted(mesh, annotation, set(present.tolist()) - names.keys() - {0})
    class_names: dict[int, str | None] = {}
    ids = np.zeros(len(present), np.int32)
    for k, label in enumerate(present.tolist()):
        if label and not _is_of_another_class(names.get(label)):
            ids[k] = label
            class_names[label] = SCENENN_TO_COCO.get(_nyu_class(names.get(label)))
    return LabeledMesh(ply.vertices, ply.triangles, ids[inverse], class_names, tuple(SCENENN_TO_COCO.values()))


def _warn_of_unlisted(mesh: Path, annotation: Path, labels: Collection[int]) -> None:
    if labels:
        message = (
            "%s: %s does not have %d of its labels, like %d: their classes are not known, and they are not evaluated"
        )
        log.warning(message, mesh, annotation.name, len(labels), min(labels))


def _nyu_class(label: Annotated | None) -> str:
    """Empty where nobody could name it."""
    if label is None or not label.text.strip():
        return ""
    name = label.nyu_class.strip().lower()
    return "" if name == "unknown" else name


def _is_of_another_class(label: Annotated | None) -> bool:
    name = _nyu_class(label)
    return bool(name) and name not in SCENENN_TO_COCO


def _named_release(root: Path) -> str:
    path = root / "release.txt"
    text = read_text(path) if is_there(path) else ""
    return text.strip().partition("\n")[0].strip() or "not named"
