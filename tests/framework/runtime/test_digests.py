"""Tests for the digests of stage results."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from framework.baselines.semantic_map import SemanticMap
from framework.data import Detections, PointClusters, Pose
from framework.interfaces import MapStatistics
from framework.runtime.digests import digest_of


def clusters(count: int) -> PointClusters:
    """Return one cluster with `count` random points."""
    rng = np.random.default_rng(0)
    return PointClusters(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        np.zeros((count, 2), np.int32),
        np.zeros(count, np.int32),
        np.ones((1, 1), np.float32),
        np.ones(1, np.float32),
        ("chair",),
    )


@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])  # with and without additional bytes after the last 64-bit word
def test_digest_equal_clusters_are_equal(count: int) -> None:
    assert digest_of(clusters(count)) == digest_of(clusters(count))


@pytest.mark.parametrize("point", [0, 6])
def test_digest_moved_point_differs(point: int) -> None:
    original = clusters(7)
    moved = original.points_world.copy()
    moved[point, 2] = np.nextafter(moved[point, 2], np.float32(2))
    assert digest_of(replace(original, points_world=moved)) != digest_of(original)


def test_digest_lost_pose_differs() -> None:
    assert digest_of(Pose(np.eye(4))) != digest_of(Pose(np.eye(4), lost=True))


def test_digest_detections_include_boxes() -> None:
    found = Detections(
        np.ones((1, 4, 4), np.bool_), np.zeros((1, 4), np.float32), np.ones(1, np.float32),
        np.ones((1, 1), np.float32), ("chair",),
    )  # fmt: skip
    assert digest_of(replace(found, boxes=np.ones((1, 4), np.float32))) != digest_of(found)


def test_digest_other_object_raises() -> None:
    with pytest.raises(TypeError, match="expected the result of a stage, got str"):
        digest_of("pose")


def test_digest_of_semantic_map_needs_no_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Computing the instances would require the mesh, which takes seconds."""
    mesh = Mock(side_effect=AssertionError("expected no mesh"))
    monkeypatch.setattr(SemanticMap, "mesh", mesh)
    monkeypatch.setattr(SemanticMap, "statistics", property(lambda _: MapStatistics(8, 64)))
    assert digest_of(object.__new__(SemanticMap)) != 0
    mesh.assert_not_called()
