"""Tests for false positives that recur at the same 3D position."""

from __future__ import annotations

import numpy as np

from framework.data import Camera, Frame, FrameTruth
from framework.detection.recurring_false_positives import CELL, KEYS, false_positive_cells

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


def wall(x: float, names: dict[int, str | None] | None = None, z: float = 3.0) -> Frame:
    """Return a view of a wall at depth z, m, from position x, m. The left half is instance 1."""
    pose = np.eye(4)
    pose[0, 3] = x
    ids = np.zeros((120, 160), np.int32)
    ids[:, :80] = 1
    truth = FrameTruth(ids, names or {})
    color, depth = np.zeros((120, 160, 3), np.uint8), np.full((120, 160), z, np.float32)
    return Frame(0, 0.0, color, depth, CAMERA, T_world_camera=pose, truth=truth)


def test_false_positive_cells_keep_key_and_rank_across_views() -> None:
    here, there = false_positive_cells(wall(0.1), 0, 99), false_positive_cells(wall(0.35), 0, 99)
    keys = [place.key for place in here]
    assert keys == sorted(set(keys))
    assert 1 <= keys[0] <= keys[-1] <= KEYS
    both = [key for key in keys if key in {place.key for place in there}]
    assert len(both) > len(keys) / 2
    assert [place.key for place in there if place.key in both] == both


def test_false_positive_cells_are_distinct() -> None:
    for x in (0.0, 0.2):
        cells = set()
        places = false_positive_cells(wall(x), 0, 99)
        for place in places:
            at = np.array(
                [(place.u - CAMERA.cx) * place.z / CAMERA.fx + x, (place.v - CAMERA.cy) * place.z / CAMERA.fy]
            )
            cells.add(tuple(np.floor(at / CELL)))
        assert len(cells) == len(places)


def test_false_positive_cells_require_unknown_surface_and_pose() -> None:
    assert all(place.u >= 80 for place in false_positive_cells(wall(0.0, {1: "bed"}), 0, 99))
    assert any(place.u < 80 for place in false_positive_cells(wall(0.0, {1: None}), 0, 99))
    lost = wall(0.0)
    assert false_positive_cells(Frame(0, 0.0, lost.color, lost.depth, CAMERA, truth=lost.truth), 0, 99) == []
    assert false_positive_cells(wall(0.0, z=0.0), 0, 99) == []


def test_false_positive_cells_depend_on_seed_and_count() -> None:
    first, second = (false_positive_cells(wall(0.0), seed, 3) for seed in (0, 1))
    assert len(first) == len(second) == 3
    assert [place.key for place in first] != [place.key for place in second]
