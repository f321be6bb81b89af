"""Tests for the up direction, the floor height and upright boxes.

On exact surfaces, the error of the up direction must be below 0.1 degrees, and with noise and clutter below 2 degrees.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Float32, Float64, Int32
from framework.errors import DataError
from framework.mapping.gravity import GravityEstimator, faces, floor_height, half_sphere
from framework.mapping.instances.instance_list import box_around, upright_box
from framework.mapping.storage.map_header import MapHeader


def rectangle(origin: Float64, a: Float64, b: Float64, cells: int = 12) -> tuple[Float32, Int32]:
    """Return the vertices, m, and triangles of a rectangle with the edges a and b and the normal a x b."""
    s, t = np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1), indexing="ij")
    vertices = origin + s.reshape(-1, 1) * a + t.reshape(-1, 1) * b
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    quads = np.stack([corner, corner + cells + 1, corner + cells + 2, corner + 1], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return vertices.astype(np.float32), triangles.astype(np.int32)


def joined(*parts: tuple[Float32, Int32]) -> tuple[Float32, Int32]:
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = [part[1] + np.int32(first) for part, first in zip(parts, firsts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)


X, Y, Z = np.eye(3)


def room() -> tuple[Float32, Int32]:
    """Return the mesh of a floor at z = 0, a table and two walls. The walls are larger than the floor."""
    return joined(
        rectangle(np.zeros(3), 3 * X, 4 * Y),
        rectangle(np.array([1.0, 1, 0.7]), X, Y),
        rectangle(np.zeros(3), 4 * Y, 5 * Z),
        rectangle(np.array([0.0, 0, 0]), 5 * Z, 3 * X),
    )


def held(turned: Float64, downwards: float = 0.5) -> GravityEstimator:
    """Return the estimator for a hand-held camera that looks down by `downwards` rad.

    `turned` (3, 3) is the rotation of the world frame.
    """
    gravity = GravityEstimator()
    for k in range(8):
        heading = Rotation.from_euler("z", k / 8 * 3)
        # camera axes: x right, y down, z forward; at heading 0, forward is the y axis of the world
        looking = Rotation.from_matrix(np.stack([X, -Z, Y], axis=1)) * Rotation.from_euler("x", -downwards)
        T = np.eye(4)
        T[:3, :3] = turned @ (heading * looking).as_matrix()
        gravity.add_frame(T)
    return gravity


@pytest.mark.parametrize("seed", range(6))
def test_gravity_up_is_found_in_any_orientation(seed: int) -> None:
    turned = Rotation.random(random_state=seed).as_matrix()
    vertices, triangles = room()
    up = held(turned).estimate((vertices @ turned.T).astype(np.float32), triangles).up
    assert up is not None
    assert np.degrees(np.arccos(min(up @ turned @ Z, 1.0))) < 0.05
    floor = floor_height((vertices @ turned.T).astype(np.float32), triangles, up)
    assert floor == pytest.approx(0, abs=0.005)


def test_gravity_upward_faces_select_axis() -> None:
    """The camera is tilted. It sees a table, walls and a surface that is rotated about x, like in freiburg1_rpy."""
    vertices, triangles = joined(
        rectangle(np.zeros(3), 2 * X, 2 * Y),
        rectangle(2 * X, 2 * Z, 2 * Y),  # a wall with normal -x in front of the camera, which is tilted toward x
        rectangle(2 * Y, 1.5 * X, 1.5 * Z),
        rectangle(3 * Y, X, Y + Z),  # a lid rotated about x
    )
    askew = GravityEstimator()
    askew.camera_up = np.array([0.68, 0.2, 0.7])  # 1 degree closer to z than to x
    up = askew.estimate(vertices, triangles).up
    assert up is not None
    assert np.degrees(np.arccos(min(up @ Z, 1.0))) < 0.1


def test_gravity_noise_and_clutter_keep_direction() -> None:
    chosen = np.random.default_rng(0)
    vertices, triangles = room()
    heap = [rectangle(chosen.normal(size=3), chosen.normal(size=3), chosen.normal(size=3), 3) for _ in range(20)]
    vertices, triangles = joined((vertices, triangles), *heap)
    noisy = vertices + chosen.normal(scale=0.005, size=vertices.shape).astype(np.float32)
    up = held(np.eye(3)).estimate(noisy, triangles).up
    assert up is not None
    assert np.degrees(np.arccos(up @ Z)) < 2


def test_gravity_without_evidence_is_none() -> None:
    vertices, triangles = room()
    assert GravityEstimator().estimate(vertices, triangles).up is None
    assert held(np.eye(3)).estimate(vertices, triangles[:0]).up is None
    directions = half_sphere(500) * np.where(np.arange(500) % 2, 1, -1)[:, None]
    pebbles = [rectangle(8 * n, *np.linalg.svd(n[None])[2][1:], 1) for n in directions]  # all slopes differ
    assert held(np.eye(3)).estimate(*joined(*pebbles)).up is None


def test_floor_height_of_unseen_floor_is_none() -> None:
    """Only a table, its legs and objects below the table are visible."""
    table = rectangle(np.array([0, 0, 0.7]), X, Y)
    legs = [rectangle(np.array([0.1 * k, 0, 0.0]), 0.3 * Y, 0.6 * Z, 4) for k in range(5)]
    vertices, triangles = joined(table, *legs)
    assert floor_height(vertices, triangles, Z) is None
    assert floor_height(*rectangle(np.zeros(3), Y, Z), Z) is None


def test_faces_have_normals_areas_and_centers_of_triangles() -> None:
    vertices = np.float32([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 0]])
    # the area of the second triangle is zero
    normals, areas, centers = faces(vertices, np.int32([[0, 1, 2], [0, 3, 1]]))
    np.testing.assert_allclose(normals, [[0, 0, 1]])
    np.testing.assert_allclose(areas, [3])
    np.testing.assert_allclose(centers, [[2 / 3, 1, 0]])


def sensing(
    turned: Float64, noise: float = 0.0, bias: float = 0.0, frames: int = 40, seed: int = 0
) -> GravityEstimator:
    """Return the estimator for a camera that turns by 360 degrees. `noise` and `bias` of the sensor are in rad."""
    gravity, chosen = GravityEstimator(), np.random.default_rng(seed)
    for k in range(frames):
        looking = Rotation.from_matrix(np.stack([X, -Z, Y], axis=1)) * Rotation.from_euler("x", -0.5)
        T = np.eye(4)
        T[:3, :3] = turned @ (Rotation.from_euler("z", 2 * np.pi * k / frames) * looking).as_matrix()
        up_camera = T[:3, :3].T @ turned @ Z
        up_camera = Rotation.from_euler("x", bias).apply(up_camera) + chosen.normal(scale=noise, size=3)
        gravity.add_frame(T, up_camera / np.linalg.norm(up_camera))
    return gravity


def degrees(up: Float64 | None, expected: Float64) -> float:
    assert up is not None
    return float(np.degrees(np.arccos(min(up @ expected, 1.0))))


@pytest.mark.parametrize("seed", range(4))
def test_gravity_sensor_is_used_without_level_surfaces(seed: int) -> None:
    """Only a slanted table is visible. The rotation of the world frame is arbitrary."""
    turned = Rotation.random(random_state=seed).as_matrix()
    vertices, triangles = rectangle(np.zeros(3), 2 * X, 2 * (np.cos(0.35) * Y + np.sin(0.35) * Z))
    vertices = (vertices @ turned.T).astype(np.float32)
    assert degrees(held(turned).estimate(vertices, triangles).up, turned @ Z) == pytest.approx(
        np.degrees(0.35), abs=0.1
    )
    assert degrees(sensing(turned).estimate(vertices, triangles).up, turned @ Z) < 1e-3
    assert degrees(sensing(turned).estimate(vertices[:0], triangles[:0]).up, turned @ Z) < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_gravity_sensor_noise_and_bias_average_out(seed: int) -> None:
    """The bias is a rotation about the x axis of the camera. Its direction in the world changes as the camera turns."""
    noise, bias = np.radians(3), np.radians(2)
    assert degrees(sensing(np.eye(3), noise, seed=seed).sensed(), Z) < 3 * np.degrees(noise) / np.sqrt(40)
    assert degrees(sensing(np.eye(3), 0, bias, seed=seed).sensed(), Z) < 1e-3


def test_gravity_contradictory_sensor_is_ignored(caplog: pytest.LogCaptureFixture) -> None:
    """The measurements contradict each other, because the axes of sensor and camera differ."""
    vertices, triangles = room()
    gravity = held(np.eye(3))
    for k in range(8):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", k).as_matrix()
        gravity.add_frame(T, np.array([np.sin(0.4), 0, np.cos(0.4)]))
    assert gravity.sensed() is None
    assert degrees(gravity.estimate(vertices, triangles).up, Z) < 0.1
    assert caplog.text.count("sensor gravity: expected one direction in the world frame, got several") == 1


def test_gravity_saved_state_round_trip_is_exact() -> None:
    saved = sensing(np.eye(3)).saved()
    read = GravityEstimator.of(MapHeader(json.loads(json.dumps(saved))))
    assert read.saved() == saved


def test_gravity_saved_state_with_invalid_values_raises() -> None:
    saved = sensing(np.eye(3)).saved()
    for wrong in ([], [1, 2], ["a", 0, 0], [float("nan"), 0, 0], [True, None, 0], [1e200, 0, 0]):
        for key in ("camera_up", "sensed_up"):
            with pytest.raises(DataError, match=key):
                GravityEstimator.of(MapHeader(saved | {key: wrong}))
    with pytest.raises(DataError, match=r"sensed_up: expected a length of at most 3 \(a sum of unit vectors\), got 40"):
        GravityEstimator.of(MapHeader(saved | {"sensed_frames": 3}))
    with pytest.raises(DataError, match=r"sensed_frames: expected an integer in \[.*, .*\]"):
        GravityEstimator.of(MapHeader(saved | {"sensed_frames": -1}))


@pytest.mark.parametrize("seed", range(5))
def test_upright_box_recovers_rotated_box(seed: int) -> None:
    chosen = np.random.default_rng(seed)
    size, center, turn = np.sort(chosen.uniform(0.2, 2, 3)), chosen.normal(size=3), chosen.uniform(0, np.pi)
    world = Rotation.random(random_state=seed)
    standing = world * Rotation.from_euler("z", turn)
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    inside = chosen.uniform(-0.5, 0.5, (200, 3)) * size
    points = (standing.apply(np.concatenate([corners, inside])) + center).astype(np.float32)
    up = world.apply(Z)
    box = upright_box(points, up)
    np.testing.assert_allclose(box.center, center, atol=1e-4)
    np.testing.assert_allclose(np.sort(box.extent[:2]), np.sort(size[:2]), atol=1e-4)
    assert box.extent[2] == pytest.approx(size[2], abs=1e-4)
    np.testing.assert_allclose(box.rotation[:, 2], up, atol=1e-9)
    np.testing.assert_allclose(box.rotation @ box.rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(box.rotation) == pytest.approx(1)
    within = np.abs((points - box.center) @ box.rotation)
    assert (within <= box.extent / 2 + 1e-4).all()


def test_upright_box_of_degenerate_points_is_valid() -> None:
    for points in (np.zeros((1, 3)), np.array([[0, 0, 0], [1, 0, 0]]), np.array([[0, 0, 0], [0, 0, 2]])):
        box = box_around(points.astype(np.float32), Z)
        assert np.isfinite(box.center).all()
        assert np.linalg.det(box.rotation) == pytest.approx(1)
        assert box.extent.max() == pytest.approx(np.ptp(points, axis=0).max(), abs=1e-5)
