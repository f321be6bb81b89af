"""Tests for the refiner that uses the ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.data import Pose
from framework.errors import DataError
from framework.refinement.lifting import lift
from framework.testing.corner_room import bleeding_clusters, exact_clusters, frame_at, pose_at, spheres_in
from plugins.refiners.ground_truth import GroundTruthRefiner


def test_true_refiner_keeps_exactly_the_object() -> None:
    frame = frame_at(1)
    assert frame.truth is not None
    clusters = bleeding_clusters(frame)
    refined = GroundTruthRefiner().refine(clusters, frame)
    exact = exact_clusters(frame)
    assert len(refined.pixels) < len(clusters.pixels)
    np.testing.assert_array_equal(np.bincount(refined.cluster), np.bincount(exact.cluster))
    u, v = refined.pixels.T
    np.testing.assert_array_equal(frame.truth.instance_ids[v, u], refined.cluster + 1)


def test_true_refiner_does_not_change_false_detection() -> None:
    frame = frame_at(1)
    assert frame.truth is not None
    found = spheres_in(frame)
    masks = found.masks.copy()
    masks[1] = frame.truth.instance_ids == 0
    clusters = lift(replace(found, masks=masks), frame, Pose(pose_at(1)))
    refined = GroundTruthRefiner().refine(clusters, frame)
    np.testing.assert_array_equal(np.bincount(refined.cluster), np.bincount(clusters.cluster))


def test_true_refiner_without_truth_raises() -> None:
    with pytest.raises(DataError, match="frame 1: expected instance ground truth, got none"):
        GroundTruthRefiner().refine(bleeding_clusters(frame_at(1)), frame_at(1, truth=False))
