"""Ground-truth instances of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Frame, FrameTruth, Int32, Int64, PointClusters
from framework.errors import DataError

MIN_OBJECT_FRACTION = 0.25  # minimum fraction of the points of a cluster on its ground-truth object


@dataclass(frozen=True)
class TrueInstances:
    """The N visible ground-truth instances of known class.

    They are sorted by decreasing number of pixels, then by id.
    """

    ids: Int32  # (N,)
    class_ids: Int32  # (N,) index into the detector's classes
    masks: Bool  # (N, H, W)

    def __len__(self) -> int:
        return len(self.ids)


def true_instances(frame: Frame, classes: Sequence[str], min_pixels: int = 1) -> TrueInstances:
    """Return the visible ground-truth instances of a frame.

    Args:
        frame: The frame.
        classes: The class names of the detector.
        min_pixels: The minimum number of pixels of an instance.

    Raises:
        DataError: The sequence has no instance ground truth, or a class is missing from `classes`.
    """
    truth = frame_truth(frame)
    index = {name: k for k, name in enumerate(classes)}
    names = {i: name for i, name in truth.class_names.items() if i != 0 and name is not None}
    unknown = sorted({name for name in names.values() if name not in index})
    if unknown:
        raise DataError(
            f"frame {frame.index}: expected ground-truth classes among the {len(classes)} classes of the detector, got "
            f"{', '.join(map(repr, unknown))}; list all names in a file and set detector.label_space to this file"
        )

    found, areas = np.unique(truth.instance_ids, return_counts=True)
    chosen = np.array([i in names for i in found.tolist()], np.bool_) & (areas >= min_pixels)
    found = found[chosen][np.argsort(-areas[chosen], kind="stable")]
    return TrueInstances(
        ids=found.astype(np.int32),
        class_ids=np.array([index[names[i]] for i in found.tolist()], np.int32),
        masks=truth.instance_ids == found[:, None, None],
    )


def frame_truth(frame: Frame) -> FrameTruth:
    """Return the ground-truth instances at the pixels of a frame.

    Raises:
        DataError: The sequence has no instance ground truth.
    """
    if frame.truth is None:
        raise DataError(
            f"frame {frame.index}: expected instance ground truth, got none; set dataset.frame_ground_truth=true "
            "(scenenn, scannet) or dataset.ground_truth=PATH, or choose another dataset or stage"
        )
    return frame.truth


def count_points(clusters: PointClusters, instance_ids: Int32, truth_ids: Int32) -> Int64:
    """Return the number of points (N, 1 + T) of each cluster on each ground-truth instance.

    Column 0 counts the points on other instances and on no instance.

    Args:
        clusters: The N clusters.
        instance_ids: The ground-truth instance (H, W) at each pixel, 0 = none.
        truth_ids: The T instances (T,), ascending and positive.
    """
    columns = 1 + len(truth_ids)
    of_cluster = clusters.cluster >= 0
    u, v = clusters.pixels[of_cluster].T
    found = instance_ids[v, u]
    column = np.searchsorted(truth_ids, found)
    is_known = np.append(truth_ids, 0)[column] == found
    keys = clusters.cluster[of_cluster].astype(np.int64) * columns + np.where(is_known & (found > 0), column + 1, 0)
    return np.bincount(keys, minlength=len(clusters) * columns).reshape(len(clusters), columns)


def objects_of_counts(counts: Int64, truth_ids: Int32) -> Int32:
    """Return the ground-truth object (N,) of each cluster, 0 = none.

    The object has most of the points that are on an instance, and at least MIN_OBJECT_FRACTION of all points. Ties go
    to the smaller id.

    Args:
        counts: The numbers of points (N, 1 + T), from `count_points`.
        truth_ids: The instances (T,) of the columns.
    """
    if not len(truth_ids) or not len(counts):
        return np.zeros(len(counts), np.int32)
    best = counts[:, 1:].argmax(axis=1)
    most = counts[np.arange(len(counts)), best + 1]
    is_on_object = (most > 0) & (most >= MIN_OBJECT_FRACTION * counts.sum(axis=1))
    return np.where(is_on_object, truth_ids[best], 0).astype(np.int32)


def true_objects(clusters: PointClusters, frame: Frame) -> Int32:
    """Return the ground-truth object (N,) of each cluster of a frame, 0 = none. See `objects_of_counts`.

    Raises:
        DataError: The sequence has no instance ground truth.
    """
    instance_ids = frame_truth(frame).instance_ids
    truth_ids = np.unique(instance_ids[instance_ids > 0])
    return objects_of_counts(count_points(clusters, instance_ids, truth_ids), truth_ids)
