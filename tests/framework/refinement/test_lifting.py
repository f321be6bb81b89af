"""Tests for lifting masks to point clusters."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import MAX_COVERAGE, Detections, Frame, Pose
from framework.errors import DataError
from framework.geometry import inverse, project, transform
from framework.refinement.lifting import fitting_masks, lift
from tests.support.scenes.corner_room import CornerRoom, pose_at


def test_lift_back_projects_depth_to_world_points(room: CornerRoom) -> None:
    frame = room[3]
    assert frame.truth is not None
    # the second mask covers the first mask
    masks = np.stack([frame.truth.instance_ids == 1, frame.truth.instance_ids > 0])
    half = np.full((2, 2), 0.5, np.float32)
    detections = Detections(masks, np.zeros((2, 4), np.float32), np.ones(2, np.float32), half, ("a", "b"))
    clusters = lift(detections, frame, Pose(pose_at(3)))
    assert np.bincount(clusters.cluster).tolist() == masks.sum(axis=(1, 2)).tolist()
    for (u, v), point in zip(clusters.pixels[::97], clusters.points_world[::97], strict=True):
        camera_point = transform(inverse(pose_at(3)), point.astype(np.float64))
        assert camera_point[2] == pytest.approx(frame.depth[v, u], abs=1e-5)
        np.testing.assert_allclose(project(frame.camera, camera_point), [u, v], atol=1e-3)
    spheres = np.linalg.norm(clusters.points_world[clusters.cluster == 0] - [-0.5, 0.7, 2.2], axis=1)
    np.testing.assert_allclose(spheres, 0.35, atol=1e-5)


def test_lift_skips_pixels_without_depth(room: CornerRoom) -> None:
    frame = room[0]
    blind = Frame(0, 0.0, frame.color, np.zeros_like(frame.depth), frame.camera)
    detections = Detections(
        np.ones((1, *frame.camera.shape), np.bool_),
        np.zeros((1, 4), np.float32),
        np.ones(1, np.float32),
        np.ones((1, 1), np.float32),
        ("a",),
    )
    clusters = lift(detections, blind, Pose(np.eye(4)))
    assert (len(clusters), len(clusters.points_world)) == (1, 0)
    assert len(lift(Detections.none(frame.camera.shape, ("a",)), frame, Pose(np.eye(4)))) == 0


def test_lift_mask_size_mismatch_raises(room: CornerRoom) -> None:
    frame, shape = room[0], (1, 1)  # NumPy could broadcast this shape
    masks = np.ones((1, *shape), np.bool_)
    one = np.ones((1, 1), np.float32)
    with pytest.raises(DataError, match=r"frame 0: expected masks of shape \(72, 96\), got \(1, 1\)"):
        lift(Detections(masks, np.zeros((1, 4), np.float32), one[0], one, ("a",)), frame, Pose(np.eye(4)))


def test_lift_reads_masks_at_color_pixels(room: CornerRoom) -> None:
    """The color pixels are shifted by 5 px, and -1 is outside of the color image."""
    frame = room[3]
    height, width = frame.camera.shape
    masks = np.zeros((2, height, width), np.bool_)
    masks[0, 20:30, 40:50] = True
    masks[1, :, :10] = True
    half = np.full((2, 2), 0.5, np.float32)
    detections = Detections(masks, np.zeros((2, 4), np.float32), np.ones(2, np.float32), half, ("a", "b"))
    color_pixels = np.full((height, width), -1, np.int32)
    color_pixels[:, 5:] = np.arange(height * width).reshape(height, width)[:, :-5]
    clusters = lift(detections, frame, Pose(pose_at(3)), color_pixels)
    expected = np.zeros_like(masks)
    expected[:, :, 5:] = masks[:, :, :-5]
    expected &= frame.depth > 0
    found = np.zeros_like(masks)
    found[clusters.cluster, clusters.pixels[:, 1], clusters.pixels[:, 0]] = True
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("counts", "scores", "expected"),
    [
        ([4, 6], [0.1, 0.2], [True, True]),
        ([4, 7], [0.1, 0.2], [False, True]),
        ([9, 7, 3, 1], [0.9, 0.8, 0.7, 0.6], [True, False, False, True]),  # a smaller mask with a lower score fits
        ([10, 10], [0.5, 0.5], [True, False]),
        ([11, 0], [0.9, 0.1], [False, True]),
        ([], [], []),
    ],
)
def test_fitting_masks_prefers_high_scores(counts: list[int], scores: list[float], expected: list[bool]) -> None:
    fits = fitting_masks(np.array(counts, np.int64), np.array(scores, np.float32), 10)
    assert fits.tolist() == expected


def test_lift_beyond_limit_empties_clusters_of_low_scores(room: CornerRoom) -> None:
    """Each mask covers the image, and the last mask has a single row."""
    frame, n = room[0], 2 * MAX_COVERAGE
    masks = np.ones((n, *frame.depth.shape), np.bool_)
    masks[-1, 1:] = False
    scores = np.linspace(0.9, 0.1, n, dtype=np.float32)
    detections = Detections(masks, np.zeros((n, 4), np.float32), scores, np.ones((n, 1), np.float32), ("a",))
    lifted = lift(detections, frame, Pose(pose_at(0)))
    counts = np.bincount(lifted.cluster, minlength=n)
    readings = np.count_nonzero(frame.depth)
    fitting = MAX_COVERAGE * frame.depth.size // readings
    assert counts[:fitting].tolist() == [readings] * fitting
    assert not counts[fitting:-1].any()
    assert len(lifted) == n
    assert lifted.omitted == np.count_nonzero(counts == 0)
    single = Detections(masks[:1], detections.boxes[:1], scores[:1], np.ones((1, 1), np.float32), ("a",))
    whole = lift(single, frame, Pose(pose_at(0)))
    np.testing.assert_array_equal(lifted.points_world[lifted.cluster == 0], whole.points_world)
    assert whole.omitted == 0
