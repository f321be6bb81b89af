"""Fusion of depth, instance images and ground-truth poses into a ground-truth surface."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float32, Float64, Int32, SceneTruth
from framework.datasets.ground_truth.scene_truth_kernels import KEY_OFFSET, Slots, move_slots, vote
from framework.errors import DataError

INITIAL_CAPACITY = 1 << 16  # number of slots, a power of two; doubled before more than half of them are occupied


@dataclass(frozen=True)
class LabeledDepth:
    """Ground truth of one view."""

    depth: Float32  # (H, W) m along z, 0 = no reading
    instance_ids: Int32  # (H, W), 0 = no instance
    camera: Camera
    T_world_camera: Float64  # (4, 4)


def check_truth_voxel(size: float) -> None:
    """Raise ConfigError if `size`, the spacing of ground-truth points in m, is not in [0.001, 1]."""
    require(1e-3 <= size <= 1, "dataset.ground_truth_spacing", size, "a value in [0.001, 1] m")


def fuse_scene_truth(
    views: Iterable[LabeledDepth], class_names: Mapping[int, str | None], ground_truth_spacing: float = 0.02
) -> SceneTruth:
    """Return one labeled point for each occupied voxel with a side length of `ground_truth_spacing` m.

    Every pixel with depth votes for its instance id in its voxel. A voxel gets the id with the most votes; ties go to
    the smaller id. Its point is the mean of the points that voted for this id. Points are in the order of first
    observation. Memory depends on the size of the surface, not on the number of views.
    """
    slots, taken = Slots.empty(INITIAL_CAPACITY), 0
    for view in views:
        while 2 * (taken + view.depth.size) > len(slots.keys):  # at worst, each pixel needs a new slot
            larger = Slots.empty(2 * len(slots.keys))
            move_slots(slots, larger)
            slots = larger
        camera = view.camera
        taken = vote(
            np.ascontiguousarray(view.depth),
            np.ascontiguousarray(view.instance_ids),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            np.ascontiguousarray(view.T_world_camera),
            1.0 / ground_truth_spacing,
            slots,
            taken,
        )
        if taken < 0:
            farthest = KEY_OFFSET * ground_truth_spacing
            raise DataError(
                f"dataset.ground_truth_spacing: expected all points within {farthest:.0f} m of the world origin, got a "
                "point farther away; increase this spacing, or check dataset.pose_unit"
            )
    points, ids = _elect(slots)
    return SceneTruth(points_world=points, instance_ids=ids, class_names=dict(class_names))


def _elect(slots: Slots) -> tuple[Float32, Int32]:
    """Return the mean point (V, 3), m, and the majority id (V,) of each voxel, in the order of first observation."""
    keys, ids, votes, sums, first = slots
    taken = np.flatnonzero(votes)
    best_first = taken[np.lexsort((ids[taken], -votes[taken], keys[taken]))]
    voxel = keys[best_first]
    is_best = np.ones(len(voxel), np.bool_)
    is_best[1:] = voxel[1:] != voxel[:-1]
    winners = best_first[is_best]
    seen = np.minimum.reduceat(first[best_first], np.flatnonzero(is_best)) if len(winners) else winners
    winners = winners[np.argsort(seen, kind="stable")]
    points = sums[winners] / votes[winners, None]
    return points.astype(np.float32), ids[winners]
