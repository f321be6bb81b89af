"""Fusion of labeled depth images into a ground-truth point cloud."""

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
    """A depth image with ground-truth instances and pose."""

    depth: Float32  # (H, W) m along z, 0 = no reading
    instance_ids: Int32  # (H, W), 0 = no instance
    camera: Camera
    T_world_camera: Float64  # (4, 4)


def check_truth_voxel(size: float) -> None:
    """Raise ConfigError if the spacing of ground-truth points is not in [0.001, 1] m."""
    require(1e-3 <= size <= 1, "dataset.ground_truth_spacing", size, "a value in [0.001, 1] m")


def fuse_scene_truth(
    views: Iterable[LabeledDepth], class_names: Mapping[int, str | None], ground_truth_spacing: float = 0.02
) -> SceneTruth:
    """Fuse labeled depth images into a point cloud with one labeled point per voxel.

    Each pixel votes for its instance id in its voxel. The id with the most votes is selected; in a tie, the smaller id.
    The point of a voxel is the mean of the points with the selected id. The points are in the order of the first
    observation of their voxels.

    Args:
        views: The labeled depth images.
        class_names: The class of each instance id.
        ground_truth_spacing: The side length of the voxels, m.

    Raises:
        DataError: A point is too far from the world origin.
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
    """Return the point (V, 3), m, and the instance id (V,) of each voxel."""
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
