"""Tests for the overlap of maps with ground truth."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Float32, Float64, SceneTruth
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import PredictedInstances
from framework.evaluation.truth_coverage import TruthCoverage
from framework.geometry import transform
from framework.runs.metrics import evaluation_metrics, is_evaluation


def box(low: tuple[float, ...], high: tuple[float, ...], spacing: float = 0.03) -> Float64:
    """Return points on the faces of a box."""
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    faces = [np.take(points, [0, -1], axis=axis).reshape(-1, 3) for axis in range(3)]
    return np.concatenate(faces)


ROOM = np.concatenate(
    [box((0, 0, 0), (4, 3, 2.5)), box((1, 1, 0), (2.2, 1.6, 0.75)), box((3, 0.3, 0), (3.5, 0.8, 1.2))]
)


def moved(shift: tuple[float, ...] = (0, 0, 0), turn: tuple[float, ...] = (0, 0, 0)) -> Float32:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = shift, Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return transform(T, ROOM).astype(np.float32)


OTHER_WORLDS = [
    moved(shift=(1.0, 0.7, 0.4)),
    moved(turn=(-90, 0, 0)),
    moved(shift=(5, 0, 0), turn=(0, 0, 90)),
    moved(shift=(0.2, 0.3, 0.1), turn=(0, 0, 20)),
    moved() * np.float32(1000),
]


@pytest.mark.parametrize("points", OTHER_WORLDS, ids=["shifted", "y_up", "turned", "slightly_turned", "millimeters"])
def test_truth_coverage_in_other_world_frame_is_implausible(points: Float32) -> None:
    assert not TruthCoverage.of(points, moved()).plausible


@pytest.mark.parametrize("kept", [0.02, 0.1, 0.5, 1.0])
def test_truth_coverage_of_partial_map_or_truth_is_plausible(kept: float) -> None:
    rng = np.random.default_rng(0)
    nearest = np.argsort(np.linalg.norm(moved() - moved()[0], axis=1))
    part = (moved() + rng.normal(0, 0.01, ROOM.shape).astype(np.float32))[nearest[: int(kept * len(ROOM))]]
    found = TruthCoverage.of(part, moved())
    assert found.map > 0.95
    assert found.plausible
    assert TruthCoverage.of(moved(), part).plausible


def test_truth_coverage_without_points_is_zero() -> None:
    none = np.zeros((0, 3), np.float32)
    assert TruthCoverage.of(none, moved()) == TruthCoverage.of(moved(), none) == TruthCoverage(0.0, 0.0)


@pytest.mark.parametrize("points", [moved(), OTHER_WORLDS[0]], ids=["same", "other"])
def test_evaluation_metrics_warn_of_other_world_frame(points: Float32, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    ids = np.ones(len(ROOM), np.int32)
    predictions = PredictedInstances(points, ids, np.array([1]), np.array([0.9]), ("chair",))
    truth = SceneTruth(moved(), ids, {1: "chair"})
    found = evaluation_metrics(predictions, truth, truth, "", ComparedClasses.of({}))
    same = points is not OTHER_WORLDS[0]
    assert (found["coverage.ground_truth"] == 1.0) is same
    assert ("ground truth: expected the world frame of the map" in caplog.text) is not same
    assert is_evaluation("coverage.ground_truth")


@pytest.mark.parametrize(("mapped", "annotated"), [(0, 10), (10, 0), (0, 0)])
def test_evaluation_metrics_without_points_do_not_warn_of_world_frame(
    mapped: int, annotated: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    predictions = PredictedInstances(
        moved()[:mapped], np.ones(mapped, np.int32), np.array([1]), np.array([0.9]), ("chair",)
    )
    truth = SceneTruth(moved()[:annotated], np.ones(annotated, np.int32), {1: "chair"})
    evaluation_metrics(predictions, truth, truth, "", ComparedClasses.of({}))
    assert not caplog.text
