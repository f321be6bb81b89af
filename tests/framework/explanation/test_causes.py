"""Tests for the causes of lost objects, on observations of one frame repeated in time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from framework.data import SceneTruth
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import PredictedInstances
from framework.explanation.causes import Cause, FalseInstance, ObjectExplanation, State, explain_objects
from framework.explanation.observation import FrameObservation

FRAMES = 10
CLASSES = ("chair", "tv")
NAMES: Mapping[int, str | None] = {1: "chair", 2: "tv"}
POINTS = 200  # number of true points of each object
FRAME = FrameObservation(
    index=0, lost=False, detected=True, truth_ids=np.int32([1, 2]), visible=np.int64([200, 300]),
    centers_camera=np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0]]), class_ids=np.int32([0, 1]),
    objects=np.int32([1, 2]), lifted=np.int64([[5, 190, 0], [5, 0, 280]]),
    refined=np.int64([[0, 180, 0], [0, 0, 270]]), instance_ids=np.int32([7, 8]),
)  # fmt: skip
"""A frame in which both objects are detected, and matched with instances 7 and 8."""


def explained(
    frame: FrameObservation,
    labels: Mapping[int, Mapping[int, int]],
    motion: np.ndarray | None = None,
    merged: Mapping[int, int] | None = None,
    covered: bool = True,
    class_names: Mapping[int, str] | None = None,
) -> tuple[dict[int, ObjectExplanation], list[FalseInstance]]:
    """Explain a map, given the number of points of each object by instance, of which the other points have no label."""
    points = np.zeros((2 * POINTS, 3), np.float32)
    points[:, 0] = 0.2 * np.arange(len(points))
    true_ids = np.repeat(np.int32([1, 2]), POINTS)
    predicted = np.zeros(2 * POINTS, np.int32)
    for key, counts in labels.items():
        start = (key - 1) * POINTS
        for instance, count in counts.items():
            predicted[start : start + count] = instance
            start += count
    shift = np.float32([0, 0.0 if covered else 0.1, 0])
    ids = sorted({k for counts in labels.values() for k in counts})
    names = {7: "chair", 8: "tv"} | dict(class_names or {})
    predictions = PredictedInstances(
        points + shift, predicted if covered else 0 * predicted, np.array(ids, np.int64), np.full(len(ids), 0.9),
        tuple(names.get(k, "chair") for k in ids),
    )  # fmt: skip
    frames = [replace(frame, index=k) for k in range(FRAMES)]
    motions = {k: np.eye(4) if motion is None else motion for k in range(FRAMES)}
    compared = ComparedClasses().compare(predictions, SceneTruth(points, true_ids, NAMES))
    objects, false = explain_objects(frames, motions, CLASSES, merged or {}, compared)
    return {one.id: one for one in objects}, false


BOTH = {1: {7: 180}, 2: {8: 180}}
SECOND = {2: {8: 180}}
BROKEN: dict[str, tuple[Cause, FrameObservation, Mapping[int, Mapping[int, int]]]] = {
    "small": (Cause.OBSERVATION, replace(FRAME, visible=np.int64([50, 300])), SECOND),
    "undetected": (
        Cause.DETECTION,
        replace(FRAME, objects=np.int32([0, 2]), lifted=np.int64([[5, 0, 0], [5, 0, 280]])),
        SECOND,
    ),
    "part": (Cause.DETECTION, replace(FRAME, lifted=np.int64([[5, 90, 0], [5, 0, 280]])), SECOND),
    "let in": (Cause.REFINEMENT, replace(FRAME, refined=np.int64([[400, 180, 0], [0, 0, 270]])), SECOND),
    "lost": (Cause.TRACKING, replace(FRAME, lost=True, refined=np.zeros((2, 3), np.int64)), SECOND),
    "halved": (Cause.REFINEMENT, replace(FRAME, refined=np.int64([[0, 90, 0], [0, 0, 270]])), SECOND),
    "not created": (Cause.ASSOCIATION, replace(FRAME, instance_ids=np.int32([0, 8])), SECOND),
    "absorbed": (Cause.ASSOCIATION, replace(FRAME, instance_ids=np.int32([8, 8])), SECOND),
    "unconfirmed": (Cause.FUSION, FRAME, SECOND),
    "outvoted": (Cause.FUSION, FRAME, {1: {7: 80, 8: 20}, 2: {8: 180}}),
}


def test_explain_complete_map_finds_all_objects() -> None:
    objects, false = explained(FRAME, BOTH)
    assert [one.state for one in objects.values()] == [State.FOUND, State.FOUND]
    assert false == []
    figures = objects[1].figures
    assert figures.frames_seen == figures.frames_detected == FRAMES
    assert figures.coverage == pytest.approx(190 / 200)
    assert figures.iou_association == pytest.approx(180 / 200)
    assert figures.removed == pytest.approx(10 / 190)


@pytest.mark.parametrize("case", BROKEN)
def test_explain_lost_object_names_first_stage(case: str) -> None:
    cause, frame, labels = BROKEN[case]
    objects, _ = explained(frame, labels)
    assert (objects[1].state, objects[1].cause) == (State.MISSED, cause)


def test_explain_displaced_object_names_tracking() -> None:
    motion = np.eye(4)
    motion[0, 3] = 0.08
    objects, _ = explained(FRAME, SECOND, motion)
    assert objects[1].cause is Cause.TRACKING
    assert objects[1].reason.startswith("displaced by 8.0 cm")


def test_explain_uncovered_object_names_evaluation() -> None:
    objects, _ = explained(FRAME, BOTH, covered=False)
    assert [one.cause for one in objects.values()] == [Cause.EVALUATION, Cause.EVALUATION]


def test_explain_object_in_two_masks_names_detection() -> None:
    parts = replace(
        FRAME, class_ids=np.int32([0, 0]), objects=np.int32([1, 1]), lifted=np.int64([[0, 95, 0], [0, 95, 0]]),
        refined=np.int64([[0, 90, 0], [0, 90, 0]]),
    )  # fmt: skip
    objects, _ = explained(parts, {1: {7: 90, 8: 90}})
    assert (objects[1].state, objects[1].cause) == (State.SPLIT, Cause.DETECTION)


def test_explain_wrong_class_names_detection() -> None:
    objects, _ = explained(replace(FRAME, class_ids=np.int32([1, 1])), BOTH, class_names={7: "tv"})
    assert (objects[1].state, objects[1].cause) == (State.WRONG_CLASS, Cause.DETECTION)
    assert objects[1].reason == "detected as tv (10)"


def test_explain_merged_instance_counts_as_remaining_one() -> None:
    objects, _ = explained(replace(FRAME, instance_ids=np.int32([9, 8])), BOTH, merged={9: 7})
    assert objects[1].figures.instances == {7: 180 * FRAMES}


def test_explain_false_instance_on_no_object_names_detection() -> None:
    frame = replace(
        FRAME, class_ids=np.int32([0, 1, 0]), objects=np.int32([1, 2, 0]),
        lifted=np.vstack([FRAME.lifted, [100, 0, 0]]), refined=np.vstack([FRAME.refined, [100, 0, 0]]),
        instance_ids=np.int32([7, 8, 9]),
    )  # fmt: skip
    _, false = explained(frame, {1: {7: 170, 9: 20}, 2: {8: 180}})
    assert [(one.id, one.cause, one.observations) for one in false] == [(9, Cause.DETECTION, FRAMES)]
    assert false[0].reason == "10 of its 10 masks are on no object"
