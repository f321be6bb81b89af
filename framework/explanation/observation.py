"""Observation of the stages of a run in progress, compared with the true objects of each frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from framework.data import Bool, Detections, Float32, Float64, Frame, Int32, Int64, PointClusters, Pose
from framework.detection.true_instances import count_points, frame_truth, objects_of_counts
from framework.errors import ConfigError, DataError
from framework.interfaces import ClusterRefiner, Viewer
from framework.mapping.instances.association import Association
from framework.mapping.instances.instance_list import InstanceTableMap
from framework.pipeline import Pipeline


@dataclass(frozen=True)
class FrameObservation:
    """The N clusters of a frame, compared with its T visible true objects."""

    index: int  # Frame.index
    lost: bool  # True = the frame is not fused, because its pose is lost
    detected: bool  # True = the detector ran
    truth_ids: Int32  # (T,) ascending
    visible: Int64  # (T,) number of depth readings on each object
    centers_camera: Float64  # (T, 3) mean of these readings, m
    class_ids: Int32  # (N,) most likely class of each detection
    objects: Int32  # (N,) true object of each cluster, 0 = none
    lifted: Int64  # (N, 1 + T) number of points of each cluster on each object, before refinement; column 0 = on none
    refined: Int64  # (N, 1 + T) after refinement; 0 if the frame is lost
    instance_ids: Int32  # (N,) matched instance of the map, 0 = none


@dataclass
class ObservedRefiner(ClusterRefiner):
    """Refiner that keeps the clusters before refinement."""

    refiner: ClusterRefiner
    before: PointClusters | None = field(default=None, init=False)  # of the last refined frame

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        self.before = clusters
        return self.refiner.refine(clusters, frame)


class Observer(Viewer):
    """Viewer that records the results of the stages in each frame."""

    def __init__(self, refiner: ObservedRefiner, association: Association, scene: InstanceTableMap) -> None:
        self.refiner = refiner
        self.scene = scene
        self.association = association
        self.frames: list[FrameObservation] = []
        self.class_names: dict[int, str | None] = {}  # by true object; None = unknown

    @classmethod
    def of(cls, pipeline: Pipeline) -> Observer:
        """Return an observer of a pipeline, whose refiner and viewer are replaced.

        Raises:
            ConfigError: The fuser does not associate clusters with instances.
        """
        association = getattr(pipeline.fuser, "association", None)
        scene = pipeline.fuser.scene
        if not isinstance(association, Association) or not isinstance(scene, InstanceTableMap):
            raise ConfigError(
                f"fuser: expected a fuser with data association, got {type(pipeline.fuser).__name__}; explain a run of "
                "fuser=bayesian_tsdf"
            )
        refiner = ObservedRefiner(pipeline.refiner)
        observer = cls(refiner, association, scene)
        pipeline.refiner, pipeline.viewer = refiner, observer
        return observer

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        truth = frame_truth(frame)
        self.class_names |= truth.class_names
        has_depth = frame.depth > 0
        ids = np.where(has_depth, truth.instance_ids, 0)
        truth_ids = np.unique(ids[ids > 0]).astype(np.int32)
        visible, centers = visible_objects(ids, frame, truth_ids)
        if pose.lost:
            lifted = count_mask_pixels(detections.masks & has_depth, ids, truth_ids)
            refined, instance_ids = np.zeros_like(lifted), np.zeros(len(detections), np.int32)
        else:
            matches = self.association.matches
            if matches is None:
                raise DataError(f"frame {frame.index}: expected matches of the fuser's association, got none")
            clusters, before = matches.clusters, self.refiner.before
            if before is None or clusters.exact or not clusters.detected:  # not refined
                before = clusters
            lifted = count_points(before, truth.instance_ids, truth_ids)
            refined = count_points(clusters, truth.instance_ids, truth_ids)
            instance_ids = matches.instance_ids.copy()
        self.frames.append(
            FrameObservation(
                index=frame.index,
                lost=pose.lost,
                detected=detections.detected,
                truth_ids=truth_ids,
                visible=visible,
                centers_camera=centers,
                class_ids=most_likely(detections.class_probabilities),
                objects=objects_of_counts(lifted, truth_ids),
                lifted=lifted,
                refined=refined,
                instance_ids=instance_ids,
            )
        )


def visible_objects(ids: Int32, frame: Frame, truth_ids: Int32) -> tuple[Int64, Float64]:
    """Return the number of depth readings (T,) and their mean (T, 3), m, in the camera frame, of each object.

    Args:
        ids: The object (H, W) at each depth reading, 0 = none.
        frame: The frame.
        truth_ids: The objects (T,), ascending.
    """
    v, u = np.nonzero(ids)
    index = np.searchsorted(truth_ids, ids[v, u])
    counts = np.bincount(index, minlength=len(truth_ids))
    z = frame.depth[v, u].astype(np.float64)
    camera = frame.camera
    points = ((u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z)
    sums = np.stack([np.bincount(index, axis, minlength=len(truth_ids)) for axis in points], axis=1)
    return counts, sums / counts[:, None]


def count_mask_pixels(masks: Bool, ids: Int32, truth_ids: Int32) -> Int64:
    """Return the number of pixels (N, 1 + T) of each mask on each object, as `count_points` does for clusters."""
    columns = np.where(ids > 0, np.searchsorted(truth_ids, ids) + 1, 0)
    counts = [np.bincount(columns[mask], minlength=len(truth_ids) + 1) for mask in masks]
    return np.array(counts, np.int64).reshape(len(masks), len(truth_ids) + 1)


def most_likely(class_probabilities: Float32) -> Int32:
    """Return the most likely class (N,) of each detection, given the distributions (N, C)."""
    if not class_probabilities.size:
        return np.zeros(len(class_probabilities), np.int32)
    return np.asarray(class_probabilities.argmax(axis=1), np.int32)
