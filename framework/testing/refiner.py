"""The contract of a refiner."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from framework.data import Detections, Float64, Frame, Pose
from framework.interfaces import ClusterRefiner
from framework.refinement.lifting import lift
from framework.testing.assertions import same
from framework.testing.corner_room import CAMERA, CLASSES, bleeding_clusters, frame_at, pose_at, spheres_in


class RefinerContract:
    """What every refiner keeps."""

    stage = "refiner"

    def plugin(self) -> ClusterRefiner:
        raise NotImplementedError("the refiner that is tested")

    def test_refiner_invents_no_points(self) -> None:
        frame = frame_at(1)
        clusters = bleeding_clusters(frame)
        before = {name: np.array(value) for name, value in vars(clusters).items()}
        refined = self.plugin().refine(clusters, frame)
        u, v = refined.pixels.T
        np.testing.assert_allclose(refined.points_world, readings(frame)[v, u], atol=1e-4)
        of_one = np.c_[refined.pixels, refined.cluster]
        assert len(np.unique(of_one, axis=0)) == len(of_one), "a pixel twice in one cluster"
        assert refined.classes == clusters.classes
        assert all(np.array_equal(before[name], value) for name, value in vars(clusters).items()), "input was changed"
        assert (refined.cluster >= 0).any(), "nothing is left of two whole spheres"

    def test_refiner_is_repeatable(self) -> None:
        refiner = self.plugin()
        one, other = frame_at(1), frame_at(2)
        first = refiner.refine(bleeding_clusters(one), one)
        refiner.refine(bleeding_clusters(other), other)
        assert same(first, refiner.refine(bleeding_clusters(one), one))

    def test_refiner_does_not_depend_on_the_number_of_threads(self) -> None:
        refiner = self.plugin()
        frame = frame_at(1)
        clusters = bleeding_clusters(frame)
        usual = numba.get_num_threads()
        made = []
        try:
            for threads in (1, numba.config.NUMBA_NUM_THREADS):
                numba.set_num_threads(threads)
                made.append(refiner.refine(clusters, frame))
        finally:
            numba.set_num_threads(usual)
        assert same(*made)

    def test_refiner_takes_no_clusters(self) -> None:
        frame = frame_at(0)
        nothing = lift(Detections.none(CAMERA.shape, CLASSES), frame, Pose(pose_at(0)))
        refined = self.plugin().refine(nothing, frame)
        assert (len(refined), len(refined.points_world), refined.classes) == (0, 0, CLASSES)

    def test_refiner_takes_empty_and_tiny_clusters(self) -> None:
        frame = frame_at(0)
        exact = spheres_in(frame)
        masks = np.zeros_like(exact.masks)
        masks[1, 40, 40] = True
        refined = self.plugin().refine(lift(replace(exact, masks=masks), frame, Pose(pose_at(0))), frame)
        assert len(refined.points_world) <= 1


def readings(frame: Frame) -> Float64:
    """(H, W, 3) where each pixel's reading lies in the world, NaN without one."""
    whole = replace(spheres_in(frame), masks=np.ones((2, *CAMERA.shape), np.bool_))
    lifted = lift(whole, frame, Pose(pose_at(frame.index)))
    points = np.full((*CAMERA.shape, 3), np.nan)
    points[lifted.pixels[:, 1], lifted.pixels[:, 0]] = lifted.points_world
    return points
