"""Kernels of scene_truth.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64, Int32, Int64

KEY_BITS = 21  # bits per voxel coordinate in a packed key; 2^20 voxels of 2 cm in each direction are 20 km
KEY_OFFSET = 1 << (KEY_BITS - 1)  # added to voxel coordinates, which makes them positive


class Slots(NamedTuple):
    """A hash table with linear probing and S slots, with one slot for each pair of voxel and instance id.

    S is a power of two. A slot without votes is empty.
    """

    keys: Int64  # (S,) packed voxel coordinates
    ids: Int32  # (S,) instance id
    votes: Int64  # (S,) number of points
    sums: Float64  # (S, 3) m, sum of the points
    first: Int64  # (S,) position in the order of first observation

    @classmethod
    def empty(cls, capacity: int) -> Slots:
        kinds = (np.int64, np.int32, np.int64, (np.float64, 3), np.int64)
        return cls(*(np.zeros(capacity, kind) for kind in kinds))


@njit(cache=True, nogil=True)
def _slot(slots: Slots, key: np.int64, instance: np.int32) -> np.int64:
    """Return the index of the slot of a voxel and an instance, or of the empty slot to use."""
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
def vote(
    depth: Float32, instance_ids: Int32, intrinsics: Float64, T: Float64, scale: float, slots: Slots, taken: int
) -> int:
    """Add the pixels of a depth image to the hash table.

    Args:
        depth: The depth (H, W), m, 0 = no reading.
        instance_ids: The instance ids (H, W).
        intrinsics: The camera intrinsics (fx, fy, cx, cy), px.
        T: The pose T_world_camera (4, 4).
        scale: The number of voxels per meter.
        slots: The hash table.
        taken: The number of occupied slots before the call.

    Returns:
        The number of occupied slots, or -1 if a point is too far from the origin.
    """
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
def move_slots(slots: Slots, to: Slots) -> None:
    """Copy all entries of a hash table into a larger table."""
    for s in range(len(slots.keys)):
        if slots.votes[s] > 0:
            slot = _slot(to, slots.keys[s], slots.ids[s])
            to.keys[slot], to.ids[slot] = slots.keys[s], slots.ids[s]
            to.votes[slot], to.sums[slot], to.first[slot] = slots.votes[s], slots.sums[s], slots.first[s]
