"""The frames in which a true object is visible, with the results of its clusters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float64, Int32, Int64
from framework.evaluation.instances import MAX_DISTANCE
from framework.explanation.observation import FrameObservation
from framework.geometry import transform
from framework.mapping.submaps.submaps import remaining

MIN_PIXELS = 64  # minimum number of readings on an object that is seen; about the limit of real detectors


@dataclass(frozen=True)
class ObjectViews:
    """One object in the F frames in which it is visible. The clusters of an object are defined by `true_objects`."""

    frames: Int64  # (F,) Frame.index
    visible: Int64  # (F,) number of readings on it
    lost: Bool  # (F,) True = the pose is lost
    detectable: Bool  # (F,) True = the detector ran
    displacement: Float64  # (F,) m, by pose errors; NaN = unknown
    lifted: Int64  # (F,) number of points of its clusters on it, at most `visible`
    lifted_foreign: Int64  # (F,) number of their other points
    refined: Int64  # (F,) after refinement
    refined_foreign: Int64  # (F,)
    coverage: Float64  # (F,) largest fraction of its readings in one of its clusters, before refinement
    refined_iou: Float64  # (F,) largest IoU of one of its refined clusters with its readings
    largest: Int64  # (F,) number of points of its largest refined cluster
    covering: Int32  # (F,) another object in whose mask most of it is, 0 = none
    matched: tuple[Counter[int], ...]  # (F,) number of points of its refined clusters by instance; 0 = no instance
    classes: Counter[int]  # number of its clusters by class

    @property
    def seen(self) -> Bool:
        """True (F,) for the frames in which it is large enough to be detected."""
        return (self.visible >= MIN_PIXELS) & self.detectable

    @property
    def detected(self) -> Bool:
        return self.lifted > 0

    @property
    def in_place(self) -> Bool:
        """True (F,) for the fused frames in which pose errors displace it by at most MAX_DISTANCE."""
        return ~self.lost & ~(self.displacement > MAX_DISTANCE)  # NaN is in place

    @classmethod
    def of(
        cls,
        key: int,
        frames: Sequence[FrameObservation],
        motions: Mapping[int, Float64],
        merged: Mapping[int, int],
    ) -> ObjectViews:
        """Return the views of an object. The arguments are explained at `explain_objects`."""
        rows: list[tuple[int, ...]] = []
        displacements: list[float] = []
        ious: list[tuple[float, float]] = []
        matched: list[Counter[int]] = []
        classes = Counter[int]()
        for frame in frames:
            column = column_of(frame, key)
            if column < 0:
                continue
            own, visible = frame.objects == key, int(frame.visible[column])
            lifted, refined = frame.lifted[own], frame.refined[own]
            on_it = [int(counts[:, column + 1].sum()) for counts in (lifted, refined)]
            rows.append(
                (
                    *(frame.index, visible, frame.lost, frame.detected),
                    *(min(on_it[0], visible), int(lifted.sum()) - on_it[0]),
                    *(min(on_it[1], visible), int(refined.sum()) - on_it[1]),
                    int(refined.sum(axis=1).max(initial=0)),
                    covering_object(frame, column),
                )
            )
            displacements.append(displacement(frame.centers_camera[column], motions.get(frame.index)))
            coverage = float((lifted[:, column + 1] / max(visible, 1)).max(initial=0.0))
            ious.append((min(coverage, 1.0), best_iou(refined, column + 1, visible)))
            matched.append(points_of_instances(frame.instance_ids[own], refined.sum(axis=1), merged))
            classes.update(frame.class_ids[own].tolist())
        columns = np.array(rows, np.int64).reshape(-1, 10).T
        return cls(
            frames=columns[0],
            visible=columns[1],
            lost=columns[2] > 0,
            detectable=columns[3] > 0,
            displacement=np.array(displacements, np.float64),
            lifted=columns[4],
            lifted_foreign=columns[5],
            refined=columns[6],
            refined_foreign=columns[7],
            coverage=np.array(ious, np.float64).reshape(-1, 2)[:, 0],
            refined_iou=np.array(ious, np.float64).reshape(-1, 2)[:, 1],
            largest=columns[8],
            covering=columns[9].astype(np.int32),
            matched=tuple(matched),
            classes=classes,
        )


def column_of(frame: FrameObservation, key: int) -> int:
    """Return the position of an object in the arrays of a frame, -1 = not visible."""
    column = int(np.searchsorted(frame.truth_ids, key))
    return column if column < len(frame.truth_ids) and frame.truth_ids[column] == key else -1


def best_iou(counts: Int64, column: int, visible: int) -> float:
    """Return the largest IoU of N clusters with an object, given its column in their `counts` (N, 1 + T)."""
    ious = counts[:, column] / np.maximum(visible + counts.sum(axis=1) - counts[:, column], 1)
    return float(ious.max(initial=0.0))


def covering_object(frame: FrameObservation, column: int) -> int:
    """Return another object in whose mask most of an object is, 0 = none."""
    most = 2 * frame.lifted[:, column + 1] > frame.visible[column]
    others = frame.objects[most & (frame.objects != frame.truth_ids[column]) & (frame.objects > 0)]
    return int(others[0]) if len(others) else 0


def displacement(center_camera: Float64, motion: Float64 | None) -> float:
    """Return the length of the motion (4, 4) of a point (3,) of the camera frame, m; NaN without a motion."""
    if motion is None:
        return np.nan
    return float(np.linalg.norm(transform(motion, center_camera[None])[0] - center_camera))


def points_of_instances(instance_ids: Int32, counts: Int64, merged: Mapping[int, int]) -> Counter[int]:
    """Return the number of points by remaining instance, 0 = no instance.

    Args:
        instance_ids: The instance (N,) of each cluster.
        counts: The number of points (N,) of each cluster.
        merged: The instance into which each merged instance was merged.
    """
    found = Counter[int]()
    for instance_id, count in zip(instance_ids.tolist(), counts.tolist(), strict=True):
        found[remaining(instance_id, merged)] += count
    return +found  # without instances that have no points


@dataclass(frozen=True)
class InstancePoints:
    """The clusters that were matched with one instance of the map."""

    observations: int  # number of frames
    clusters: Counter[int]  # number of clusters by true object; 0 = on no object
    points: Counter[int]  # number of refined points by true object; 0 = on no object
    cluster_points: Counter[int]  # number of refined points by the true object of their cluster; 0 = none
    lifted: Counter[int]  # number of points on the object of the cluster before refinement, by true object
    visible: Counter[int]  # number of readings on the object of the cluster in these frames, by true object


def instance_points(instance_id: int, frames: Sequence[FrameObservation], merged: Mapping[int, int]) -> InstancePoints:
    """Return the clusters that were matched with an instance, or with an instance that was merged into it."""
    observations = 0
    clusters, points, cluster_points = Counter[int](), Counter[int](), Counter[int]()
    lifted, visible = Counter[int](), Counter[int]()
    members = {k for k in merged if remaining(k, merged) == instance_id} | {instance_id}
    for frame in frames:
        chosen = np.isin(frame.instance_ids, list(members))
        if not chosen.any():
            continue
        observations += 1
        clusters.update(frame.objects[chosen].tolist())
        counts = frame.refined[chosen].sum(axis=0)
        points.update(dict(zip([0, *frame.truth_ids.tolist()], counts.tolist(), strict=True)))
        sizes = frame.refined[chosen].sum(axis=1).tolist()
        for key, size in zip(frame.objects[chosen].tolist(), sizes, strict=True):
            cluster_points[key] += size
        for key in {*frame.objects[chosen].tolist()} - {0}:
            column = column_of(frame, key)
            lifted[key] += int(frame.lifted[chosen & (frame.objects == key), column + 1].sum())
            visible[key] += int(frame.visible[column])
    return InstancePoints(observations, clusters, +points, cluster_points, lifted, visible)
