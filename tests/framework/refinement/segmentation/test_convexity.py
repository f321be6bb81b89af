"""Tests for convex segments of rendered boxes. Each step is compared with a slow reference."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from framework.data import Camera
from framework.refinement.segmentation import convexity, convexity_kernels
from framework.refinement.segmentation.convexity import Limits, normal_sigma, segments
from framework.sensors.noise_models import SensorKind
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(160, 120, 135.0, 135.0, 79.5, 59.5)
LIMITS = Limits(noise_factor=3.0, min_noise=0.0, max_slope=4.0, max_angle=np.deg2rad(15.0))
NOISE = convexity_kernels.Noise(3.0, 0.0, *SensorKind.KINECT_V1.noise[:3])


def cut(depth: np.ndarray, camera: Camera = CAMERA, **changed: int) -> tuple[np.ndarray, int]:
    return segments(
        depth.astype(np.float32),
        camera,
        **({"cell": 1, "window": 3, "limits": LIMITS, "closing": 1, "min_pixels": 30} | changed),
    )


def rendered(
    boxes: np.ndarray, floor: float | None, pitch: float, camera: Camera = CAMERA
) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth (H, W), m, and the ids (H, W) of a floor and of boxes.

    The floor has id 0 and box k has id k. Pixels without a surface have depth 0 and id -1. The camera is at the origin.
    The y axis of the world points down, and z is forward.

    Args:
        boxes: The minimum and maximum corners (B, 6), m.
        floor: Height of the camera above the floor, m; None = no floor.
        pitch: Angle by which the camera looks down, rad.
        camera: Intrinsics of the rendered images.
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    x, y, z = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)
    rays = np.stack([x, y * np.cos(pitch) + z * np.sin(pitch), z * np.cos(pitch) - y * np.sin(pitch)], axis=-1)
    depth, ids = np.full(u.shape, np.inf), np.full(u.shape, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        if floor is not None:
            depth = np.where(rays[..., 1] > 0, floor / rays[..., 1], np.inf)
            ids = np.where(np.isfinite(depth), 0, -1)
        for k, box in enumerate(boxes):
            near, far = box[:3] / rays, box[3:] / rays
            first, last = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
            hit = (first <= last) & (first > 0) & (first < depth)
            depth, ids = np.where(hit, first, depth), np.where(hit, k + 1, ids)
    return np.where(np.isfinite(depth), depth, 0.0), ids


def noisy(depth: np.ndarray, noise: float) -> np.ndarray:
    sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    return np.where(depth > 0, depth + noise * sigma * np.random.default_rng(0).normal(size=depth.shape), 0.0)


def main_segment(labels: np.ndarray, region: np.ndarray) -> tuple[int, float, float]:
    """Return the main segment of a region, its fraction of the region, and the region's fraction of the segment."""
    label = np.bincount(labels[region] + 1).argmax() - 1
    both = ((labels == label) & region).sum()
    return int(label), both / region.sum(), both / (labels == label).sum()


@pytest.mark.parametrize("cell", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_segments_separate_boxes_adjacent_in_image(cell, noise):
    """The near box occludes an edge of the far box. The depth step between them is 0.4 m."""
    boxes = np.array([[-0.5, -0.3, 1.2, 0.0, 0.3, 1.5], [-0.1, -0.4, 1.6, 0.6, 0.4, 2.0]])
    depth, ids = rendered(boxes, None, 0.0)
    labels, count = cut(noisy(depth, noise), cell=cell)
    (one, covered_one, pure_one), (two, covered_two, pure_two) = (main_segment(labels, ids == k) for k in (1, 2))
    assert one != two
    assert min(covered_one, covered_two) > 0.98
    assert min(pure_one, pure_two) > 0.99
    assert count == 2
    assert (labels[depth == 0] == -1).all()


@pytest.mark.parametrize("cell", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_segments_separate_box_from_table(cell, noise):
    """The camera looks down at the front, the top and the left face of the box."""
    camera = Camera(160, 120, 90.0, 90.0, 79.5, 59.5).scaled(cell)
    boxes = np.array([[0.35, 0.3, 0.9, 0.65, 0.6, 1.3]])
    depth, ids = rendered(boxes, 0.6, 0.5, camera)
    labels, _ = cut(noisy(depth, noise), camera, cell=cell)
    box, covered_box, pure_box = main_segment(labels, ids == 1)
    table, covered_table, _ = main_segment(labels, (ids == 0) & (depth < 2.0))
    assert box != table, "expected two segments at a concave edge"
    assert covered_box > 0.95, "expected one segment across convex edges"
    assert min(covered_table, pure_box) > 0.97
    assert (labels[ids == 1] == table).mean() < 0.02
    for face in faces_of(boxes[0], 0.5, camera, depth, ids == 1):
        assert face.sum() > 150, "expected three visible faces"
        assert main_segment(labels, face)[:1] == (box,)
        assert main_segment(labels, face)[1] > 0.9


def faces_of(box: np.ndarray, pitch: float, camera: Camera, depth: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """Return the pixels of the left, top and front face of a box."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    x, y = (u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth
    point = [x, y * np.cos(pitch) + depth * np.sin(pitch), depth * np.cos(pitch) - y * np.sin(pitch)]
    return [inside & (np.abs(point[a] - box[a]) < 1e-9) for a in range(3)]


@pytest.mark.parametrize("cell", [1, 2])
def test_segments_split_at_depth_step_not_at_slope(cell):
    """The step is 2.5 cm, like between a book and a table. On the slope, depth changes more from pixel to pixel."""
    depth = np.full(CAMERA.shape, 1.025)
    depth[30:90, 40:100] = 1.0
    labels, count = cut(depth, cell=cell)
    assert count == 2
    assert (labels[31:89, 41:99] != labels[0, 0]).all()
    x = np.arange(CAMERA.width) - CAMERA.cx
    sloped = np.tile(1.0 / (1.0 - 0.01 * x), (CAMERA.height, 1))[:, :130]
    assert np.diff(sloped[0]).max() > 0.025
    assert cut(sloped, Camera(130, 120, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), cell=cell)[1] == 1


def test_segments_convex_ball_is_one_segment():
    v, u = np.mgrid[:120, :160]
    x, y = (u - 79.5) / 135, (v - 59.5) / 135
    # first intersection of each ray with a ball of radius 0.3 m around (0, 0, 1.2) m
    a, b, c = x**2 + y**2 + 1, -2 * 1.2, 1.2**2 - 0.3**2
    root = b * b - 4 * a * c
    ball = root > 0
    depth = np.where(ball, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), 0)
    labels, _ = cut(depth)
    _, covered, _ = main_segment(labels, ball)
    assert covered > 0.95


def test_fit_planes_on_plane_is_exact():
    """The inverse depth of a plane is linear in the pixel, so all windows give the same plane."""
    v, u = np.mgrid[:12, :20]
    inverse = (0.5 + 0.004 * u - 0.003 * v).astype(np.float32)
    fits = convexity_kernels.fit_planes(inverse, 2, NOISE, np.float32(0.1))
    np.testing.assert_allclose(fits[0], 0.004, atol=2e-6)
    np.testing.assert_allclose(fits[1], -0.003, atol=2e-6)
    np.testing.assert_allclose(fits[2], inverse, atol=2e-6)
    np.testing.assert_allclose(fits[3], 0, atol=1e-10)


def test_fit_planes_matches_lstsq_on_similar_depth():
    rng = np.random.default_rng(0)
    inverse = (0.5 + rng.normal(0, 0.002, (9, 11))).astype(np.float32)
    inverse[:, 6:] += 0.4  # another surface in front of the first one
    inverse[rng.random(inverse.shape) < 0.2] = 0
    fits = convexity_kernels.fit_planes(inverse, 2, NOISE, np.float32(0.01))
    found = 0
    for r, c in np.argwhere(inverse > 0):
        v, u = np.mgrid[max(r - 2, 0) : min(r + 3, 9), max(c - 2, 0) : min(c + 3, 11)]
        like = (inverse[v, u] > 0) & ((u >= 6) == (c >= 6))
        x, y, e = u[like] - c, v[like] - r, inverse[v, u][like].astype(np.float64)
        if len(e) < 8 or not np.isfinite(fits[3, r, c]):
            continue
        found += 1
        plane, _, _, _ = np.linalg.lstsq(np.stack([x, y, np.ones(len(x))], axis=1), e, rcond=None)
        np.testing.assert_allclose(fits[:3, r, c], plane, atol=1e-5)
        residual = e - np.stack([x, y, np.ones(len(x))], axis=1) @ plane
        assert fits[3, r, c] == pytest.approx((residual**2).mean(), rel=0.02, abs=1e-9)
    assert found > 50


def test_best_planes_at_crease_use_same_side():
    u = np.arange(31)
    inverse = np.tile(np.where(u < 15, 0.5, 0.5 + 0.02 * (u - 14.5)), (15, 1)).astype(np.float32)
    planes = convexity_kernels.best_planes(
        inverse, convexity_kernels.fit_planes(inverse, 3, NOISE, np.float32(1.0)), 3, NOISE
    )
    np.testing.assert_allclose(planes[0, 5, :15], 0, atol=1e-4)
    np.testing.assert_allclose(planes[0, 5, 15:], 0.02, atol=1e-4)


def test_normal_sigma_matches_spread_of_fitted_normals():
    """The angle between the normals of separate windows is measured on a noisy wall 1 m away."""
    rng = np.random.default_rng(0)
    cell, window, sigma = 1, 3, 0.002
    depth = 1 + rng.normal(0, sigma, (7 * 30, 7 * 40))
    camera = Camera(280, 210, 135.0, 135.0, 139.5, 104.5)
    fits = convexity_kernels.fit_planes(
        (1 / depth).astype(np.float32), window, NOISE._replace(factor=10.0), np.float32(1.0)
    )
    slopes = fits[0, 3::7, 3::7] * camera.fx  # depth slopes along x in separate windows
    assert np.sqrt(2) * slopes.std() == pytest.approx(normal_sigma(sigma, window, cell, camera), rel=0.1)


def test_convexity_components_match_scipy():
    rng = np.random.default_rng(0)
    inverse = np.ones((70, 41), np.float32)
    for density in (0.2, 0.4):
        edges = rng.random(inverse.shape) < density
        labels, count = convexity_kernels.connected(inverse, edges, NOISE, np.float32(0.1), 1)
        expected, expected_count = ndimage.label(~edges)
        assert count == expected_count
        # in both results, components are ordered by their first cell
        np.testing.assert_array_equal(labels, expected - 1)
        large, large_count = convexity_kernels.connected(inverse, edges, NOISE, np.float32(0.1), 5)
        sizes = np.bincount(expected.ravel())
        np.testing.assert_array_equal(large >= 0, (sizes[expected] >= 5) & ~edges)
        assert large_count == (sizes[1:] >= 5).sum()


def test_convexity_components_split_at_depth_step():
    inverse = np.ones((4, 10), np.float32)
    inverse[:, 5:] = 0.5
    labels, count = convexity_kernels.connected(inverse, np.zeros((4, 10), bool), NOISE, np.float32(0.01), 1)
    assert count == 2
    np.testing.assert_array_equal(labels, np.tile(np.repeat([0, 1], 5), (4, 1)))


@pytest.mark.parametrize("radius", [0, 1, 2])
def test_convexity_edge_closing_matches_scipy(radius):
    edges = np.random.default_rng(0).random((30, 43)) < 0.1
    square = np.ones((2 * radius + 1, 2 * radius + 1))
    spread = ndimage.binary_dilation(edges, square)
    expected = ndimage.binary_erosion(spread, square, border_value=1)
    np.testing.assert_array_equal(convexity._closed(edges, radius), expected)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 3), (17, 33)])
@pytest.mark.parametrize("cell", [1, 2, 3])
def test_segments_of_degenerate_images_are_valid(shape, cell):
    height, width = shape
    camera = Camera(width, height, 50.0, 60.0, width / 2, height / 2)
    for depth in (np.zeros(shape), np.full(shape, 2.0), np.random.default_rng(0).uniform(0.3, 9, shape)):
        labels, count = cut(depth, camera, cell=cell, min_pixels=1)
        assert labels.shape == shape
        assert labels.max(initial=-1) < count or count == 0
        assert (labels[depth == 0] == -1).all()
    labels, _ = cut(np.full(shape, 2.0), camera, cell=cell, min_pixels=1)
    assert (labels == labels[0, 0]).all(), "expected one segment for a flat wall"
    assert labels[0, 0] >= 0


def test_segments_are_not_split_by_line_without_depth():
    depth = np.full(CAMERA.shape, 2.0)
    depth[60, :100] = 0
    labels, count = cut(depth)
    assert count == 1
    assert ((labels == 0) == (depth > 0)).all()


def test_segments_are_independent_of_thread_count():
    boxes = np.array([[0.15, 0.3, 1.1, 0.55, 0.6, 1.5], [-0.5, 0.4, 1.0, -0.2, 0.6, 1.2]])
    depth = noisy(rendered(boxes, 0.6, 0.5)[0], 1.0)
    np.testing.assert_array_equal(*by_one_thread_and_two(lambda: cut(depth)[0]))


@pytest.mark.parametrize(("sensor", "count"), [(SensorKind.KINECT_V1, 1), (SensorKind.EXACT, 2)])
def test_segments_split_at_steps_above_sensor_noise(sensor, count):
    depth = np.full(CAMERA.shape, 3.0)
    depth[:, 80:] = 3.03  # the step is 2 standard deviations of the Kinect noise
    assert cut(depth, sensor=sensor)[1] == count
