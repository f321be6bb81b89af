"""Fuses exact depth, instance images and true poses into the labelled surface that a map is evaluated against."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64, Int32, Int64, SceneTruth
from framework.errors import ConfigError, DataError

KEY_BITS = 21  # of a voxel coordinate in a packed key: 2^20 voxels of 2 cm to each side are 20 km
KEY_OFFSET = 1 << (KEY_BITS - 1)
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


class _Slots(NamedTuple):
    """A hash table with linear probing, (S,) each. A slot without votes is empty."""

    keys: Int64  # packed voxel
    ids: Int32
    votes: Int64
    sums: Float64  # (S, 3) of the points' coordinates, m
    first: Int64  # order of first sight

    @classmethod
    def empty(cls, capacity: int) -> _Slots:
        kinds = (np.int64, np.int32, np.int64, (np.float64, 3), np.int64)
        return cls(*(np.zeros(capacity, kind) for kind in kinds))


class _VoteTable:
    """Votes for (voxel, instance id)."""

    def __init__(self) -> None:
        self.taken = 0
        self.slots = _Slots.empty(INITIAL_CAPACITY)

    def add(self, view: LabeledDepth, ground_truth_spacing: float) -> None:
        pixels = view.depth.size
        while 2 * (self.taken + pixels) > len(self.slots.keys):  # a view can at worst bring one new slot a pixel
            larger = _Slots.empty(2 * len(self.slots.keys))
            _move(self.slots, larger)
            self.slots = larger
        camera = view.camera
        self.taken = _vote(
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


@njit(cache=True, nogil=True)
def _slot(slots: _Slots, key: np.int64, instance: np.int32) -> np.int64:
    """The slot that holds (key, instance), or the empty one where it belongs."""
    keys, ids, votes, _, _ = slots
    mask = len(keys) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(instance) * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    slot = np.int64(mixed >> np.uint64(20)) & np.int64(mask)
    while votes[slot] > 0 and (keys[slot] != key or ids[slot] != instance):
        slot = (slot + np.int64(1)) & np.int64(mask)
    return slot


@njit(cache=True, nogil=True)
def _vote(
    depth: Float32, instance_ids: Int32, intrinsics: Float64, T: Float64, scale: float, slots: _Slots, taken: int
) -> int:
    """Adds one view's pixels; returns the number of slots taken, -1 when a point is too far away."""
    keys, ids, votes, sums, first = slots
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    height, width = depth.shape
    for v in range(height):
        y_ray = (v - cy) / fy
        for u in range(width):
            z = np.float64(depth[v, u])
            if z <= 0.0:
                continue
            x, y = (u - cx) / fx * z, y_ray * z
            X = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            Y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            i = np.int64(np.floor(X * scale)) + KEY_OFFSET
            j = np.int64(np.floor(Y * scale)) + KEY_OFFSET
            k = np.int64(np.floor(Z * scale)) + KEY_OFFSET
            if (i | j | k) < 0 or (i | j | k) >= 2 * KEY_OFFSET:
                return -1
            key = (i << (2 * KEY_BITS)) | (j << KEY_BITS) | k
            slot = _slot(slots, key, instance_ids[v, u])
            if votes[slot] == 0:
                keys[slot] = key
                ids[slot] = instance_ids[v, u]
                first[slot] = taken
                taken += 1
            votes[slot] += 1
            sums[slot, 0] += X
            sums[slot, 1] += Y
            sums[slot, 2] += Z
    return taken


@njit(cache=True, nogil=True)
def _move(slots: _Slots, to: _Slots) -> None:
    """Puts all entries into a larger table."""
    for s in range(len(slots.keys)):
        if slots.votes[s] > 0:
            slot = _slot(to, slots.keys[s], slots.ids[s])
            to.keys[slot], to.ids[slot] = slots.keys[s], slots.ids[s]
            to.votes[slot], to.sums[slot], to.first[slot] = slots.votes[s], slots.sums[s], slots.first[s]
