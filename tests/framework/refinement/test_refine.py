"""Tests for `refine`, with all refiners."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import DataError
from framework.interfaces import ClusterRefiner
from framework.refinement.lifting import lift
from framework.refinement.refine import keep_points, refine
from framework.refinement.refine_kernels import PART

CAMERA = Camera(5, 4, 4.0, 4.0, 2.0, 1.5)
FRAME = Frame(0, 0.0, np.zeros((4, 5, 3), np.uint8), np.ones((4, 5), np.float32), CAMERA)


@dataclass
class Moving(ClusterRefiner):
    """Refiner that moves the last point to a given pixel."""

    pixel: tuple[int, int]

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        pixels = clusters.pixels.copy()
        pixels[-1] = self.pixel
        return replace(clusters, pixels=pixels)


def whole_image(exact: bool = False) -> PointClusters:
    one = np.ones((1, 1), np.float32)
    masks = np.ones((1, 4, 5), np.bool_)
    return lift(Detections(masks, np.zeros((1, 4), np.float32), one[0], one, ("wall",), exact), FRAME, Pose(np.eye(4)))


def test_refine_exact_masks_are_unchanged() -> None:
    exact = whole_image(exact=True)
    assert refine(Moving((0, 0)), exact, FRAME) is exact
    assert refine(Moving((0, 0)), whole_image(), FRAME).pixels[-1].tolist() == [0, 0]


@pytest.mark.parametrize("pixel", [(-1, 0), (0, -1), (5, 0), (0, 4)])
def test_refine_pixel_outside_image_raises(pixel: tuple[int, int]) -> None:
    with pytest.raises(
        DataError, match=r"clusters: expected pixels in the image of 5x4 px, got u in \[.*, .*\], v in \[.*, .*\]"
    ) as caught:
        refine(Moving(pixel), whole_image(), FRAME)
    assert "\n" not in str(caught.value)


def test_refine_accepts_empty_result() -> None:
    @dataclass
    class Dropping(ClusterRefiner):
        def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
            nothing = np.zeros((0, 3), np.float32)
            return replace(clusters, points_world=nothing, pixels=clusters.pixels[:0], cluster=clusters.cluster[:0])

    assert len(refine(Dropping(), whole_image(), FRAME).pixels) == 0


@pytest.mark.parametrize("points", [0, 1, PART - 1, PART, PART + 1, 3 * PART + 100])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_keep_points_equals_boolean_indexing(points, share):
    rng = np.random.default_rng(0)
    ones = np.ones(3, np.float32)
    clusters = PointClusters(
        rng.normal(size=(points, 3)).astype(np.float32),
        rng.integers(0, 640, (points, 2)).astype(np.int32),
        rng.integers(-1, 3, points).astype(np.int32),
        ones[:, None],
        ones,
        ("thing",),
    )
    kept = rng.random(points) < share
    left = keep_points(clusters, kept)
    np.testing.assert_array_equal(left.points_world, clusters.points_world[kept])
    np.testing.assert_array_equal(left.pixels, clusters.pixels[kept])
    np.testing.assert_array_equal(left.cluster, clusters.cluster[kept])
    assert left.scores is clusters.scores
    assert left.class_probabilities is clusters.class_probabilities
