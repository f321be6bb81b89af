"""Tests for masks that are computed from boxes and depth."""

import numpy as np
import pytest
from scipy import ndimage

from framework.data import Camera
from framework.detection.masks import masks_from_boxes, masks_from_boxes_kernels
from framework.detection.masks.masks_from_boxes import masks_in_boxes
from framework.sensors.noise_models import SensorKind

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
SIGNIFICANCE, SLANT, READINGS = 0.4, 85.0, 0.1
NOISE = SensorKind.KINECT_V1.noise
BOX = np.array([[39.5, 19.5, 99.5, 79.5]], np.float32)  # pixels u = 40 to 99, v = 20 to 79
V, U = np.indices((120, 160))


def wall(distance=3.0):
    return np.full((120, 160), distance, np.float32)


def mask_of(depth, box=BOX, significance=SIGNIFICANCE, slant=SLANT, readings=READINGS, camera=CAMERA):
    masks, found = masks_in_boxes(box, depth, camera, significance, slant, readings)
    assert found.tolist() == [True] * len(box)
    return masks[0]


def disk(radius, u=69.5, v=49.5):
    return (U - u) ** 2 + (V - v) ** 2 < radius**2


def test_masks_in_boxes_foreground_object_is_exact():
    depth = np.where(disk(28), np.float32(1.5), wall())
    np.testing.assert_array_equal(mask_of(depth), disk(28))


def test_masks_in_boxes_mask_is_clipped_to_box():
    inside = (U >= 40) & (U <= 99) & (V >= 20) & (V <= 79)
    np.testing.assert_array_equal(mask_of(wall()), inside)
    outside_image = np.array([[-30.5, -10.5, 19.5, 9.5]], np.float32)
    np.testing.assert_array_equal(mask_of(wall(), outside_image), (U < 20) & (V < 10))


def test_masks_in_boxes_thin_occluder_is_excluded():
    depth = np.where(disk(28), np.float32(1.5), wall())
    depth[:, 66:70] = 0.8  # a pole in front of the disk
    mask = mask_of(depth)
    assert not mask[:, 66:70].any()
    halves = disk(28) & ((U < 66) | (U > 69))
    assert not (mask & ~halves).any()
    assert mask.sum() > 0.45 * halves.sum(), "expected most of one of the two halves"
    # with significance 0, the pole is the foreground
    assert mask_of(depth, significance=0.0)[50, 66:70].all()


def test_masks_in_boxes_without_significant_mode_use_largest():
    depth = np.choose((U // 10) % 3, [1.0, 2.0, 4.0]).astype(np.float32)
    mask = mask_of(depth, significance=0.99)
    assert mask.any()
    assert len(np.unique(depth[mask])) == 1


def test_masks_in_boxes_equal_depths_select_central_object():
    depth = np.where(disk(14) | disk(8, u=95), np.float32(1.5), wall())
    np.testing.assert_array_equal(mask_of(depth), disk(14))


@pytest.mark.parametrize(("slant", "whole"), [(75.0, True), (84.0, False)])
def test_masks_in_boxes_slanted_plane_is_one_mask_below_limit(slant, whole):
    """The depth of the plane is 3 m + tan(slant) x. Planes with a slant above 80 degrees are split."""
    direction = (U - 69.5) / CAMERA.fx
    depth = np.clip(3 / (1 - np.tan(np.radians(slant)) * direction), 0, None).astype(np.float32)
    narrow = np.array([[63.5, 19.5, 75.5, 79.5]], np.float32)
    mask = mask_of(depth, narrow, significance=0.0, slant=80.0)
    assert (mask.sum() == 12 * 60) == whole


def test_region_growing_joins_pixels_below_depth_step_limit():
    for z in (0.5, 1.0, 4.0):
        limit = masks_from_boxes_kernels._largest_step(z, np.tan(np.radians(80)) / 150, NOISE)
        assert limit == pytest.approx(z * np.tan(np.radians(80)) / 150 + 3 * (0.0012 + 0.0019 * (z - 0.4) ** 2))
        for step, joined in ((0.95 * limit, True), (1.05 * limit, False)):
            depth = np.where(U < 70, np.float32(z), np.float32(z + step))
            # all depths are in range, so only the depth step matters
            mask = np.zeros((120, 160), np.bool_)
            ones = np.ones(160)
            step_limit = np.tan(np.radians(80)) / 150
            masks_from_boxes_kernels._grow(depth, ones, np.ones(120), 0.1, 10.0, step_limit, NOISE, mask)
            assert mask.all() == joined


def test_region_growing_and_hole_closing_match_labeling():
    rng = np.random.default_rng(3)
    for _ in range(20):
        depth = np.where(rng.random((30, 40)) < 0.62, 1.0, rng.choice([0.0, 2.0], (30, 40))).astype(np.float32)
        weight_x, weight_y = rng.random(40), rng.random(30)
        labels, _ = ndimage.label(depth == 1)
        weights = ndimage.sum(np.outer(weight_y, weight_x), labels, np.arange(1, labels.max() + 1))
        expected = labels == 1 + weights.argmax()
        # holes are 4-connected background regions that do not touch the border
        holes, n = ndimage.label(~expected)
        for k in range(1, n + 1):
            hole = holes == k
            touches = hole[0].any() or hole[-1].any() or hole[:, 0].any() or hole[:, -1].any()
            if not touches and (
                not depth[hole].any() or hole.sum() <= masks_from_boxes.LARGEST_CLOSED_HOLE * hole.size
            ):
                expected = expected | hole
        mask = np.zeros((30, 40), np.bool_)
        masks_from_boxes_kernels._grow(depth, weight_x, weight_y, 0.5, 1.5, 0.01, NOISE, mask)
        masks_from_boxes._close_holes(mask, depth > 0)
        np.testing.assert_array_equal(mask, expected)


def test_masks_in_boxes_small_or_unmeasured_holes_are_closed():
    solid = disk(28)
    depth = np.where(solid, np.float32(1.5), wall())
    depth[disk(15)] = 0
    np.testing.assert_array_equal(mask_of(depth), solid)
    depth[disk(15)] = 3.0
    np.testing.assert_array_equal(mask_of(depth), solid & ~disk(15))
    depth[disk(15)] = 1.5
    depth[disk(3)] = 3.0
    np.testing.assert_array_equal(mask_of(depth), solid)


def test_masks_in_boxes_without_depth_reports_no_mask():
    boxes = np.concatenate([BOX, BOX + 60, [[500, 500, 600, 600]], [[50, 50, 40, 40]]]).astype(np.float32)
    depth = np.where(U < 70, np.float32(0), wall())
    depth[V < 70] = 0
    masks, found = masks_in_boxes(boxes, depth, CAMERA, SIGNIFICANCE, SLANT, READINGS)
    assert found.tolist() == [
        False,
        True,
        False,
        False,
    ]  # pixels with depth: 300 of 3600, 2400 of 2400 in the image, 0, 0
    assert masks.any(axis=(1, 2)).tolist() == found.tolist()
    masks, found = masks_in_boxes(boxes, depth, CAMERA, SIGNIFICANCE, SLANT, 0.08)
    assert found.tolist() == [True, True, False, False]


def test_masks_in_boxes_without_boxes_are_empty():
    masks, found = masks_in_boxes(np.zeros((0, 4), np.float32), wall(), CAMERA, SIGNIFICANCE, SLANT, READINGS)
    assert (masks.shape, found.shape) == ((0, 120, 160), (0,))


def test_masks_in_boxes_noisy_surface_is_not_split():
    rng = np.random.default_rng(4)
    depth = np.where(disk(28), 2.0, 4.0)
    depth = (depth + rng.normal(0, 0.0012 + 0.0019 * (depth - 0.4) ** 2)).astype(np.float32)
    mask = mask_of(depth)
    assert (mask & disk(28)).sum() / (mask | disk(28)).sum() > 0.99


@pytest.mark.parametrize(("sensor", "whole"), [(SensorKind.KINECT_V1, False), (SensorKind.PHONE_LIDAR, True)])
def test_masks_in_boxes_step_limit_depends_on_sensor_noise(sensor, whole):
    depth = np.where(U < 70, np.float32(1.5), np.float32(1.53))
    masks, _ = masks_in_boxes(BOX, depth, CAMERA, SIGNIFICANCE, 45.0, READINGS, sensor)
    assert (masks.sum() == 60 * 60) == whole
