"""Tests for mesh decimation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from framework.data import InstanceMesh, Int32
from framework.exporting.decimation import clustered, decimated, with_finer_objects


def wavy_plane(n: int = 120) -> InstanceMesh:
    """Return a wavy surface of 1 m by 1 m. One half is red, the other half is blue, and the middle is an object."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    vertices = np.stack([x, y, 0.02 * np.sin(12 * x) * np.cos(9 * y)], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    colors = np.where(vertices[:, :1] < 0.5, (200, 10, 10), (10, 10, 200)).astype(np.uint8)
    inside = (np.abs(vertices[:, :2] - 0.5) < 0.2).all(axis=1)
    ids = np.where(inside, 7, 0).astype(np.int32)
    classes = np.full(len(ids), -1, np.int32)
    return InstanceMesh(vertices, triangles.astype(np.int32), colors, ids, classes, ())


def areas(vertices: np.ndarray, triangles: Int32) -> np.ndarray:
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


# clustering is used first for the last mesh
@pytest.mark.parametrize(("n", "most"), [(120, 8000), (120, 300), (420, 9000)])
def test_decimation_keeps_surface_colors_and_labels(n: int, most: int) -> None:
    mesh = wavy_plane(n)
    light = with_finer_objects(mesh, most)
    assert 0.6 * most < len(light.triangles) <= most
    area = areas(mesh.vertices, mesh.triangles).sum()
    assert areas(light.vertices, light.triangles).sum() == pytest.approx(area, rel=0.08)
    x, y, z = light.vertices.T
    assert np.abs(z - 0.02 * np.sin(12 * x) * np.cos(9 * y)).max() < 0.012
    left, right = light.vertices[:, 0] < 0.4, light.vertices[:, 0] > 0.6
    assert (light.colors[left, 0] > 150).all()
    assert (light.colors[right, 2] > 150).all()
    middle = light.vertices[light.instance_ids == 7]
    assert (np.abs(middle[:, :2] - 0.5) < 0.25).all()
    corners = (light.instance_ids[light.triangles] == 7).all(axis=1)
    assert areas(light.vertices, light.triangles[corners]).sum() == pytest.approx(0.16, rel=0.12)


def test_decimation_keeps_objects_finer_than_background() -> None:
    mesh = wavy_plane()
    light = with_finer_objects(mesh, 3000)
    of_object = (light.instance_ids[light.triangles] == 7).all(axis=1)
    sizes = areas(light.vertices, light.triangles)
    assert np.median(sizes[of_object]) < 0.5 * np.median(sizes[~of_object])


def test_decimation_keeps_small_mesh_unchanged() -> None:
    mesh = wavy_plane(20)
    light = with_finer_objects(mesh, 1000)
    assert len(light.triangles) == len(mesh.triangles)
    assert areas(light.vertices, light.triangles).sum() == areas(mesh.vertices, mesh.triangles).sum()


def test_decimation_by_clustering_limits_size_of_triangle_soup() -> None:
    mesh = wavy_plane()
    corners = mesh.triangles.ravel()
    triangles = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    soup = InstanceMesh(
        mesh.vertices[corners],
        triangles,
        mesh.colors[corners],
        mesh.instance_ids[corners],
        mesh.class_ids[corners],
        (),
    )
    light = clustered(soup, 100_000, 24, 12)
    assert 10_000 < 24 * len(light.vertices) + 12 * len(light.triangles) <= 100_000
    assert set(light.instance_ids.tolist()) == {0, 7}
    assert clustered(soup, 10**9, 24, 12) is soup


def test_decimation_of_flat_surface_keeps_color_pattern() -> None:
    """With decimation by geometry alone, only 85 % of the checkerboard would have the correct color."""
    mesh = wavy_plane(101)
    x, y, _ = mesh.vertices.T
    white = (np.floor(5 * x) + np.floor(5 * y)) % 2 == 0
    flat = replace(
        mesh,
        vertices=mesh.vertices * np.float32([1, 1, 0]),
        colors=np.where(white[:, None], 240, 20).astype(np.uint8).repeat(3, axis=1),
    )
    light = decimated(flat, 5000)
    corners = light.vertices[light.triangles]
    centers, sizes = corners.mean(axis=1), areas(light.vertices, light.triangles)
    shown = light.colors[light.triangles][..., 0].mean(axis=1) > 128
    u, v = 5 * centers[:, :2].T
    true = (np.floor(u) + np.floor(v)) % 2 == 0
    assert sizes[shown == true].sum() > 0.93
    assert (light.vertices[:, 2] == 0).all(), "expected a flat surface"


@pytest.mark.parametrize("asked", [1, 4, 12])
def test_decimation_to_few_triangles_keeps_object_volume(asked: int) -> None:
    ball = trimesh.creation.icosphere(6, 0.1)
    n = len(ball.vertices)
    mesh = InstanceMesh(
        np.float32(ball.vertices),
        np.int32(ball.faces),
        np.full((n, 3), 200, np.uint8),
        np.full(n, 3, np.int32),
        np.zeros(n, np.int32),
        ("ball",),
    )
    few = decimated(mesh, asked)
    assert 4 <= len(few.triangles) <= max(asked, 4)
    assert (few.instance_ids == 3).all()
    assert (few.class_ids == 0).all()
    assert np.ptp(few.vertices, axis=0).min() > 0.05
