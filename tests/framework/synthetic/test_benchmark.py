"""Ten rooms, each with what its role promises; without a picture of any."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from framework.label_spaces import SCENENN_TO_COCO
from framework.synthetic.benchmark import SCENES, SceneSpec, furnish_scene, plan_scene
from framework.synthetic.furniture.cluttered_groups import chair_row, cluttered_bed_group, cluttered_couch, desk_row
from framework.synthetic.furniture.groups import toilet_group

SEEDS = range(3)
ROOMS = [
    *("living_chairs", "bedroom", "books", "couches", "office"),
    *("meeting", "student", "one_room", "kitchen", "flat"),
]


def classes_of(pieces) -> Counter:
    return Counter(piece.class_name for piece in pieces)


def test_the_scenes_have_names_of_their_own_and_each_class_is_promised_by_at_least_two() -> None:
    assert list(SCENES) == ROOMS
    assert not any(name.isdigit() for name in SCENES), "a number would be taken for a sequence of SceneNN"
    promised = Counter(name for spec in SCENES.values() for name in spec.holds)
    assert set(promised) == set(SCENENN_TO_COCO.values())
    assert min(promised.values()) >= 2


@pytest.mark.parametrize("name", ROOMS)
def test_a_scene_holds_what_it_promises(name: str) -> None:
    for seed in SEEDS:
        rng = np.random.default_rng([seed, ROOMS.index(name)])
        found = classes_of(piece for make in SCENES[name].groups for piece in make(rng).pieces)
        for class_name, least in SCENES[name].holds.items():
            assert found[class_name] >= least, (seed, class_name)


@pytest.mark.parametrize("name", ROOMS)
def test_a_scene_finds_room_for_everything(name: str) -> None:
    spec = SCENES[name]
    room = furnish_scene(spec, np.random.default_rng([ROOMS.index(name) % len(SEEDS), 1]))
    assert room.layout.free.max() > 1.0, "room to walk"
    found = classes_of(piece for _, piece in room.objects)
    assert all(found[class_name] >= least for class_name, least in spec.holds.items())
    assert any(piece.kind == "door" for _, piece in room.objects)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("make", [cluttered_bed_group, cluttered_couch])
def test_things_lie_on_what_they_clutter(make, seed: int) -> None:
    support, *others = make(np.random.default_rng(seed)).pieces
    low, high = support.bounds()
    middles = [sum(piece.bounds()) / 2 for piece in others]
    lying = [p for p, m in zip(others, middles, strict=True) if (m[:2] > low[:2]).all() and (m[:2] < high[:2]).all()]
    assert {"blanket", "cushion", "backpack"} <= {piece.kind for piece in lying}
    for piece in lying:
        assert 0.35 < piece.bounds()[0][2] < 0.72, "it lies on the seat or the mattress, or on a blanket there"


def test_things_in_a_row_are_equal_and_nearly_touch() -> None:
    chairs = chair_row(np.random.default_rng(0), 4).pieces
    shapes = [np.concatenate([solid.vertices for solid, _ in chair.parts]) for chair in chairs]
    for k, shape in enumerate(shapes):
        step = shape[0] - shapes[0][0]
        np.testing.assert_allclose(shape - step, shapes[0], atol=1e-12)
        if k:
            gap = chairs[k].bounds()[0][0] - chairs[k - 1].bounds()[1][0]
            assert 0.0 < gap < 0.06
    desks = [piece for piece in desk_row(np.random.default_rng(0), 2).pieces if piece.kind == "desk"]
    assert len(desks) == 2
    assert 0.0 < desks[1].bounds()[0][0] - desks[0].bounds()[1][0] < 0.06


def test_the_walk_shows_the_class_that_the_room_is_for() -> None:
    scene = plan_scene(SceneSpec("bathroom", (toilet_group,), {"toilet": 1}), [0, 0], 60, 1.0)
    toilet = next(piece for _, piece in scene.room.objects if piece.class_name == "toilet")
    middle = sum(toilet.bounds()) / 2
    angles = []
    for k in range(60):
        T_world_camera = scene.path.pose(k)
        ray = middle - T_world_camera[:3, 3]
        angles.append(np.degrees(np.arccos(ray @ T_world_camera[:3, 2] / np.linalg.norm(ray))))
    assert min(angles) < 30
