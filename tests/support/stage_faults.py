"""Stages with an injected fault, and the explanation of runs with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from framework.data import Detections, Float64, Frame, PointClusters, Pose, SceneTruth
from framework.detection.true_instances import frame_truth, objects_of_counts, true_objects
from framework.evaluation.compared_classes import ComparedClasses
from framework.explanation.contributions import Stage
from framework.explanation.observation import count_mask_pixels
from framework.explanation.replay import Explanation, PipelineFactory, Replays
from framework.interfaces import ClusterRefiner, Detector, PoseTracker, RGBDSequence, SceneMap
from framework.mapping.instances.association import Association, Matches
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.overlaps import Overlaps
from framework.mapping.labels.pixel_lists import PixelLists
from framework.pipeline import Pipeline
from framework.refinement.refine import keep_points

HALF = 0.4  # fraction of the true points of an object that a halving refiner keeps


@dataclass
class HidingDetector(Detector):
    """Detector without the detections of one object."""

    detector: Detector
    hidden: int  # true object

    def __post_init__(self) -> None:
        self.classes = self.detector.classes

    def detect(self, frame: Frame) -> Detections:
        found = self.detector.detect(frame)
        ids = frame_truth(frame).instance_ids
        truth_ids = np.unique(ids[ids > 0])
        kept = objects_of_counts(count_mask_pixels(found.masks, ids, truth_ids), truth_ids) != self.hidden
        return replace(
            found,
            masks=found.masks[kept],
            boxes=found.boxes[kept],
            scores=found.scores[kept],
            class_probabilities=found.class_probabilities[kept],
        )


@dataclass
class HalvingRefiner(ClusterRefiner):
    """Refiner that removes more than half of one object: the points with larger x than HALF of its true points."""

    refiner: ClusterRefiner
    halved: int  # true object
    truth: SceneTruth

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        refined = self.refiner.refine(clusters, frame)
        x = np.quantile(self.truth.points_world[self.truth.instance_ids == self.halved, 0], HALF)
        objects = np.append(true_objects(refined, frame), 0)[refined.cluster]
        return keep_points(refined, (objects != self.halved) | (refined.points_world[:, 0] < x))


@dataclass
class MergingAssociation(Association):
    """Association that matches the clusters of two objects with one instance."""

    merged: tuple[int, int] = field(default=(0, 0), init=False)  # true objects
    frame: Frame | None = field(default=None, init=False)
    instance: int = field(default=0, init=False)  # their instance, 0 = none yet

    def match(self, scene: object, frame: Frame, pose: Pose, clusters: PointClusters) -> tuple[PixelLists, Matches]:
        self.frame = frame
        return super().match(scene, frame, pose, clusters)  # type: ignore[arg-type]

    def associate(
        self,
        table: InstanceTable,
        overlaps: Overlaps,
        clusters: PointClusters,
        frame_index: int,
        camera_center: Float64,
    ) -> Matches:
        matches = super().associate(table, overlaps, clusters, frame_index, camera_center)
        assert self.frame is not None
        both = np.isin(true_objects(clusters, self.frame), self.merged) & (matches.instance_ids > 0)
        if both.any():
            self.instance = self.instance or int(matches.instance_ids[both][0])
            matches.instance_ids[both] = self.instance
        return matches


@dataclass
class JumpingTracker(PoseTracker):
    """Tracker whose poses are displaced from one frame on."""

    tracker: PoseTracker
    first: int  # Frame.index of the first displaced frame
    offset: Float64  # (3,) m

    def __post_init__(self) -> None:
        self.pose_source = self.tracker.pose_source

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        pose = self.tracker.track(frame, scene)
        if frame.index < self.first:
            return pose
        T_world_camera = pose.T_world_camera.copy()
        T_world_camera[:3, 3] += self.offset
        return replace(pose, T_world_camera=T_world_camera)


@dataclass(frozen=True)
class Fault:
    """A fault of one stage."""

    stage: Stage
    objects: tuple[int, ...]  # objects that it can affect; () = all
    inject: Callable[[Pipeline], None]


def hide(key: int) -> Fault:
    def inject(pipeline: Pipeline) -> None:
        pipeline.detector = HidingDetector(pipeline.detector, key)

    return Fault(Stage.DETECTION, (key,), inject)


def halve(key: int, truth: SceneTruth) -> Fault:
    def inject(pipeline: Pipeline) -> None:
        pipeline.refiner = HalvingRefiner(pipeline.refiner, key, truth)

    return Fault(Stage.REFINEMENT, (key,), inject)


def merge(a: int, b: int) -> Fault:
    def inject(pipeline: Pipeline) -> None:
        given = pipeline.fuser.association  # type: ignore[attr-defined]
        merging = MergingAssociation(**{one.name: getattr(given, one.name) for one in fields(Association)})
        merging.merged = (a, b)
        pipeline.fuser.association = merging  # type: ignore[attr-defined]

    return Fault(Stage.ASSOCIATION, (a, b), inject)


def jump(first: int, offset: tuple[float, float, float]) -> Fault:
    def inject(pipeline: Pipeline) -> None:
        pipeline.tracker = JumpingTracker(pipeline.tracker, first, np.array(offset))

    return Fault(Stage.TRACKING, (), inject)


@dataclass
class FaultTest:
    """A run without faults, to which runs with one fault are compared.

    Its poses are true. Replays in which the ground truth replaces the faulty stage are not repeated.
    """

    video: RGBDSequence
    build: PipelineFactory
    metric: str = "instances.ap50"

    def __post_init__(self) -> None:
        self.truth = self.video.scene_truth()
        self.replays = Replays(self.video, self.build, ComparedClasses(), self.metric, frozenset({Stage.TRACKING}))
        self.explanation = self.replays.explain()

    def with_fault(self, fault: Fault) -> Explanation:
        """Return the explanation of a run with a fault."""

        def build(replaced: frozenset[Stage]) -> Pipeline:
            pipeline = self.build(replaced)
            if fault.stage not in replaced:
                fault.inject(pipeline)
            return pipeline

        given = frozenset({Stage.TRACKING} - {fault.stage})
        replays = Replays(self.video, build, ComparedClasses(), self.metric, given)
        for replaced, value in self.replays.values.items():
            if fault.stage is Stage.TRACKING:
                replays.values[replaced | {Stage.TRACKING}] = value
            elif fault.stage in replaced:
                replays.values[replaced] = value
        return replays.explain()

    def fraction_of_loss(self, fault: Fault, explanation: Explanation) -> float:
        """Return the fraction of the additional loss that is attributed to the faulty stage."""
        before, after = self.explanation.contributions, explanation.contributions
        assert before is not None
        assert after is not None
        return (after.stages[fault.stage] - before.stages[fault.stage]) / (after.loss - before.loss)

    def lost(self, explanation: Explanation) -> dict[int, str]:
        """Return the cause of each object that only the run with the fault has lost, by id."""
        found = {one.id for one in self.explanation.objects if one.cause is None}
        return {one.id: one.cause.value for one in explanation.objects if one.id in found and one.cause is not None}
