"""Tests for the image windows of 3D boxes."""

import numpy as np

from framework.baselines.object_volume import boxes_in_view
from framework.data import Camera
from framework.geometry import inverse, project, transform
from tests.support.scenes.analytic_scene import pose

CAMERA = Camera(40, 30, 35.0, 33.0, 18.0, 15.5)
NEAR = 0.2


def test_box_window_contains_all_visible_points() -> None:
    random = np.random.default_rng(0)
    low = random.uniform(-3, 3, (200, 3))
    high = low + random.uniform(0.01, 2, (200, 3))
    T = pose(0.3, -0.2, 0.1, (0.4, -0.3, 0.2))
    windows = boxes_in_view(CAMERA, T, low, high, NEAR)
    seen = 0
    for k, (u0, v0, u1, v1) in enumerate(windows):
        points = random.uniform(low[k], high[k], (500, 3))
        points_camera = transform(inverse(T), points)
        points_camera = points_camera[points_camera[:, 2] > NEAR]
        u, v = np.rint(project(CAMERA, points_camera)).T
        inside = (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)
        assert ((u[inside] >= u0) & (u[inside] < u1) & (v[inside] >= v0) & (v[inside] < v1)).all()
        seen += inside.any()
    empty = (windows[:, 0] >= windows[:, 2]) | (windows[:, 1] >= windows[:, 3])
    assert 20 < seen <= (~empty).sum() < 50, "expected most of the 200 boxes to be out of view"


def test_box_window_in_front_of_camera_is_tight() -> None:
    low, high = np.array([[-0.1, -0.1, 1.0]]), np.array([[0.1, 0.1, 2.0]])
    [window] = boxes_in_view(CAMERA, np.eye(4), low, high, NEAR).tolist()
    # the box extends over 18 ± 3.5 px and 15.5 ± 3.3 px; its window is rounded outward
    assert window == [14, 12, 23, 20]


def test_box_window_behind_camera_is_empty() -> None:
    low, high = np.array([[-0.1, -0.1, -2.0]]), np.array([[0.1, 0.1, -1.0]])
    [window] = boxes_in_view(CAMERA, np.eye(4), low, high, NEAR).tolist()
    assert window[0] >= window[2]
