"""Tests for the ten benchmark rooms and their layouts."""

from __future__ import annotations

from collections import Counter
from itertools import combinations, pairwise

import numpy as np
import pytest

from framework.synthetic.benchmark import SCENES, SceneSpec, furnish_scene, plan_scene
from framework.synthetic.furniture.cluttered_groups import (
    TOUCHING,
    chair_row,
    cluttered_bed_group,
    cluttered_couch,
    cluttered_couch_group,
    desk_row,
    laid_table_group,
)
from framework.synthetic.furniture.fixtures import backpack
from framework.synthetic.furniture.groups import single, toilet_group
from framework.synthetic.furniture.small_things import ON_FLOORS, book_row, some
from framework.synthetic.layout import CONTACT, WALK_RADIUS, arrange, strew
from framework.synthetic.paints import Texture
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

pytestmark = pytest.mark.integration

SEEDS = range(3)
ROOMS = [
    *("living_chairs", "bedroom", "books", "couches", "office"),
    *("meeting", "student", "one_room", "kitchen", "flat"),
]


def classes_of(pieces) -> Counter:
    return Counter(piece.class_name for piece in pieces)


def test_benchmark_scenes_have_unique_names_and_repeated_classes() -> None:
    assert list(SCENES) == ROOMS
    assert not any(name.isdigit() for name in SCENES), (
        "expected names other than numbers, which are sequences of SceneNN"
    )
    promised = Counter(name for spec in SCENES.values() for name in spec.holds)
    assert set(promised) == set(SCENENN_TO_COCO.values())
    assert min(promised.values()) >= 2


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.acceptance) for seed in SEEDS[1:])])
@pytest.mark.parametrize("name", ROOMS)
def test_benchmark_scene_has_declared_objects(name: str, seed: int) -> None:
    rng = np.random.default_rng([seed, ROOMS.index(name)])
    found = classes_of(piece for make in SCENES[name].groups for piece in make(rng).pieces)
    assert all(found[class_name] >= least for class_name, least in SCENES[name].holds.items())


@pytest.mark.parametrize("name", ROOMS)
def test_furnish_scene_places_all_declared_objects(name: str) -> None:
    spec = SCENES[name]
    room = furnish_scene(spec, np.random.default_rng([ROOMS.index(name) % len(SEEDS), 1]))
    assert room.layout.free.max() > 1.0, "expected space for the camera path"
    found = classes_of(piece for _, piece in room.objects)
    assert all(found[class_name] >= least for class_name, least in spec.holds.items())
    assert any(piece.kind == "door" for _, piece in room.objects)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("make", [cluttered_bed_group, cluttered_couch])
def test_cluttered_groups_place_objects_on_furniture(make, seed: int) -> None:
    support, *others = make(np.random.default_rng(seed)).pieces
    low, high = support.bounds()
    middles = [sum(piece.bounds()) / 2 for piece in others]
    lying = [p for p, m in zip(others, middles, strict=True) if (m[:2] > low[:2]).all() and (m[:2] < high[:2]).all()]
    assert {"blanket", "cushion", "backpack"} <= {piece.kind for piece in lying}
    for piece in lying:
        assert 0.35 < piece.bounds()[0][2] < 0.72, "expected an object on the seat, the mattress or a blanket"


def gap(piece, other) -> float:
    """Return the distance, m, between two bounding boxes. Overlapping boxes have a negative distance."""
    (low, high), (other_low, other_high) = piece.bounds(), other.bounds()
    return float(np.maximum(low - other_high, other_low - high).max())


def points(piece) -> np.ndarray:
    return np.concatenate([solid.vertices for solid, _ in piece.parts])


@pytest.mark.parametrize("seed", SEEDS)
def test_row_groups_place_identical_pieces_in_contact(seed: int) -> None:
    chairs = [piece for piece in chair_row(np.random.default_rng(seed), 4).pieces if piece.kind == "chair"]
    desks = [piece for piece in desk_row(np.random.default_rng(seed), 3).pieces if piece.kind == "desk"]
    assert (len(chairs), len(desks)) == (4, 3)
    for row in (chairs, desks):
        for left, right in pairwise(row):
            step = points(right)[0] - points(left)[0]
            np.testing.assert_allclose(points(right) - step, points(left), atol=1e-12)
            assert 0 < gap(left, right) <= TOUCHING[1]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("make", [laid_table_group, lambda rng: desk_row(rng, 1)], ids=["table", "desk"])
def test_benchmark_chairs_under_tables_do_not_intersect(make, seed: int) -> None:
    table, *others = make(np.random.default_rng(seed)).pieces
    chairs = [piece for piece in others if piece.class_name == "chair"]
    under = [chair for chair in chairs if gap(chair, table) < 0]
    assert len(under) == (2 if len(chairs) > 1 else 1)
    boards = [solid.vertices for solid, _ in table.parts]
    for chair in under:
        at = points(chair)
        front = table.bounds()[1][1]
        assert at[:, 1].min() < front - 0.05, "expected the seat under the table"
        for board in boards:
            inside = ((at > board.min(axis=0)) & (at < board.max(axis=0))).all(axis=1)
            assert not inside.any(), "expected no intersection of chair and table"
        top = boards[0]
        near = at[(at[:, 2] > top[:, 2].min() - 0.1) & (at[:, 2] < top[:, 2].max() + 0.1)]
        assert 0 <= near[:, 1].min() - front < 0.1
    assert all(gap(chair, table) < 0 or 0 < gap(chair, table) <= TOUCHING[1] for chair in chairs)


@pytest.mark.parametrize("seed", SEEDS)
def test_cluttered_groups_place_neighbors_in_contact(seed: int) -> None:
    couch, *others = cluttered_couch_group(np.random.default_rng(seed)).pieces
    [table] = [piece for piece in others if piece.class_name == "dining table"]
    assert 0 < gap(couch, table) <= TOUCHING[1]
    bed, *others = cluttered_bed_group(np.random.default_rng(seed)).pieces
    standing = [piece for piece in others if piece.class_name == "backpack" and abs(piece.bounds()[0][2]) < 0.01]
    assert [0 < gap(bed, bag) <= TOUCHING[1] for bag in standing] == [True]


@pytest.mark.parametrize("seed", SEEDS)
def test_laid_table_objects_are_on_table_without_overlap(seed: int) -> None:
    table, *others = laid_table_group(np.random.default_rng(seed)).pieces
    low, high = table.bounds()
    things = [piece for piece in others if piece.class_name != "chair"]
    assert len(things) >= 5
    for thing in things:
        thing_low, thing_high = thing.bounds()
        assert 0 <= thing_low[2] - high[2] < 0.002
        assert (thing_low[:2] >= low[:2]).all()
        assert (thing_high[:2] <= high[:2]).all()
    assert all(gap(thing, other) >= 0 for thing, other in combinations(things, 2))


def test_book_row_places_upright_books_side_by_side() -> None:
    row = book_row(np.random.default_rng(0))
    low, high = row.bounds()
    assert row.class_name == "book"
    assert abs(low[2]) < 1e-9
    assert 0.24 <= high[2] <= 0.32
    covers = [solid for solid, material in row.parts if material.texture is Texture.BOOK]
    middles = sorted(solid.vertices[:, 0].mean() for solid in covers)
    assert len(middles) >= 10
    assert (np.diff(middles) > 0.0025).all(), "expected covers and pages that alternate along the row"


@pytest.mark.parametrize("seed", SEEDS)
def test_strew_places_objects_in_contact_with_furniture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    layout = arrange([cluttered_couch_group(rng), chair_row(rng, 3), single("bag", backpack(rng))], 4.8, 4.2, rng)
    strewn = strew(layout, some(rng, ON_FLOORS, 9), rng)
    before, new = layout.pieces, strewn.pieces[len(layout.pieces) :]
    assert all(now is then for now, then in zip(strewn.pieces, before, strict=False))
    assert 4 <= len(new) <= 9
    assert strewn.free.max() >= WALK_RADIUS
    for k, thing in enumerate(new):
        others = [piece for piece in [*before, *new[:k]] if piece.kind != "rug"]
        gaps = [gap(thing, other) for other in others]
        assert min(gaps) > -1e-3, "expected no intersection with other objects"
        assert min(gaps) < 2 * CONTACT, "expected contact with another object"
        assert -0.01 < thing.bounds()[0][2] < 0.02, "expected an object on the floor or on a rug"
        half = np.array([layout.width, layout.depth]) / 2
        assert (np.abs(np.stack(thing.bounds())[:, :2]) < half).all()


def test_planned_path_views_target_class() -> None:
    scene = plan_scene(SceneSpec("bathroom", (toilet_group,), {"toilet": 1}), [0, 0], 60, 1.0)
    toilet = next(piece for _, piece in scene.room.objects if piece.class_name == "toilet")
    middle = sum(toilet.bounds()) / 2
    angles = []
    for k in range(60):
        T_world_camera = scene.path.pose(k)
        ray = middle - T_world_camera[:3, 3]
        angles.append(np.degrees(np.arccos(ray @ T_world_camera[:3, 2] / np.linalg.norm(ray))))
    assert min(angles) < 30
