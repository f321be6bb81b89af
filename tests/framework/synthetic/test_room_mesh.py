"""Tests for the tessellation of room surfaces and for their visible parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.data import Camera
from framework.synthetic.furniture.piece import Furniture
from framework.synthetic.furniture.solids import panel, rounded_box
from framework.synthetic.paints import Material, Texture
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.room_mesh import seen_from, tessellate, visible_mesh
from framework.synthetic.surfaces import assemble
from framework.synthetic.walk import look

GRAY = Material(Texture.PAINT, (0.7, 0.7, 0.7), (0.7, 0.7, 0.7))
CAMERA = Camera(160, 120, 130.0, 130.0, 80.0, 60.0)
AHEAD = look(np.array([0.0, 0.0, 0.0]), 0.0, 0.0, 0.0)  # the camera is at the origin and looks along +x


def scene(*solids):
    """Return the surfaces of solids. The first one is the shell, and the others are instances 1, 2, ..."""
    objects = []
    for instance, solid in enumerate(solids):
        piece = Furniture("thing", "chair" if instance else None)
        piece.add(solid, GRAY)
        objects.append((instance, piece))
    return assemble(objects)


def wall(distance: float):
    """Return a wall of 6 m x 6 m that faces the camera at `distance` m."""
    return panel(6.0, 6.0, 0.5).moved(z=-3.0).turned("z", np.pi / 2).moved(x=distance)


def corners_of(mesh):
    return mesh.vertices[mesh.triangles].astype(np.float64)


def edge_lengths(mesh):
    corners = corners_of(mesh)
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)


def area(corners) -> float:
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()


@pytest.mark.parametrize("longest", [0.02, 0.05])
def test_tessellate_limits_edge_length_and_keeps_surface(longest):
    surfaces = scene(rounded_box(0.5, 0.3, 0.2, 0.01, 2), rounded_box(0.1, 0.2, 0.3, 0.02, 3).moved(x=1.0))
    mesh = tessellate(surfaces, longest)
    assert edge_lengths(mesh).max() <= longest * (1 + 1e-5)
    exact = surfaces.vertices[surfaces.triangles].astype(np.float64)
    assert area(corners_of(mesh)) == pytest.approx(area(exact), rel=1e-5)
    volume = np.einsum("fc,fc->f", corners_of(mesh)[:, 0], np.cross(*corners_of(mesh)[:, 1:].swapaxes(0, 1))).sum() / 6
    assert volume > 0, "expected counterclockwise triangles, seen from outside"


def test_tessellate_closed_body_stays_watertight():
    """Each edge of a watertight mesh belongs to two triangles, in opposite directions."""
    mesh = tessellate(scene(rounded_box(0.5, 0.3, 0.2, 0.02, 3)), 0.02)
    directed = np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert np.array_equal(np.unique(directed, axis=0), np.unique(directed[:, ::-1], axis=0))


def test_tessellate_merges_duplicate_vertices_per_instance():
    half = rounded_box(0.1, 0.1, 0.1, 0.01)
    mesh = tessellate(scene(wall(5.0), half, half), 0.02)
    rows = np.column_stack([mesh.vertices, mesh.instance_ids])
    assert len(np.unique(rows, axis=0)) == len(rows)
    assert np.array_equal(mesh.vertices[mesh.instance_ids == 1], mesh.vertices[mesh.instance_ids == 2])
    of_triangle = mesh.instance_ids[mesh.triangles]
    assert (of_triangle == of_triangle[:, :1]).all()


def test_visible_mesh_excludes_occluded_surface():
    box = rounded_box(1.0, 1.0, 1.0, 1e-3)
    surfaces = scene(wall(4.0), box.moved(x=2.5))
    caster = RayCaster(surfaces.vertices, surfaces.triangles)
    mesh = visible_mesh(surfaces, caster, CAMERA, [AHEAD], (0.4, 6.0))
    front = mesh.vertices[mesh.instance_ids == 1]
    np.testing.assert_allclose(front[:, 0], 2.0, atol=1.1e-3)
    assert np.abs(front[:, 1:]).max() == pytest.approx(0.5, abs=1e-5)
    behind = mesh.vertices[mesh.instance_ids == 0]
    shadow = 1.0  # m; the front of the box has a half width of 0.5 m at 2 m and occludes 1 m at 4 m
    assert (np.abs(behind[:, 1:]).max(axis=1) > shadow - 1e-4).all()
    spacing = 0.02
    assert (np.abs(behind[:, 1:]).max(axis=1) < shadow + spacing).any()
    half_width = 4.0 * (CAMERA.cx + 0.5) / CAMERA.fx  # y points to the left
    assert half_width - spacing < behind[:, 1].max() <= half_width + 1e-5
    assert mesh.triangles.max() < len(mesh.vertices)
    assert area(corners_of(mesh)[mesh.instance_ids[mesh.triangles[:, 0]] == 1]) == pytest.approx(1.0, rel=3e-3)


def test_seen_from_excludes_points_out_of_depth_range():
    surfaces = scene(wall(4.0))
    caster = RayCaster(surfaces.vertices, surfaces.triangles)
    assert seen_from(surfaces.vertices, caster, CAMERA, [AHEAD], (0.4, 6.0), surfaces.unreadable).any()
    assert not seen_from(surfaces.vertices, caster, CAMERA, [AHEAD], (0.4, 3.9), surfaces.unreadable).any()
    assert not seen_from(surfaces.vertices, caster, CAMERA, [AHEAD], (4.1, 6.0), surfaces.unreadable).any()


def test_seen_from_multiple_views_is_union():
    surfaces = scene(wall(4.0))
    caster = RayCaster(surfaces.vertices, surfaces.triangles)
    aside = look(np.zeros(3), 0.3, 0.0, 0.0)
    alone = [seen_from(surfaces.vertices, caster, CAMERA, [T], (0.4, 6.0), surfaces.unreadable) for T in (AHEAD, aside)]
    both = seen_from(surfaces.vertices, caster, CAMERA, [AHEAD, aside], (0.4, 6.0), surfaces.unreadable)
    assert np.array_equal(both, alone[0] | alone[1])
    assert (alone[0] != alone[1]).any()


def test_tessellate_treats_negative_zero_as_zero():
    surfaces = scene(wall(4.0))
    signed = np.where(surfaces.vertices == 0, np.float32(-0.0), surfaces.vertices)
    assert len(tessellate(replace(surfaces, vertices=signed), 0.1).vertices) == len(tessellate(surfaces, 0.1).vertices)


def test_visible_mesh_excludes_screen_and_occluded_surface():
    objects = []
    for instance, (side, x, dark) in enumerate(((3.0, 3.0, 0.9), (1.0, 2.998, 1.0))):
        piece = Furniture("thing", None)
        face = panel(side, side).moved(z=-side / 2).turned("z", np.pi / 2).moved(x=x)
        piece.add(face, replace(GRAY, dark=dark))
        objects.append((instance, piece))
    surfaces = assemble(objects)
    np.testing.assert_array_equal(surfaces.unreadable, surfaces.instance_ids == 1)
    mesh = visible_mesh(surfaces, RayCaster(surfaces.vertices, surfaces.triangles), CAMERA, [AHEAD], (0.4, 6.0), 0.05)
    assert not mesh.instance_ids[mesh.triangles].any(), "expected only border points of the screen"
    across = np.abs(mesh.vertices[:, 1:]).max(axis=1)
    np.testing.assert_allclose(across[mesh.instance_ids == 1], 0.5, atol=1e-6)
    assert across.min() == pytest.approx(0.5, abs=0.05)
    assert across.max() > 1.3
