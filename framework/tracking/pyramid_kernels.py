"""Kernels of pyramid.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

DEPTH_GAP = 0.05  # minimum depth difference between surfaces, fraction of the depth; depth is not averaged across it
MIN_MAPPED = np.float32(2.0)  # minimum number of mapped pixels among four for a mean intensity


@njit(cache=True, nogil=True)
def find_distinct(bits, table, found):
    """Write the distinct positive values of `bits` (N,) to `found` (N,) and return their number.

    `table` (2^k,) is a hash table filled with zeros, more than twice as large as `bits`.
    """
    count = 0
    mask = np.uint64(table.shape[0] - 1)
    for value in bits:
        if value <= 0:
            continue
        slot = (np.uint64(value) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(32)) & mask
        while table[slot] != 0 and table[slot] != value:
            slot = (slot + np.uint64(1)) & mask
        if table[slot] == 0:
            table[slot] = value
            found[count] = value
            count += 1
    return count


@njit(cache=True, nogil=True, parallel=True)
def halve(depth, intensity, half_depth, half_intensity):
    """Set `half_intensity` and `half_depth` (h, w) to means of `intensity` and `depth` (H, W), m, over 2x2 px.

    Depth is averaged only over those of the four pixels that are on the nearest surface; 0 = no reading.
    """
    for v in prange(half_depth.shape[0]):
        for u in range(half_depth.shape[1]):
            total = np.float32(0.0)
            nearest = np.float32(np.inf)
            for b in range(2):
                for a in range(2):
                    total += intensity[2 * v + b, 2 * u + a]
                    d = depth[2 * v + b, 2 * u + a]
                    if np.float32(0.0) < d < nearest:
                        nearest = d
            half_intensity[v, u] = total * np.float32(0.25)
            farthest = nearest * np.float32(1.0 + DEPTH_GAP)
            total = np.float32(0.0)
            count = np.float32(0.0)
            for b in range(2):
                for a in range(2):
                    d = depth[2 * v + b, 2 * u + a]
                    if np.float32(0.0) < d < farthest:
                        total += d
                        count += np.float32(1.0)
            half_depth[v, u] = total / count if count > np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def compute_normals(depth, intrinsics, normals):
    """Set `normals` (3, H, W), unit length in the camera frame, from the depth, m, of the four neighbors of each pixel.

    A normal is 0 unless all neighbors have a reading on the surface of the pixel. `intrinsics`: fx, fy, cx, cy, px. The
    loop over a row has no branches, so that the compiler vectorizes it.
    """
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    inv_fx, inv_fy = one / fx, one / fy
    for v in prange(height):
        normals[0, v, 0] = normals[1, v, 0] = normals[2, v, 0] = zero
        normals[0, v, width - 1] = normals[1, v, width - 1] = normals[2, v, width - 1] = zero
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        y = (np.float32(v) - cy) * inv_fy
        for u in range(1, width - 1):
            z = depth[v, u]
            left, right, up, down = depth[v, u - 1], depth[v, u + 1], depth[above, u], depth[below, u]
            x = (np.float32(np.int32(u)) - cx) * inv_fx
            across, along = right - left, down - up
            # the tangents (x + inv_fx) * right - (x - inv_fx) * left, ... along u and along v
            ax, ay = x * across + inv_fx * (right + left), y * across
            bx, by = x * along, y * along + inv_fy * (down + up)
            nx, ny, nz = by * across - along * ay, along * ax - bx * across, bx * ay - by * ax
            apart = max(max(abs(left - z), abs(right - z)), max(abs(up - z), abs(down - z)))
            smooth = (min(min(left, right), min(up, down)) > zero) & (apart <= np.float32(DEPTH_GAP) * z)
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            scale = one / norm if smooth & (norm > zero) else zero
            normals[0, v, u], normals[1, v, u], normals[2, v, u] = nx * scale, ny * scale, nz * scale
    normals[:, 0] = zero
    normals[:, height - 1] = zero


@njit(cache=True, nogil=True, parallel=True)
def halve_mapped(intensity, half):
    """Set `half` to means of the mapped intensities of 2x2 px; -1 = fewer than MIN_MAPPED mapped pixels.

    A new map has many holes of one pixel.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    for v in prange(half.shape[0]):
        for u in range(half.shape[1]):
            total, count = zero, zero
            for b in range(2):
                for a in range(2):
                    i = intensity[2 * v + b, 2 * u + a]
                    if i >= zero:
                        total += i
                        count += one
            half[v, u] = total / count if count >= MIN_MAPPED else -one
