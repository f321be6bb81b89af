"""Replays of a run: the same sequence and stages, some of them replaced by the ground truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from framework.data import Float64
from framework.errors import DataError
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import PredictedInstances
from framework.evaluation.truth_alignment import in_map_world, map_alignment
from framework.explanation.causes import FalseInstance, ObjectExplanation, explain_objects
from framework.explanation.contributions import STAGES, Contributions, Stage, losses_of
from framework.explanation.observation import Observer
from framework.geometry import inverse
from framework.interfaces import RGBDSequence
from framework.pipeline import Pipeline
from framework.runs.metrics import instance_metrics
from framework.runtime.corrected_frames import TrackedFrame
from framework.runtime.run_log import RunResult

PipelineFactory = Callable[[frozenset[Stage]], Pipeline]
"""Function that builds the stages of a run, given the set of stages that the ground truth replaces."""


@dataclass(frozen=True)
class Explanation:
    """The explanation of a run."""

    objects: tuple[ObjectExplanation, ...]
    false_instances: tuple[FalseInstance, ...]
    contributions: Contributions | None  # None = not computed


@dataclass
class Replays:
    """The replays of a run."""

    video: RGBDSequence
    build: PipelineFactory
    classes: ComparedClasses
    metric: str = "instances.ap50"  # key of metrics.json, for which larger is better, in [0, 1]
    given: frozenset[Stage] = frozenset()  # stages of the run that are the ground truth
    on_replay: Callable[[], object] = lambda: None  # called after each replay
    values: dict[frozenset[Stage], float] = field(default_factory=dict, init=False)  # metric by replaced stages

    @property
    def count(self) -> int:
        """Number of replays for the contributions, including the first."""
        return int(2 ** (len(STAGES) - len(self.given)))

    def explain(self, with_contributions: bool = True) -> Explanation:
        """Replay the run, and return its explanation.

        Raises:
            DataError: The sequence has no instance ground truth, or no object of it is evaluated.
        """
        pipeline = self.build(frozenset())
        observer = Observer.of(pipeline)
        result = self.replayed(pipeline, frozenset())
        objects, false_instances = explained(self.video, pipeline, observer, result, self.classes)
        contributions = Contributions.of(self.metric, self.losses()) if with_contributions else None
        return Explanation(tuple(objects), tuple(false_instances), contributions)

    def losses(self) -> dict[frozenset[Stage], float]:
        """Return the loss for each set of stages that the ground truth replaces."""
        return losses_of(self.loss, self.given)

    def loss(self, replaced: frozenset[Stage]) -> float:
        if replaced not in self.values:
            self.replayed(self.build(replaced), replaced)
        return 1 - self.values[replaced]

    def replayed(self, pipeline: Pipeline, replaced: frozenset[Stage]) -> RunResult:
        """Map the sequence again, and record the metric of the map."""
        result = pipeline.run_to_any_end(self.video)
        if result.stopped_by is not None:
            raise result.stopped_by
        scene = result.scene
        found = instance_metrics(
            self.video, scene.mesh(), scene.instances(), scene.classes, trajectory_of(result.tracked), self.classes
        )
        if not isinstance(value := found.get(self.metric), float) or not np.isfinite(value):
            raise DataError(f"{self.video.name}: expected the metric {self.metric}, got none; choose another metric")
        self.values[replaced] = value
        self.on_replay()
        return result


def trajectory_of(tracked: Sequence[TrackedFrame]) -> tuple[Float64, Float64]:
    """Return the timestamps (F,), s, and the poses (F, 4, 4) of the frames that are not lost."""
    reliable = [one for one in tracked if not one.pose.lost]
    poses = np.array([one.pose.T_world_camera for one in reliable]).reshape(-1, 4, 4)
    return np.array([one.timestamp for one in reliable]), poses


def explained(
    video: RGBDSequence, pipeline: Pipeline, observer: Observer, result: RunResult, classes: ComparedClasses
) -> tuple[list[ObjectExplanation], list[FalseInstance]]:
    """Return the explanations of the true objects and of the false instances of an observed run."""
    truth = video.scene_truth()
    if truth is None:
        raise DataError(f"{video.name}: expected instance ground truth, got none; set dataset.ground_truth=PATH")
    trajectory = trajectory_of(result.tracked)
    T_map_truth = map_alignment(truth, *trajectory)
    scene = result.scene
    predictions = PredictedInstances.of_map(scene.mesh(), scene.instances(), scene.classes)
    return explain_objects(
        observer.frames,
        motions_of(result.tracked, np.eye(4) if T_map_truth is None else T_map_truth),
        pipeline.detector.classes,
        observer.scene.table.merged,
        classes.compare(predictions, in_map_world(truth, *trajectory)),
    )


def motions_of(tracked: Sequence[TrackedFrame], T_map_truth: Float64) -> dict[int, Float64]:
    """Return the motion (4, 4) of the points of each frame in the camera frame by pose errors, by Frame.index.

    Lost frames and frames without a true pose are omitted.
    """
    return {
        one.index: inverse(T_map_truth @ one.T_world_camera_truth) @ one.pose.T_world_camera
        for one in tracked
        if one.T_world_camera_truth is not None and not one.pose.lost
    }
