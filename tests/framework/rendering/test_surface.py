"""Tests for surface kernels, compared with slow references."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera
from framework.geometry import inverse, project, transform
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.rendering.surface import FrontSides, Hits, Surface
from framework.rendering.viewpoint import looking

CAMERA = Camera(48, 36, 40.0, 42.0, 23.5, 17.5)
CENTER, R = np.array([0.1, -0.2, -4.0]), looking(np.array([0.05, 0.1, 1.0]), np.array([0.0, -1, 0]))


@pytest.fixture(scope="module")
def surface() -> Surface:
    """Return triangles with common vertices and random orientation."""
    rng = np.random.default_rng(0)
    return Surface(rng.uniform(-1, 1, (40, 3)).astype(np.float32), rng.integers(0, 40, (30, 3), np.int32))


@pytest.fixture(scope="module")
def hits(surface: Surface) -> Hits:
    return FrontSides(surface, CENTER).seen_by(CAMERA, R)


def test_surface_normals_match_cross_products(surface: Surface) -> None:
    a, b, c = surface.vertices[surface.triangles.T]
    np.testing.assert_allclose(surface.face_normals, np.cross(b - a, c - a), atol=1e-6)
    for i, normal in enumerate(surface.vertex_normals):
        around = sum((surface.triangles == i).sum(axis=1)[:, None] * surface.face_normals)
        np.testing.assert_allclose(normal, around / max(np.linalg.norm(around), 1e-12), atol=1e-5)


def test_surface_hits_show_front_faces_with_exact_values(surface: Surface, hits: Hits) -> None:
    assert 0.05 < hits.seen.mean() < 0.95
    labels = np.arange(100, 100 + len(surface.vertices), dtype=np.int32)
    nearest, points = hits.nearest(labels), hits.points_world
    values = np.random.default_rng(1).normal(0, 1, (len(labels), 2)).astype(np.float32)
    interpolated = hits.interpolated(values)
    for v, u in np.ndindex(CAMERA.shape):
        if not hits.seen[v, u]:
            assert hits.depth[v, u] == nearest[v, u] == 0
            assert not interpolated[v, u].any()
            continue
        corners = hits.triangles[hits.buffer.triangle[v, u]]
        a, b, c = surface.vertices[corners]
        assert np.cross(b - a, c - a) @ (a - CENTER) < 0
        weights = np.array([1 - hits.buffer.uv[v, u].sum(), *hits.buffer.uv[v, u]])
        assert nearest[v, u] == labels[corners[weights.argmax()]]
        np.testing.assert_allclose(interpolated[v, u], weights @ values[corners], atol=1e-5)
        np.testing.assert_allclose(points[v, u], weights @ surface.vertices[corners], atol=1e-5)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_surface_subsampled_hits_match_subsampled_camera(hits: Hits, n: int) -> None:
    some = hits.subsampled(n)
    np.testing.assert_array_equal(some.depth, hits.depth[::n, ::n])
    np.testing.assert_array_equal(some.points_world, hits.points_world[::n, ::n])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, CENTER
    local = transform(inverse(T), some.points_world[some.seen].astype(np.float64))
    v, u = np.nonzero(some.seen)
    np.testing.assert_allclose(project(some.camera, local), np.stack([u, v], axis=-1), atol=1e-3)
    np.testing.assert_allclose(local[:, 2], some.depth[some.seen], atol=1e-5)


def test_front_sides_hide_back_faces() -> None:
    front = Surface(np.array([[-9, -9, 0], [0, 9, 0], [9, -9, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    back = Surface(front.vertices, front.triangles[:, ::-1])
    shown = [FrontSides(one, CENTER).seen_by(CAMERA, np.eye(3)).buffer.triangle for one in (front, back)]
    assert (shown[0] == 0).all()
    assert (shown[1] == NO_TRIANGLE).all()
