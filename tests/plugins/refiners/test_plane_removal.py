"""Tests for refiner=plane_removal. Floors and walls are removed, and flat parts of objects are kept."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import ConfigError
from framework.geometry import exp_se3
from framework.refinement.lifting import lift
from framework.sensors.noise_models import SensorKind
from plugins.refiners.plane_removal import PlaneRemoval

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
T_WORLD_CAMERA = exp_se3(np.array([0.3, -0.2, 1.0, 0.2, -0.4, 0.1]))  # no world axis is vertical
ROOM = (-2.5, -1.5, -2.0), (2.5, 1.2, 4.0)  # m; y points down, and the floor is 1.2 m below the camera
BOX = (-0.25, 0.7, 2.9), (0.25, 1.2, 3.3)  # m, box on the floor
PITCH = 0.3  # rad, by which the camera looks down

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]


def scene(*boxes: Corners, pitch: float = PITCH, noise: float = 0.0) -> tuple[Frame, np.ndarray]:
    """Return a frame of the room with boxes, and the ids (H, W), where 0 is the room and k is the k-th box.

    The standard deviation of depth is `noise` times the squared depth, m.
    """
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    c, s = np.cos(pitch), np.sin(pitch)
    rays = rays @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]).T  # from camera axes to level axes
    depth, ids = np.full(CAMERA.shape, np.inf), np.zeros(CAMERA.shape, np.int32)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k, (low, high) in enumerate((ROOM, *boxes)):
            hits = np.sort([low / rays, high / rays], axis=0)
            enters, leaves = hits[0].max(axis=-1), hits[1].min(axis=-1)
            z = leaves if k == 0 else np.where((enters < leaves) & (enters > 0), enters, np.inf)
            ids = np.where(z < depth, k, ids)
            depth = np.minimum(z, depth)
    depth += np.random.default_rng(0).normal(0, noise, depth.shape) * depth**2
    return Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), depth.astype(np.float32), CAMERA), ids


def heights(frame: Frame, pitch: float = PITCH) -> np.ndarray:
    """Return the heights (H, W), m, above the floor."""
    v = np.arange(CAMERA.height)[:, None]
    return 1.2 - (np.cos(pitch) * (v - CAMERA.cy) / CAMERA.fy + np.sin(pitch)) * frame.depth


def lifted(frame: Frame, *masks: np.ndarray) -> PointClusters:
    n = len(masks)
    ones = np.ones(n, np.float32)
    boxes = np.zeros((n, 4), np.float32)
    return lift(Detections(np.stack(masks), boxes, ones, ones[:, None], ("thing",)), frame, Pose(T_WORLD_CAMERA))


def bleeding(mask: np.ndarray, px: int = 8) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1), np.uint8)).astype(bool)


def masks_of(clusters: PointClusters) -> np.ndarray:
    """Return the masks (N, H, W) of the remaining points of each cluster."""
    masks = np.zeros((len(clusters), *CAMERA.shape), bool)
    masks[clusters.cluster, clusters.pixels[:, 1], clusters.pixels[:, 0]] = True
    return masks


@pytest.mark.parametrize("pitch", [0.0, PITCH, 0.6])
def test_plane_removal_keeps_box_above_plane_distance(pitch):
    frame, ids = scene(BOX, pitch=pitch)
    [left] = masks_of(PlaneRemoval(plane_distance=0.02).refine(lifted(frame, bleeding(ids == 1)), frame))
    np.testing.assert_array_equal(left, (ids == 1) & (heights(frame, pitch) > 0.02))


def test_structure_mask_marks_floor_and_walls():
    frame, ids = scene(BOX)
    refined = PlaneRemoval(plane_distance=0.02).refine(lifted(frame, bleeding(ids == 1)), frame)
    assert refined.structure is not None
    np.testing.assert_array_equal(refined.structure[ids == 1], heights(frame)[ids == 1] <= 0.02)
    assert refined.structure[ids == 0].mean() > 0.99


def test_plane_removal_sensor_noise_widens_plane_distance():
    """With Kinect noise at 3 m, at least 99 % of floor and wall are removed. The box is kept above 6 cm."""
    frame, ids = scene(BOX, noise=0.002)
    bled = bleeding(ids == 1)
    [left] = masks_of(PlaneRemoval().refine(lifted(frame, bled), frame))
    assert left[bled & (ids == 0)].mean() < 0.01
    assert left[(ids == 1) & (heights(frame) > 0.06)].all()


@pytest.mark.parametrize(("sensor", "found"), [(SensorKind.KINECT_V1, False), (SensorKind.REALSENSE_D435, True)])
def test_plane_removal_limit_depends_on_sensor_noise(sensor, found):
    """The noise is that of a RealSense D435, i.e. twice the noise of a Kinect."""
    frame = replace(scene(BOX, noise=0.0038)[0], sensor=sensor)
    planes = PlaneRemoval(plane_distance=0.0).structure(frame)
    assert (planes.fractions.sum() > 0.8) == found


def test_plane_removal_limit_of_exact_sensor_allows_uneven_walls():
    frame = replace(scene(BOX, noise=0.002)[0], sensor=SensorKind.EXACT)
    assert PlaneRemoval(plane_distance=0.0).structure(frame).fractions.sum() > 0.8


def test_plane_removal_keeps_table_top():
    """The table fills the lower half of the image."""
    table = (-1.2, 0.45, 0.9), (1.2, 0.5, 2.2)
    frame, ids = scene(table, BOX)
    top = PlaneRemoval(min_area=0.1)
    for mask in (ids == 1, (ids == 1) & (np.arange(320) < 160)):  # the whole table top, or one half
        [left] = masks_of(top.refine(lifted(frame, bleeding(mask, 4)), frame))
        np.testing.assert_array_equal(left, bleeding(mask, 4) & (ids > 0))


def test_plane_removal_keeps_plane_with_most_cluster_points():
    """The table top fills the view and cannot be distinguished from a floor by its size."""
    frame, ids = scene(((-9.0, 0.5, -9.0), (9.0, 0.6, 9.0)), ((-0.1, 0.3, 0.4), (0.1, 0.5, 0.6)), pitch=0.9)
    assert (ids > 0).all()
    refined = PlaneRemoval(min_area=0.3).refine(lifted(frame, ids == 1, bleeding(ids == 2)), frame)
    top, cup = masks_of(refined)
    np.testing.assert_array_equal(top, ids == 1)
    assert cup.sum() > 0.8 * (ids == 2).sum()
    assert not cup[ids == 1].any()
    assert refined.structure is not None
    assert not refined.structure[ids == 1].any(), "expected no structure in points that an object keeps"
    half = (ids == 1) & (np.cumsum(ids == 1).reshape(ids.shape) <= 0.49 * (ids == 1).sum())
    [left] = masks_of(PlaneRemoval(min_area=0.3).refine(lifted(frame, half), frame))
    assert not left.any()
    [left] = masks_of(PlaneRemoval(min_area=0.3, max_cluster_fraction=0.4).refine(lifted(frame, half), frame))
    np.testing.assert_array_equal(left, half)


@pytest.mark.parametrize(("share", "unchanged"), [(0.4, False), (0.6, True)])
def test_plane_removal_cluster_fraction_counts_all_parts(share, unchanged):
    """The wall is visible between posts. The mask covers the top of the image, and threads process parts of it."""
    post = np.arange(320) // 32 % 2 == 1
    depth = np.where(post, 1.5, 2.0) * np.ones(CAMERA.shape)
    frame = Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), depth.astype(np.float32), CAMERA)
    mask = np.ones(CAMERA.shape, bool)
    mask[int(share * 240) :] = False
    [left] = masks_of(PlaneRemoval(plane_distance=0.02).refine(lifted(frame, mask), frame))
    np.testing.assert_array_equal(left, mask & (post | unchanged))


def test_plane_removal_keeps_screen_in_front_of_wall():
    """The screen is 8 cm in front of the wall."""
    screen = (-0.6, -0.4, 3.85), (0.6, 0.3, 3.92)
    for noise, kept, dropped in ((0.0, 1.0, 1.0), (0.001, 0.99, 0.99)):
        frame, ids = scene(screen, pitch=0.0, noise=noise)
        bled = bleeding(ids == 1)
        for refiner in (PlaneRemoval(), PlaneRemoval(min_area=0.2, min_frame_fraction=0.01)):
            [left] = masks_of(refiner.refine(lifted(frame, bled), frame))
            assert left[ids == 1].mean() >= kept
            assert 1 - left[bled & (ids == 0)].mean() >= dropped


def test_plane_removal_wall_with_small_opening_is_structure():
    """An opening of 1/20 of the width is a door. With an opening of 1/3, the wall could be the side of a cupboard."""
    for width, dropped in ((12, True), (100, False)):
        frame, _ = scene(BOX)
        depth = frame.depth.copy()
        door = (np.arange(320) < width) & (heights(frame) > 0.05)
        depth[door] = np.minimum(depth[door] * 1.5, 9.0)
        frame = replace(frame, depth=depth)
        planes = PlaneRemoval().structure(frame)
        is_wall = np.abs(np.linalg.norm(planes.m, axis=1) - 1 / 4.0) < 0.001
        assert is_wall.any() == dropped, width


def test_plane_removal_max_tilt_limits_removal_to_floor():
    """The wall is tilted by more than 60 degrees, and the floor is not."""
    frame, ids = scene(BOX)
    mask = np.ones(CAMERA.shape, bool)
    refiner = PlaneRemoval(plane_distance=0.02, max_tilt=60.0, max_cluster_fraction=1.0 - 1e-9)
    others = np.zeros_like(mask)
    others[:, :100] = True
    [left] = masks_of(refiner.refine(lifted(frame, others), frame))
    floor = np.abs(heights(frame)) <= 0.02
    np.testing.assert_array_equal(left, others & ~floor)
    [left] = masks_of(
        PlaneRemoval(plane_distance=0.02, max_cluster_fraction=1.0 - 1e-9).refine(lifted(frame, others), frame)
    )
    assert left.sum() < 0.01 * others.sum()
    assert ids.any()


def test_plane_removal_without_planes_changes_nothing():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, CAMERA.shape).astype(np.float32)
    frame = Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), depth, CAMERA)
    clusters = lifted(frame, np.ones(CAMERA.shape, bool))
    np.testing.assert_array_equal(PlaneRemoval().refine(clusters, frame).pixels, clusters.pixels)


def test_plane_removal_small_plane_is_not_structure():
    frame, ids = scene(BOX)
    clusters = lifted(frame, bleeding(ids == 1))
    for strict in (PlaneRemoval(min_area=100.0), PlaneRemoval(min_frame_fraction=0.9)):
        assert len(strict.refine(clusters, frame).pixels) == len(clusters.pixels)


def test_plane_removal_keeps_unassigned_points():
    frame, ids = scene(BOX)
    clusters = lifted(frame, bleeding(ids == 1), np.zeros_like(ids, bool))
    cluster = np.where(np.arange(len(clusters.cluster)) % 3 == 0, -1, clusters.cluster).astype(np.int32)
    refined = PlaneRemoval().refine(replace(clusters, cluster=cluster), frame)
    np.testing.assert_array_equal(refined.pixels[refined.cluster == -1], clusters.pixels[::3])
    assert 0 < (refined.cluster == 0).sum() < (cluster == 0).sum()
    assert len(refined) == 2


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"plane_distance": -0.1}, r"PlaneRemoval\.plane_distance: expected at least 0, got -0\.1"),
        ({"max_cluster_fraction": 1.5}, r"PlaneRemoval\.max_cluster_fraction: expected a value in \[0, 1\], got 1\.5"),
        ({"inverse_depth_noise": float("nan")}, "PlaneRemoval.inverse_depth_noise"),
        ({"max_tilt": 200.0}, "PlaneRemoval.max_tilt"),
    ],
)
def test_plane_removal_invalid_parameter_raises(parameters, message):
    with pytest.raises(ConfigError, match=message):
        PlaneRemoval(**parameters)
