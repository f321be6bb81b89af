"""Tests for the connected components of a semantic map on small meshes."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as scipy_components

from framework.baselines.semantic_map import connected_components

STRIP = np.int32([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6]])
"""Triangles (5, 3) of a strip of seven vertices."""


def test_semantic_map_components_are_split_by_another_class() -> None:
    assert connected_components(STRIP, np.int32([2, 2, 2, 2, 2, 2, 2]), 1).tolist() == [1] * 7
    assert connected_components(STRIP, np.int32([2, 2, 2, 5, 5, 2, 2]), 1).tolist() == [1, 1, 1, 2, 2, 3, 3]


def test_semantic_map_background_and_small_parts_have_no_id() -> None:
    assert connected_components(STRIP, np.int32([0, -1, -1, -1, -1, 0, 0]), 1).tolist() == [1, 0, 0, 0, 0, 2, 2]
    assert connected_components(STRIP, np.int32([0, -1, -1, -1, -1, 0, 0]), 2).tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert connected_components(np.zeros((0, 3), np.int32), np.zeros(0, np.int32), 1).tolist() == []


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_semantic_map_components_match_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    v = int(rng.integers(3, 60))
    triangles = rng.integers(0, v, (int(rng.integers(0, 40)), 3)).astype(np.int32)
    class_ids = rng.integers(-1, 2, v).astype(np.int32)
    least = int(rng.integers(1, 4))
    a, b = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    kept = (class_ids[a] == class_ids[b]) & (class_ids[a] >= 0)
    _, pieces = scipy_components(coo_array((np.ones(kept.sum()), (a[kept], b[kept])), shape=(v, v)), directed=False)
    expected = np.zeros(v, np.int32)
    for i in range(v):
        if class_ids[i] >= 0 and (pieces == pieces[i]).sum() >= least:
            earlier = np.flatnonzero(pieces[:i] == pieces[i])
            expected[i] = expected[earlier[0]] if len(earlier) else expected.max() + 1
    assert connected_components(triangles, class_ids, least).tolist() == expected.tolist()
