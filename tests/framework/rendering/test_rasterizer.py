"""Tests for the rasterizer, compared with ray casting per pixel."""

from __future__ import annotations

import threading
from dataclasses import astuple

import numpy as np
import pytest

from framework.data import Camera
from framework.geometry import exp_se3
from framework.rendering.rasterizer import Rasterizer, VisibilityBuffer
from framework.rendering.rasterizer_kernels import CHUNK, NO_TRIANGLE
from framework.synthetic.ray_caster import RayCaster, image_rays, pixel_rays
from framework.synthetic.walk import look

CAMERA = Camera(96, 64, 80.0, 85.0, 47.3, 31.1)
ASIDE = 2e-3  # px; if rays this far from the pixel center hit the same vertex, rounding has no effect


def drawn(vertices: np.ndarray, triangles: np.ndarray, T: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Return the index (H, W) of the vertex nearest to the visible surface at each pixel, -1 = no surface."""
    numbered = np.arange(1, len(vertices) + 1, dtype=np.int32)
    return Rasterizer(vertices, triangles).draw(camera, T).nearest(triangles, numbered) - 1


def met_by_rays(caster: RayCaster, triangles: np.ndarray, T: np.ndarray, du: float, dv: float) -> np.ndarray:
    """Return the index (H, W) of the vertex nearest to the hit of each ray. Rays are (du, dv) px from pixel centers."""
    u, v = np.arange(CAMERA.width)[None, :] + du, np.arange(CAMERA.height)[:, None] + dv
    hits = caster.cast(pixel_rays(CAMERA, T, u, v))
    weights = np.stack([1 - hits.uv.sum(axis=-1), hits.uv[..., 0], hits.uv[..., 1]], axis=-1)
    corner = np.take_along_axis(triangles[hits.triangle], weights.argmax(axis=-1)[..., None], axis=-1)[..., 0]
    return np.where(hits.triangle == NO_TRIANGLE, -1, corner)


def assert_equals_ray_casting(vertices: np.ndarray, triangles: np.ndarray, T: np.ndarray) -> None:
    caster = RayCaster(vertices, triangles)
    around = [met_by_rays(caster, triangles, T, du, dv) for du in (-ASIDE, ASIDE) for dv in (-ASIDE, ASIDE)]
    sure = np.all([a == around[0] for a in around], axis=0)
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(drawn(vertices, triangles, T)[sure], around[0][sure])


def random_triangles(rng: np.random.Generator, size: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices, m, and triangles of `count` random triangles of about `size` m."""
    centers = rng.uniform(-3, 3, (count, 1, 3))
    vertices = (centers + rng.normal(0, size, (count, 3, 3))).reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


@pytest.mark.parametrize(("size", "count"), [(0.02, 40 * CHUNK + 7), (0.2, 500), (3.0, 6)])
@pytest.mark.parametrize("seed", range(3))
def test_rasterizer_matches_ray_casting(size: float, count: int, seed: int) -> None:
    """Some triangles are small, and some extend behind the camera."""
    rng = np.random.default_rng([seed, count])
    vertices, triangles = random_triangles(rng, size, count)
    assert_equals_ray_casting(vertices, triangles, exp_se3(rng.normal(0, 1, 6)))


@pytest.mark.parametrize("size", [0.2, 3.0])
def test_rasterizer_depth_and_weights_match_ray_casting(size: float) -> None:
    rng = np.random.default_rng(7)
    vertices, triangles = random_triangles(rng, size, 400)
    T = exp_se3(rng.normal(0, 1, 6))
    buffer = Rasterizer(vertices, triangles).draw(CAMERA, T)
    hits = RayCaster(vertices, triangles).cast(image_rays(CAMERA, T))
    same = (buffer.triangle == hits.triangle) & (buffer.triangle != NO_TRIANGLE)
    assert (buffer.triangle == hits.triangle).mean() > 0.99
    assert same.sum() > 1000
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    # the weighted means of the corners must be equal
    points = T[:3, 3] + buffer.depth[..., None] * (rays @ T[:3, :3].T)
    weights = np.concatenate([1 - buffer.uv.sum(axis=-1, keepdims=True), buffer.uv], axis=-1)
    mean = np.einsum("nk,nkc->nc", weights[same], vertices[triangles[buffer.triangle[same]]].astype(float))
    np.testing.assert_allclose(mean, points[same], atol=1e-5)
    np.testing.assert_allclose(np.median(np.abs(buffer.depth[same] - hits.distance[same])), 0, atol=1e-6)
    nothing = buffer.triangle == NO_TRIANGLE
    assert (buffer.depth[nothing] == 0).all()
    assert (buffer.depth[~nothing] > 0).all()


def test_rasterized_closed_surface_has_no_gaps() -> None:
    """The camera is inside a triangulated ball. Some pixels are on edges and corners of triangles."""
    side = 40
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, side), np.linspace(0, 2 * np.pi, side, endpoint=False), indexing="ij"
    )
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(side - 1), np.arange(side), indexing="ij"))
    a, b = i * side + j, i * side + (j + 1) % side
    triangles = np.concatenate([np.stack([a, b, a + side], 1), np.stack([b, b + side, a + side], 1)]).astype(np.int32)
    for T in (np.eye(4), look(np.array([0.3, 0.0, 0.0]), 1.0, 0.5, 0.2)):
        for faces in (triangles, triangles[:, ::-1].copy()):  # both orientations
            assert (drawn(ball.astype(np.float32), faces, T) >= 0).all()


def test_rasterizer_includes_pixels_on_edges_and_corners() -> None:
    """The rectangle from (1, 1) to (5, 4) px consists of two triangles."""
    camera = Camera(8, 6, 4.0, 4.0, 0.0, 0.0)
    vertices = np.array([[1, 1], [5, 1], [5, 4], [1, 4]], np.float32) / 4 * 2
    vertices = np.column_stack([vertices, np.full(4, 2, np.float32)])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    seen = drawn(vertices, triangles, np.eye(4), camera)
    expected = np.zeros((6, 8), np.bool_)
    expected[1:5, 1:6] = True
    np.testing.assert_array_equal(seen >= 0, expected)
    assert [seen[1, 1], seen[1, 5], seen[4, 5], seen[4, 1]] == [0, 1, 2, 3]


def test_rasterizer_draws_nearest_surface_in_any_order() -> None:
    near = np.array([[-9, -9, 1], [9, -9, 1], [0, 9, 1]], np.float32)
    vertices = np.concatenate([near, 2 * near])
    for order in ([0, 1], [1, 0]):
        triangles = np.array([[0, 1, 2], [3, 4, 5]], np.int32)[order]
        assert (drawn(vertices, triangles, np.eye(4)) < 3).all()
        behind = np.diag([1.0, -1.0, -1.0, 1.0])
        assert (drawn(vertices, triangles, behind) == -1).all()


def test_rasterizer_ignores_degenerate_triangles() -> None:
    nothing = np.zeros((0, 3), np.float32)
    assert (drawn(nothing, np.zeros((0, 3), np.int32), np.eye(4)) == -1).all()
    edge_on = np.array([[0, 0, 1], [0, 0, 2], [0, 1, 1]], np.float32)
    flat = np.array([[0, 1, 2], [0, 0, 0], [0, 0, 1]], np.int32)
    assert (drawn(edge_on, flat, np.eye(4)) == -1).all()


def test_rasterizer_is_thread_safe() -> None:
    vertices, triangles = random_triangles(np.random.default_rng(0), 0.1, 3000)
    rasterizer = Rasterizer(vertices, triangles)
    poses = [exp_se3(np.random.default_rng(k).normal(0, 1, 6)) for k in range(8)]
    alone = [rasterizer.draw(CAMERA, T) for T in poses]
    together: dict[int, VisibilityBuffer] = {}

    def draw(k: int) -> None:
        together[k] = rasterizer.draw(CAMERA, poses[k])

    threads = [threading.Thread(target=draw, args=(k,)) for k in range(len(poses))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, expected in enumerate(alone):
        for a, b in zip(astuple(together[k]), astuple(expected), strict=True):
            np.testing.assert_array_equal(a, b)
