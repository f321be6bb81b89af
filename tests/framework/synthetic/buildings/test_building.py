"""Tests for the geometry of buildings and the camera tours through them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from framework.geometry import inverse, rotation_angle
from framework.synthetic.buildings.building import CORRIDOR_WIDTH, WALL, Building, plan_building
from framework.synthetic.buildings.building_tour import SPEED, TURN, BuildingTour, plan_tour
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.walk import FRAME_RATE

pytestmark = pytest.mark.integration

ROOMS, DESIGNS = 5, 2
CLEARANCE = 0.2  # m, minimum horizontal distance of the camera from all surfaces


@pytest.fixture(scope="module")
def building() -> Building:
    return plan_building(ROOMS, DESIGNS, (7,))


@pytest.fixture(scope="module")
def tour(building: Building) -> BuildingTour:
    return plan_tour(building, np.random.default_rng(7))


def rays(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).astype(np.float32)


def test_building_has_rooms_on_both_sides_without_overlap(building: Building) -> None:
    assert [room.side for room in building.rooms] == [1, 1, 1, -1, -1]
    for side in (1, -1):
        row = [room for room in building.rooms if room.side == side]
        ends = [(room.x - room.width / 2, room.x + room.width / 2) for room in row]
        gaps = [second[0] - first[1] for first, second in pairwise(ends)]
        np.testing.assert_allclose(gaps, WALL)
        assert ends[0][0] == 0
        assert ends[-1][1] <= building.length + 1e-9


def test_building_rooms_of_one_design_are_identical(building: Building) -> None:
    first, same, other = (building.zones[k].objects[1:] for k in (0, 2, 1))
    shift = np.array([building.rooms[2].x - building.rooms[0].x, 0, 0])
    assert len(first) == len(same)
    for (_, piece), (_, copy) in zip(first, same, strict=True):
        assert piece.kind == copy.kind
        for (solid, material), (moved, of_copy) in zip(piece.parts, copy.parts, strict=True):
            np.testing.assert_allclose(solid.vertices + shift, moved.vertices, atol=1e-9)
            assert material == of_copy
    assert [piece.kind for _, piece in first] != [piece.kind for _, piece in other]


def test_building_instance_ids_are_unique(building: Building) -> None:
    ids = [k for zone in building.zones for k, _ in zone.objects]
    named = [k for k in ids if k]
    assert len(set(named)) == len(named)
    assert ids.count(0) == ROOMS + 1
    assert building.surfaces.class_names.keys() == set(named)


def test_building_is_closed(building: Building, tour: BuildingTour) -> None:
    """From no position of the tour, a ray leaves the building."""
    caster = RayCaster(building.surfaces.vertices, building.surfaces.triangles)
    directions = np.random.default_rng(0).normal(size=(500, 3))
    origins = np.array([tour.pose(k)[:3, 3] for k in range(0, tour.frames, 20)])
    hits = caster.cast(rays(origins[:, None], directions[None]))
    assert np.isfinite(hits.distance).mean() > 1 - 1e-4


def test_tour_keeps_distance_from_surfaces(building: Building, tour: BuildingTour) -> None:
    caster = RayCaster(building.surfaces.vertices, building.surfaces.triangles)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    origins = np.array([tour.pose(k)[:3, 3] for k in range(0, tour.frames, 3)])
    assert caster.cast(rays(origins[:, None], directions[None])).distance.min() > CLEARANCE


def test_tour_is_closed_and_periodic(tour: BuildingTour) -> None:
    np.testing.assert_allclose(tour.pose(tour.frames + 3), tour.pose(3), atol=1e-9)
    step = inverse(tour.pose(tour.frames - 1)) @ tour.pose(tour.frames)
    assert np.linalg.norm(step[:3, 3]) < 2 * SPEED / FRAME_RATE
    assert rotation_angle(step[:3, :3]) < 2 * TURN / FRAME_RATE


def test_tour_motion_is_slow_and_smooth(tour: BuildingTour) -> None:
    poses = np.array([tour.pose(k) for k in range(tour.frames)])
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * FRAME_RATE
    turn = [rotation_angle(a[:3, :3].T @ b[:3, :3]) * FRAME_RATE for a, b in pairwise(poses)]
    assert speed.max() < 1.1 * SPEED
    assert max(turn) < 1.3 * TURN
    assert np.abs(np.diff(speed)).max() * FRAME_RATE < 3, "expected an acceleration below 3 m/s^2"


def test_tour_enters_all_rooms_and_closes_loop_before_its_end(building: Building, tour: BuildingTour) -> None:
    positions = np.array([tour.pose(k)[:2, 3] for k in range(tour.frames)])
    edge = CORRIDOR_WIDTH / 2 + WALL
    for room in building.rooms:
        across = room.side * positions[:, 1]
        inside = (across > edge) & (across < edge + room.depth)
        assert (inside & (np.abs(positions[:, 0] - room.x) < room.width / 2)).any()
    returned = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) < 0.5)
    assert ((returned > 0.4 * tour.frames) & (returned < 0.7 * tour.frames)).any()
