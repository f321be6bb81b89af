"""Tests for the floor, walls, ceiling and furniture fronts of a map, on exact and noisy surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Float32, Float64, Int32, Structure, UInt8
from framework.mapping.structure import SurfaceStructure, VertexStructure, separate_instances, structure_of
from framework.mapping.voxels.meshing import UnlabeledMesh

X, Y, Z = np.eye(3)
ROTATIONS = {"upright": np.eye(3), "rotated": Rotation.from_euler("xyz", (0.8, -0.5, 0.4)).as_matrix()}
SPACING = 0.04  # m, distance of vertices
NONE, FLOOR, WALL, CEILING, FRONT = Structure


class Room:
    """A mesh of rectangles, with the expected structure of its vertices."""

    def __init__(self) -> None:
        self.vertices: list[Float64] = []
        self.triangles: list[Int32] = []
        self.expected: list[Structure] = []
        self.count = 0

    def add(self, origin: Float64, a: Float64, b: Float64, kind: Structure) -> Room:
        """Add a rectangle with the edges a and b, m, and the normal a x b."""
        m, n = (round(float(np.linalg.norm(edge)) / SPACING) + 1 for edge in (a, b))
        s, t = np.meshgrid(np.linspace(0, 1, m), np.linspace(0, 1, n), indexing="ij")
        corner = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel() + self.count
        quads = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=1)
        self.triangles += [quads[:, [0, 1, 2]].astype(np.int32), quads[:, [0, 2, 3]].astype(np.int32)]
        self.vertices.append(origin + s.reshape(-1, 1) * a + t.reshape(-1, 1) * b)
        self.expected += [kind] * (m * n)
        self.count += m * n
        return self

    def mesh(self, rotation: Float64, noise: float = 0.0) -> tuple[Float32, Int32]:
        points = np.concatenate(self.vertices)
        points += np.random.default_rng(0).normal(0, noise, points.shape) if noise else 0
        return (points @ rotation.T).astype(np.float32), np.concatenate(self.triangles)

    def structure(self, rotation: Float64 = ROTATIONS["upright"], noise: float = 0.0) -> UInt8:
        return structure_of(*self.mesh(rotation, noise), rotation @ Z).of_vertices

    def agreement(self, structure: UInt8, kind: Structure) -> float:
        """Return the IoU of the vertices with a kind."""
        found, expected = structure == kind, np.array(self.expected) == kind
        return float((found & expected).sum() / (found | expected).sum())


def furnished() -> Room:
    """Return a room of 4 x 3 x 2.5 m with a table and a bed."""
    room = Room().add(0 * X, 4 * X, 3 * Y, FLOOR).add(2.5 * Z, 3 * Y, 4 * X, CEILING)
    room.add(0 * X, 3 * Y, 2.5 * Z, WALL).add(4 * X, 2.5 * Z, 3 * Y, WALL)
    room.add(0 * X, 2.5 * Z, 4 * X, WALL).add(3 * Y, 4 * X, 2.5 * Z, WALL)
    room.add(X + Y + 0.7 * Z, X, Y, NONE)
    return room.add(2.4 * X + 0.6 * Y + 0.5 * Z, 1.5 * X, 1.8 * Y, NONE).add(2.4 * X + 0.6 * Y, 0.5 * Z, 1.8 * Y, NONE)


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_structure_of_exact_room_is_complete(rotation: Float64) -> None:
    room = furnished()
    structure = room.structure(rotation)
    for kind in (NONE, FLOOR, WALL, CEILING):
        assert room.agreement(structure, kind) > 0.95, kind


def test_structure_of_noisy_room_is_complete() -> None:
    room = furnished()
    structure = room.structure(noise=0.004)
    for kind in (FLOOR, WALL, CEILING):
        assert room.agreement(structure, kind) > 0.9, kind


def test_structure_below_upper_story_is_floor_of_both() -> None:
    room = furnished().add(5 * X - 3 * Z, 1.2 * X, Y, FLOOR).add(5 * X - 3 * Z, Y, 3 * Z, WALL)
    assert room.agreement(room.structure(), FLOOR) > 0.95


def test_structure_of_cupboard_is_front() -> None:
    room = furnished().add(X + 0.6 * Y, 2.1 * Z, 1.2 * X, NONE)
    room.expected[-len(room.vertices[-1]) :] = [FRONT] * len(room.vertices[-1])
    assert room.agreement(room.structure(), FRONT) > 0.9


def test_structure_of_low_part_in_wall_plane_is_none() -> None:
    room = Room().add(0 * X, 4 * X, 3 * Y, FLOOR).add(3 * Y, 2 * X, 2.5 * Z, WALL)
    room.add(2.6 * X + 3 * Y, 1.4 * X, 0.6 * Z, NONE)  # the side of a bed in the plane of the wall
    assert room.agreement(room.structure(), WALL) > 0.9


def test_vertex_structure_without_gravity_is_none() -> None:
    surface = UnlabeledMesh(*furnished().mesh(np.eye(3)), np.zeros(0, np.int32))
    assert not VertexStructure().of(surface, None).of_vertices.any()


def test_vertex_structure_of_new_surface_is_computed() -> None:
    room, structure = furnished(), VertexStructure()
    empty = UnlabeledMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))
    assert len(structure.of(empty, Z).planes) == 0
    assert (
        room.agreement(structure.of(UnlabeledMesh(*room.mesh(np.eye(3)), np.zeros(0, np.int32)), Z).of_vertices, FLOOR)
        > 0.95
    )


def test_vertex_structure_of_new_up_direction_is_computed() -> None:
    surface = UnlabeledMesh(*furnished().mesh(np.eye(3)), np.zeros(0, np.int32))
    structure = VertexStructure()
    upright = structure.of(surface, Z).of_vertices
    assert not np.array_equal(structure.of(surface, X).of_vertices, upright)
    np.testing.assert_array_equal(structure.of(surface, Z).of_vertices, upright)


KINDS = np.array([NONE, FLOOR, WALL, CEILING, FRONT], np.uint8)


def test_separate_instances_removes_points_on_structure() -> None:
    structure = SurfaceStructure(np.array([1, 2, 3, 4, 0, 0], np.int32), KINDS)
    ids = np.array([1, 1, 1, 1, 1, 0], np.int32)
    assert separate_instances(ids, structure, np.zeros(2, np.bool_)).tolist() == [0, 0, 0, 1, 1, 0]


@pytest.mark.parametrize(("on_wall", "kept"), [(5, True), (4, False)])
def test_separate_instances_keeps_flat_instances(on_wall: int, kept: bool) -> None:
    """A wall has 10 vertices without an instance."""
    structure = SurfaceStructure(np.array([2] * on_wall + [0] * (10 - on_wall) + [2] * 10, np.int32), KINDS)
    ids = np.repeat(np.int32([1, 0]), 10)
    separated = separate_instances(ids, structure, np.array([False, True]))
    assert (separated > 0).sum() == (10 if kept else 10 - on_wall)


@pytest.mark.parametrize(("on_instance", "flat", "kept"), [(3, True, True), (2, True, False), (3, False, False)])
def test_separate_instances_keeps_own_sides(on_instance: int, flat: bool, kept: bool) -> None:
    """A wall has 6 vertices, some of which are on an instance with 10 other vertices."""
    structure = SurfaceStructure(np.array([2] * 6 + [0] * 10, np.int32), KINDS)
    ids = np.array([1] * on_instance + [0] * (6 - on_instance) + [1] * 10, np.int32)
    separated = separate_instances(ids, structure, np.array([False, flat]))
    assert (separated > 0).sum() == (10 + on_instance if kept else 10)
