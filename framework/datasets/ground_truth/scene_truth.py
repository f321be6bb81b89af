"""Fusion of exact depth, instance images and true poses into the ground-truth surface."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float32, Float64, Int32, SceneTruth
from framework.datasets.ground_truth.scene_truth_kernels import KEY_OFFSET, Slots, move_slots, vote
from framework.errors import DataError

INITIAL_CAPACITY = 1 << 16  # slots; a power of two, doubled before more than half are taken


@dataclass(frozen=True)
class LabeledDepth:
    """One view of the ground truth."""

    depth: Float32  # (H, W) m along z, 0 = no reading
    instance_ids: Int32  # (H, W), 0 = no instance
    camera: Camera
    T_world_camera: Float64  # (4, 4)


def check_truth_voxel(size: float) -> None:
    """Raise ConfigError for an implausible spacing of true points."""
    require(1e-3 <= size <= 1, "dataset.ground_truth_spacing", size, "in [0.001, 1] m")


def fuse_scene_truth(
    views: Iterable[LabeledDepth], class_names: Mapping[int, str | None], ground_truth_spacing: float = 0.02
) -> SceneTruth:
    """Return one labeled point for each voxel of `ground_truth_spacing` meters that contains a view's pixels.

    Every pixel with depth votes for (its voxel, its instance id). A voxel gets the id with most votes, the smaller of
    two equal ones, and the mean of the points that voted for it. Points are in the order in which their voxels were
    first seen. Memory depends on the surface, not on the number of views.
    """
    table = _VoteTable()
    for view in views:
        table.add(view, ground_truth_spacing)
    points, ids = table.elect()
    return SceneTruth(points_world=points, instance_ids=ids, class_names=dict(class_names))


class _VoteTable:
    """Votes for (voxel, instance id)."""

    def __init__(self) -> None:
        self.taken = 0
        self.slots = Slots.empty(INITIAL_CAPACITY)

    def add(self, view: LabeledDepth, ground_truth_spacing: float) -> None:
        while 2 * (self.taken + view.depth.size) > len(self.slots.keys):  # at worst, each pixel needs a new slot
            larger = Slots.empty(2 * len(self.slots.keys))
            move_slots(self.slots, larger)
            self.slots = larger
        camera = view.camera
        self.taken = vote(
            np.ascontiguousarray(view.depth),
            np.ascontiguousarray(view.instance_ids),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            np.ascontiguousarray(view.T_world_camera),
            1.0 / ground_truth_spacing,
            self.slots,
            self.taken,
        )
        if self.taken < 0:
            farthest = KEY_OFFSET * ground_truth_spacing
            raise DataError(f"ground truth: a point lies more than {farthest:.0f} m from the origin")

    def elect(self) -> tuple[Float32, Int32]:
        """Return each voxel's mean point (V, 3) and majority id (V,), in the order of first sight."""
        keys, ids, votes, sums, first = self.slots
        taken = np.flatnonzero(votes)
        best_first = taken[np.lexsort((ids[taken], -votes[taken], keys[taken]))]
        voxel = keys[best_first]
        is_best = np.ones(len(voxel), np.bool_)
        is_best[1:] = voxel[1:] != voxel[:-1]
        winners = best_first[is_best]
        voxel_of_entry = np.cumsum(is_best) - 1
        seen = np.full(len(winners), np.iinfo(np.int64).max)
        np.minimum.at(seen, voxel_of_entry, first[best_first])
        winners = winners[np.argsort(seen, kind="stable")]
        points = sums[winners] / votes[winners, None]
        return points.astype(np.float32), ids[winners]
