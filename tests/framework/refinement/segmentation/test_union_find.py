"""Tests for the components of a union-find structure."""

from __future__ import annotations

import numpy as np

from framework.refinement.segmentation.union_find import root, unite


def test_union_find_root_is_first_cell_of_component():
    parents = np.arange(8).astype(np.int32)
    for a, b in ((6, 7), (7, 3), (5, 4), (3, 6), (2, 5)):
        unite(parents, a, b)
    assert [root(parents, cell) for cell in range(8)] == [0, 1, 2, 3, 2, 2, 3, 3]
