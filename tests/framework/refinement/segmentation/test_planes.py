"""Tests for plane detection in depth images. Noisy planes are compared with the RANSAC of Open3D."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.refinement.segmentation.planes import Planes, find_planes, plane_image
from framework.refinement.segmentation.planes_kernels import _order
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
FLOOR, WALL = np.array([0.0, 1 / 1.2, 0.0]), np.array([0.1, 0.05, 0.3])  # 1/m, unit normal divided by the distance


@pytest.mark.parametrize("count", [1, 2, 3, 10, 257])
def test_order_statistic_matches_sorted_values(count):
    values = np.random.default_rng(count).integers(0, 40, count).astype(np.float64)  # contains duplicates
    for k in range(count):
        assert _order(values.copy(), k) == np.sort(values)[k]


def rays(camera: Camera = CAMERA) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def depth_of(*planes: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Return the depth (H, W), m, of the nearest plane at each pixel, 0 = no plane."""
    q = np.max([rays(camera) @ m for m in planes], axis=0)
    return np.where(q > 0.02, 1 / np.maximum(q, 1e-9), 0)


def frame_of(depth: np.ndarray, camera: Camera = CAMERA) -> Frame:
    return Frame(0, 0.0, np.zeros((*camera.shape, 3), np.uint8), depth.astype(np.float32), camera)


def found(depth: np.ndarray, camera: Camera = CAMERA, min_area: float = 0.5) -> Planes:
    return find_planes(frame_of(depth, camera), distance=0.02, noise=0.003, min_area=min_area)


def nearest(planes: Planes, m: np.ndarray) -> int:
    return int(np.linalg.norm(planes.m - m, axis=1).argmin())


@pytest.mark.parametrize("camera", [CAMERA, Camera(75, 41, 50.0, 60.0, 30.0, 22.0)])
def test_find_planes_recovers_exact_plane(camera):
    planes = found(depth_of(WALL, camera=camera), camera)
    assert len(planes) == 1
    np.testing.assert_allclose(planes.m[0], WALL, atol=1e-6)
    np.testing.assert_allclose(planes.normals[0], -WALL / np.linalg.norm(WALL), atol=1e-6)
    assert planes.deviations[0] < 1e-6
    assert planes.fractions[0] > 0.95, "expected all pixels except incomplete cells at the border"
    assert planes.behind[0] == 0


def test_plane_area_matches_pixel_triangle_area():
    depth = depth_of(WALL)
    points = rays() * depth[..., None]
    sides = points[1:, :-1] - points[:-1, :-1], points[:-1, 1:] - points[:-1, :-1]
    area = np.linalg.norm(np.cross(*sides), axis=-1).sum() * (320 * 240) / (319 * 239)
    assert found(depth).areas[0] == pytest.approx(area, rel=0.01)
    assert len(found(depth, min_area=1.02 * area)) == 0


def test_find_planes_in_noisy_room_matches_open3d():
    """Floor and wall have Kinect noise. The larger plane is also compared with segment_plane of Open3D."""
    open3d = pytest.importorskip("open3d")
    exact = depth_of(FLOOR, WALL)
    depth = exact + np.random.default_rng(0).normal(0, 0.002, exact.shape) * exact**2
    planes = found(depth)
    assert len(planes) == 2
    for m in (FLOOR, WALL):
        k = nearest(planes, m)
        assert planes.normals[k] @ (-m / np.linalg.norm(m)) > np.cos(np.deg2rad(0.3))
        assert 1 / np.linalg.norm(planes.m[k]) == pytest.approx(1 / np.linalg.norm(m), abs=0.01)
        assert planes.deviations[k] == pytest.approx(0.002, rel=0.2)
    cloud = open3d.geometry.PointCloud(
        open3d.utility.Vector3dVector((rays() * depth[..., None])[::4, ::4].reshape(-1, 3))
    )
    open3d.utility.random.seed(0)
    (a, b, c, d), _ = cloud.segment_plane(0.03, 3, 500)
    k = nearest(planes, np.array([a, b, c]) / -d)
    assert abs(planes.normals[k] @ [a, b, c]) > np.cos(np.deg2rad(2.0))
    assert 1 / np.linalg.norm(planes.m[k]) == pytest.approx(abs(d), abs=0.05)
    assert k == planes.fractions.argmax()


def test_find_planes_merges_divided_wall():
    depth = depth_of(WALL)
    depth[:, 140:180] = 1.0 + 0.3 * np.sin(np.arange(40) / 3)
    planes = found(depth)
    k = nearest(planes, WALL)
    assert planes.fractions[k] == pytest.approx(7 / 8, abs=0.08)
    image = plane_image(frame_of(depth), planes.chosen(np.arange(len(planes)) == k), 0.02)
    assert (image == (np.abs(np.arange(320) - 159.5) > 20)).all()


def test_find_planes_separates_parallel_planes():
    near, far = np.array([0, 0, 1 / 2.0]), np.array([0, 0, 1 / 2.08])
    depth = depth_of(far)
    depth[:, :150] = 2.0
    planes = found(depth)
    assert len(planes) == 2
    np.testing.assert_allclose(planes.m[[nearest(planes, near), nearest(planes, far)]], [near, far], atol=1e-5)
    assert planes.behind[nearest(planes, far)] == 0
    assert planes.behind[nearest(planes, near)] == pytest.approx(170 / 150, rel=0.1)


def test_plane_image_assigns_depth_within_distance():
    """The distance of the points along the normal of the plane is 19 mm or 21 mm."""
    m = np.array([0.0, 0.5, 0.5])
    planes = found(depth_of(m))
    image = plane_image(frame_of(depth_of(m)), planes, 0.02)
    assert (image == 1).all()
    for off, on in ((0.019, True), (-0.019, True), (0.021, False), (-0.021, False)):
        moved = m / (1 + off * np.linalg.norm(m))
        assert (plane_image(frame_of(depth_of(moved)), planes, 0.02) == on).all()


def test_plane_image_assigns_nearest_plane():
    planes = found(depth_of(FLOOR, WALL))
    floor, wall = nearest(planes, FLOOR), nearest(planes, WALL)
    image = plane_image(frame_of(depth_of(FLOOR, WALL)), planes, 0.3)
    right = np.where(rays() @ FLOOR > rays() @ WALL, floor + 1, wall + 1)
    clear = np.abs(rays() @ FLOOR - rays() @ WALL) > 1e-4
    np.testing.assert_array_equal(image[clear], right[clear])


def test_find_planes_without_plane_is_empty():
    rng = np.random.default_rng(0)
    assert len(found(rng.uniform(0.5, 5, CAMERA.shape))) == 0
    assert len(found(np.zeros(CAMERA.shape))) == 0
    one = np.zeros(CAMERA.shape)
    one[100, 100] = 1.0
    assert len(found(one)) == 0
    assert not plane_image(frame_of(one), found(one), 0.02).any()
    tiny = Camera(1, 1, 1.0, 1.0, 0.0, 0.0)
    assert len(found(np.ones((1, 1)), tiny)) == 0
    assert len(found(np.ones((1, 400)), Camera(400, 1, 50.0, 50.0, 200.0, 0.0), min_area=0.0)) == 0, (
        "expected no plane in a row of pixels"
    )


def test_plane_image_without_depth_is_zero():
    depth = depth_of(WALL)
    depth[50:60] = 0
    assert not plane_image(frame_of(depth), found(depth), 0.02)[50:60].any()


def test_find_planes_is_independent_of_thread_count():
    exact = depth_of(FLOOR, WALL)
    frame = frame_of(exact + np.random.default_rng(0).normal(0, 0.002, exact.shape) * exact**2)

    def find():
        planes = find_planes(frame, 0.02, 0.003, 0.5)
        return [*vars(planes).values(), plane_image(frame, planes, 0.02)]

    for one, other in zip(*by_one_thread_and_two(find), strict=True):
        np.testing.assert_array_equal(one, other)
