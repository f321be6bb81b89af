"""Where EM starts, beside an obvious reference."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from framework.refinement.mixtures.initialization import start_labels
from framework.refinement.mixtures.initialization_kernels import START_ITERATIONS
from framework.refinement.neighborhood import Neighborhoods

pytestmark = pytest.mark.integration


def around(counts: list[tuple[int, int]]) -> tuple[Neighborhoods, np.ndarray]:
    """Sets of (mask, ring) points in four blobs, and log-odds that are negative for a third of the mask."""
    rng = np.random.default_rng(0)
    masks, rings = np.transpose(counts)
    starts = np.concatenate([[0], np.cumsum(masks + rings)])
    points = (
        rng.normal(0, 0.1, (starts[-1], 3))
        + rng.uniform([-1, -1, 1], [1, 1, 3], (4, 3))[rng.integers(0, 4, starts[-1])]
    )
    of_ring = np.concatenate([np.repeat([False, True], pair) for pair in counts])
    log_odds = np.where(of_ring | (rng.random(starts[-1]) < 0.3), -1, 1).astype(np.float32)
    n = len(counts)
    sets = Neighborhoods(
        points.astype(np.float32), np.zeros(starts[-1], np.float32), starts, masks, np.ones(n, np.int64),
        np.ones(n, np.float32),
    )  # fmt: skip
    return sets, log_odds


def groups_of(points: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Labels and centers of Lloyd's algorithm from the means of equal parts by depth."""
    by_depth = points[np.argsort(points[:, 2], kind="stable")]
    cuts = np.arange(groups + 1) * len(points) // groups
    centers = np.array([by_depth[a:b].mean(axis=0) for a, b in pairwise(cuts)])
    for _ in range(START_ITERATIONS):
        labels = nearest(points, centers)
        centers = np.array([points[labels == j].mean(axis=0) for j in range(groups)])
    return labels, centers


def nearest(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - centers, axis=-1).argmin(axis=1)


def test_core_and_ring_are_cut_by_place_and_the_border_starts_in_the_ring():
    sets, log_odds = around([(400, 300), (150, 600)])
    labels = start_labels(sets, log_odds, 2, 5)
    for k in range(2):
        own = slice(sets.starts[k], sets.starts[k + 1])
        points, found = sets.points_camera[own].astype(np.float64), labels[own]
        ring = sets.of_ring[own]
        core = ~ring & (log_odds[own] >= 0)
        np.testing.assert_array_equal(found[core], groups_of(points[core], 2)[0])
        background, centers = groups_of(points[ring], 5)
        np.testing.assert_array_equal(found[ring], 2 + background)
        border = ~ring & ~core
        assert border.any()
        np.testing.assert_array_equal(found[border], 2 + nearest(points[border], centers))


def test_sets_without_mask_ring_or_anything():
    sets, log_odds = around([(0, 50), (50, 0), (0, 0), (1, 1)])
    labels = start_labels(sets, log_odds, 2, 6)
    assert ((labels >= 0) & (labels < 8)).all()
    assert (labels[:50] >= 2).all()
