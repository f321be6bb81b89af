"""Fuses exact depth, instance images and true poses into the labelled surface that a map is evaluated against."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from framework.data import Camera, Float32, Float64, Int32, SceneTruth
from framework.datasets.ground_truth.scene_truth_kernels import KEY_OFFSET, Slots, move_slots, vote
from framework.errors import ConfigError, DataError

SMALLEST_VOXEL, LARGEST_VOXEL = 1e-3, 1.0  # m
INITIAL_CAPACITY = 1 << 16  # slots; a power of two, doubled before more than half are taken


@dataclass(frozen=True)
class LabeledDepth:
    """One view of the truth."""

    depth: Float32  # (H, W) m along z, 0 = no reading
    instance_ids: Int32  # (H, W), 0 = no instance
    camera: Camera
    T_world_camera: Float64  # (4, 4)


def check_truth_voxel(size: float) -> None:
    """Raises ConfigError for a spacing of true points that no recording has."""
    if not SMALLEST_VOXEL <= size <= LARGEST_VOXEL:  # NaN is neither
        raise ConfigError(
            f"dataset.ground_truth_spacing: expected [{SMALLEST_VOXEL:g}, {LARGEST_VOXEL:g}] m, got {size}"
        )


def fuse_scene_truth(
    views: Iterable[LabeledDepth], class_names: Mapping[int, str | None], ground_truth_spacing: float = 0.02
) -> SceneTruth:
    """One labelled point for each voxel of `ground_truth_spacing` metres that a view's pixels fall into.

    Every pixel with depth votes for (its voxel, its instance id). A voxel gets the id with most votes, the smaller
    one if two have as many, and the mean of the points that voted for it. Views are taken one by one, so memory
    follows the surface and not the number of views. Points come in the order in which their voxels were first seen.
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
        pixels = view.depth.size
        while 2 * (self.taken + pixels) > len(self.slots.keys):  # a view can at worst bring one new slot a pixel
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
            raise DataError(
                f"ground truth: a point lies more than {KEY_OFFSET * ground_truth_spacing:.0f} m from the origin"
            )

    def elect(self) -> tuple[Float32, Int32]:
        """Each voxel's mean point (V, 3) and majority id (V,), in the order of first sight."""
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
