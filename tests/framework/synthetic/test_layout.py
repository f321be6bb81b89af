"""Tests for the layout of furniture."""

import itertools

import numpy as np
import pytest

from framework.synthetic.room import RoomKind, furnish
from tests.support.scenes.labeled_furniture import LABELED


@pytest.mark.parametrize(("kind", "seed"), [(RoomKind.STUDIO, 0), (RoomKind.STUDIO, 1), *((k, 2) for k in RoomKind)])
def test_layout_furniture_does_not_collide(kind, seed):
    room = furnish(kind, np.random.default_rng(seed))
    half = np.array([room.layout.width, room.layout.depth]) / 2
    pieces = [piece for instance, piece in room.objects if instance and piece.kind != "rug"]
    boxes = [piece.bounds() for piece in pieces]
    for (low_a, high_a), (low_b, high_b) in itertools.combinations(boxes, 2):
        depth = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
        assert depth.min() < 1e-3
    for low, high in boxes:
        assert (low[:2] > -half - 1e-6).all()
        assert (high[:2] < half + 1e-6).all()
        assert low[2] > -0.01


@pytest.mark.parametrize("seed", range(3))
def test_layout_studio_has_all_classes_and_adjacent_chairs(seed):
    room = furnish(RoomKind.STUDIO, np.random.default_rng(seed))
    assert {piece.class_name for _, piece in room.objects} >= set(LABELED)
    chairs = [piece.bounds() for _, piece in room.objects if piece.class_name == "chair"]
    gaps = [
        np.maximum(np.maximum(low_a - high_b, low_b - high_a), 0).max()
        for (low_a, high_a), (low_b, high_b) in itertools.combinations(chairs, 2)
    ]
    assert 0 < min(gaps) < 0.06


def test_room_instance_ids_exclude_room_shell():
    surfaces = furnish(RoomKind.BEDROOM, np.random.default_rng(0)).surfaces
    assert set(np.unique(surfaces.instance_ids)) == {0, *surfaces.class_names}
    assert np.isfinite(surfaces.vertices).all()
    assert surfaces.triangles.max() < len(surfaces.vertices)
