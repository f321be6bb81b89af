"""Tests for the registration of depth to a second camera."""

from __future__ import annotations

import numpy as np

from framework.data import Camera
from framework.importing.depth_resampling import FINEST, DepthRegistration
from tests.support.recordings.phone_exports import T_COLOR_DEPTH
from tests.support.scenes.corner_room import look

COLOR, DEPTH = Camera(320, 240, 300.0, 301.0, 157.0, 118.0), Camera(400, 260, 220.0, 221.0, 205.0, 128.0)


def loops(registration: DepthRegistration, depth: np.ndarray) -> np.ndarray:
    found = np.full(registration.target.shape, np.inf)
    for (v, u), z in np.ndenumerate(depth):
        if z == 0:
            continue
        point = np.linalg.inv(registration.depth.K) @ (u, v, 1) * z
        x, y, w = registration.target.K @ (registration.T_color_depth @ [*point, 1])[:3]
        row, column = int(np.floor(y / w + 0.5)), int(np.floor(x / w + 0.5))
        if w > 0 and 0 <= row < len(found) and 0 <= column < found.shape[1]:
            found[row, column] = min(found[row, column], w)
    return np.where(np.isfinite(found), found, 0)


def test_depth_registration_matches_reference_loops() -> None:
    rng = np.random.default_rng(0)
    small = DepthRegistration(DEPTH.scaled(0.1), COLOR.scaled(0.1), T_COLOR_DEPTH)
    depth = rng.choice([0, 0.3, 1, 2.5], small.depth.shape).astype(np.float32)
    found = small.apply(depth)
    assert 0.3 < (found > 0).mean() < 1
    np.testing.assert_allclose(found, loops(small, depth), rtol=1e-6)


def test_depth_registration_of_room_matches_target_view() -> None:
    registration = DepthRegistration(DEPTH, COLOR, T_COLOR_DEPTH)
    target = registration.target
    assert target.fx <= FINEST * DEPTH.fx + 1
    found = registration.apply(look(DEPTH, T_COLOR_DEPTH)[0].astype(np.float32))
    truth = look(target, np.eye(4))[0]
    assert (found > 0).mean() > 0.97
    error = np.abs(found - truth)[found > 0]
    assert np.median(error) < 0.004  # a depth value is up to half a pixel from the center of its new pixel
    assert (error > 0.03).mean() < 0.03
    turned_back = DepthRegistration(DEPTH, COLOR, np.linalg.inv(T_COLOR_DEPTH))
    wrong = turned_back.apply(look(DEPTH, T_COLOR_DEPTH)[0].astype(np.float32))
    assert np.median(np.abs(wrong - truth)[wrong > 0]) > 2 * np.median(error)


def test_depth_registration_keeps_nearer_of_two_surfaces() -> None:
    camera = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    shifted = np.eye(4)
    shifted[0, 3] = 0.5
    depth = np.full((30, 40), 4.0, np.float32)
    depth[:, :10] = 1.0  # moves by 20 px; the far surface moves by 5 px
    found = DepthRegistration(camera, camera, shifted).apply(depth)
    assert set(np.unique(found)) == {0, 1, 4}
    assert (found[:, 18:26] == 1).all()


def test_depth_registration_drops_points_behind_camera() -> None:
    camera = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    behind = np.eye(4)
    behind[2, 3] = -3.0
    assert not DepthRegistration(camera, camera, behind).apply(np.full((30, 40), 2.0, np.float32)).any()
