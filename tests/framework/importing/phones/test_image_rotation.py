"""Tests for image rotation. Images, cameras, poses and lens models must be rotated consistently."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.calibration.undistortion import Distortion
from framework.importing.phones.image_rotation import Turn, upright
from tests.support.scenes.corner_room import look, pose_at

CAMERA = Camera(64, 48, 60.0, 62.0, 30.0, 25.5)
QUARTERS = [0, 1, 2, 3]


@pytest.mark.parametrize("quarters", QUARTERS)
def test_image_rotation_camera_sees_rotated_image(quarters: int) -> None:
    turn = Turn(quarters)
    depth, _, color, _ = look(CAMERA, pose_at(3))
    turned_depth, _, turned_color, _ = look(turn.camera(CAMERA), turn.pose(pose_at(3)))
    np.testing.assert_allclose(turn.image(depth), turned_depth, atol=1e-6)
    assert np.abs(turn.image(color).astype(int) - turned_color).max() <= 1


def test_image_rotation_quarter_turn_is_clockwise() -> None:
    np.testing.assert_array_equal(Turn(1).image(np.array([[1, 2], [3, 4]])), [[3, 1], [4, 2]])
    assert Turn(1).camera(CAMERA) == Camera(48, 64, 62.0, 60.0, 47 - 25.5, 30.0)


@pytest.mark.parametrize("quarters", QUARTERS)
def test_image_rotation_rotates_lens_with_camera(quarters: int) -> None:
    turn, lens = Turn(quarters), Distortion(0.1, -0.2, 0.01, 0.02, 0.03)
    pixels = np.array([[3.0, 5.0], [60.0, 40.0], [10.0, 44.0]])

    def turned(points: np.ndarray) -> np.ndarray:
        camera = CAMERA
        for _ in range(quarters):
            points = np.stack([camera.height - 1 - points[:, 1], points[:, 0]], axis=1)
            camera = Turn(1).camera(camera)
        return points

    found = turn.lens(lens).distorted(turn.camera(CAMERA), turned(pixels))
    np.testing.assert_allclose(found, turned(lens.distorted(CAMERA, pixels)), atol=1e-9)


@pytest.mark.parametrize(("up", "quarters"), [((0, -1, 0), 0), ((-1, 0, 0), 1), ((0, 1, 0), 2), ((1, 0, 0), 3)])
def test_upright_turn_maps_up_direction_to_image_top(up: tuple[float, ...], quarters: int) -> None:
    assert upright([np.array(up), np.array(up)]) == Turn(quarters)
    assert (Turn(quarters).R_turned_camera @ up)[1] == pytest.approx(-1)


def test_upright_turn_of_downward_camera_is_unknown() -> None:
    assert upright([np.array([0.1, 0.2, 0.97])]) is None
    assert upright([]) is None
