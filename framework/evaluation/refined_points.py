"""Evaluation of a refiner on one frame: point counts and fit to the ground-truth masks."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from framework.data import Bool, Detections, Float64, Frame, FrameTruth, Int32, PointClusters, Pose
from framework.interfaces import ClusterRefiner
from framework.refinement.lifting import lift
from framework.refinement.refine import refine

TIMED_CALLS = 5  # number of timed calls for the median; an untimed call before them compiles the kernels


@dataclass(frozen=True)
class Refinement:
    """The N point clusters of one frame before refinement and the M clusters after it.

    Refiners may split clusters.
    """

    frame: Frame
    before: PointClusters
    after: PointClusters
    milliseconds: float  # median run time of the refiner, ms

    @classmethod
    def of(cls, refiner: ClusterRefiner, detections: Detections, frame: Frame) -> Refinement:
        """Return the clusters of detections before and after refinement.

        Points are in the world frame, or in the camera frame for a frame without a ground-truth pose.
        """
        pose = Pose(np.eye(4) if frame.T_world_camera is None else frame.T_world_camera)
        before = lift(detections, frame, pose)
        after = refine(refiner, before, frame)
        times = []
        for _ in range(TIMED_CALLS):
            started = time.perf_counter()
            refine(refiner, before, frame)
            times.append(1e3 * (time.perf_counter() - started))
        return cls(frame, before, after, statistics.median(times))

    @cached_property
    def origin(self) -> Int32:
        """Index (M,) of the original cluster of each refined cluster, or -1 for none.

        If the number of clusters does not change, refined cluster k comes from original cluster k. Otherwise, each
        refined cluster comes from the original cluster with the most common pixels.
        """
        n, m = len(self.before), len(self.after)
        if n == m or n == 0:
            return np.arange(m, dtype=np.int32) if n == m else np.full(m, -1, np.int32)
        shared = (_membership(self.before, self.frame) @ _membership(self.after, self.frame).T).toarray()
        return np.where(shared.any(axis=0), shared.argmax(axis=0), -1).astype(np.int32)

    @cached_property
    def main_part(self) -> Int32:
        """Index (N,) of the largest refined cluster of each original cluster, or -1 for none."""
        sizes = point_counts(self.after)
        largest_last = np.argsort(sizes, kind="stable")
        main = np.full(len(self.before), -1, np.int32)
        of_some = largest_last[self.origin[largest_last] >= 0]
        main[self.origin[of_some]] = of_some
        return main

    @cached_property
    def points_before(self) -> Int32:
        """Point count (N,) of each original cluster."""
        return point_counts(self.before)

    @cached_property
    def points_after(self) -> Int32:
        """Point count (N,) after refinement, summed over the refined clusters of each original cluster."""
        known = self.origin >= 0
        sums = np.bincount(self.origin[known], point_counts(self.after)[known], minlength=len(self.before))
        return sums.astype(np.int32)

    @cached_property
    def fit_before(self) -> TrueFit | None:
        """Fit of the original clusters, or None without ground-truth instances."""
        return None if self.frame.truth is None else true_fit(self.before, self.frame, self.frame.truth)

    @cached_property
    def fit_after(self) -> TrueFit | None:
        """Fit of the refined clusters, or None without ground-truth instances."""
        return None if self.frame.truth is None else true_fit(self.after, self.frame, self.frame.truth)

    @cached_property
    def judged_before(self) -> Bool:
        """Mask (N,) of the evaluated original clusters, all False without ground truth.

        A cluster is not evaluated if an object of unknown class fits best.
        """
        fit = self.fit_before
        return np.zeros(len(self.before), np.bool_) if fit is None else ~fit.unknown

    @cached_property
    def judged_after(self) -> Bool:
        """Mask (M,) of the refined clusters with an evaluated original cluster, all False without ground truth."""
        fit = self.fit_after
        if fit is None:
            return np.zeros(len(self.after), np.bool_)
        return np.where(self.origin >= 0, np.append(self.judged_before, False)[self.origin], ~fit.unknown)


@dataclass(frozen=True)
class TrueFit:
    """The fit of N clusters to the best-fitting ground-truth objects of known class."""

    iou: Float64  # (N,) intersection over union with the object; 0 for an empty cluster
    points_inside: Int32  # (N,) number of the cluster's points on the object
    unknown: Bool  # (N,) True where an object of unknown class fits better, so that the cluster is not evaluated


def point_counts(clusters: PointClusters) -> Int32:
    """Return the number of points (N,) of each cluster."""
    return np.bincount(clusters.cluster[clusters.cluster >= 0], minlength=len(clusters)).astype(np.int32)


def pixel_index(clusters: PointClusters, frame: Frame) -> Int32:
    """Return the row-major pixel index (P,) of each point."""
    return clusters.pixels[:, 1] * frame.camera.width + clusters.pixels[:, 0]


def _membership(clusters: PointClusters, frame: Frame) -> csr_array:
    """Return a sparse matrix (N, H * W) that is 1 where a cluster has a point at a pixel."""
    held = clusters.cluster >= 0
    entries = clusters.cluster[held], pixel_index(clusters, frame)[held]
    return csr_array((np.ones(held.sum(), np.int32), entries), (len(clusters), frame.depth.size))


def true_fit(clusters: PointClusters, frame: Frame, truth: FrameTruth) -> TrueFit:
    """Return the fit of each cluster to the best-fitting ground-truth object.

    Pixels without depth are ignored, because clusters contain no such pixels.
    """
    ids = np.where(frame.depth > 0, truth.instance_ids, 0).ravel()
    objects, of_pixel, areas = np.unique(ids, return_inverse=True, return_counts=True)
    n, held = len(clusters), clusters.cluster >= 0
    pairs = clusters.cluster[held].astype(np.int64) * len(objects) + of_pixel[pixel_index(clusters, frame)[held]]
    both = np.bincount(pairs, minlength=n * len(objects)).reshape(n, len(objects))
    iou = both / np.maximum(both.sum(axis=1, keepdims=True) + areas - both, 1)
    known = np.array([truth.class_names.get(key) is not None for key in objects.tolist()], np.bool_) & (objects != 0)
    others = iou[:, ~known & (objects != 0)].max(axis=1, initial=0.0)
    if not known.any():
        return TrueFit(np.zeros(n), np.zeros(n, np.int32), others > 0)
    best = iou[:, known].argmax(axis=1)[:, None]
    best_iou = np.take_along_axis(iou[:, known], best, axis=1)[:, 0]
    inside = np.take_along_axis(both[:, known], best, axis=1)[:, 0]
    return TrueFit(best_iou, inside.astype(np.int32), others > best_iou)
