"""Kernels of pyramid.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit

DEPTH_GAP = 0.05  # minimum depth difference between surfaces, fraction of the depth
MIN_MAPPED = np.float32(2.0)  # minimum number of mapped pixels among four for a mean intensity


@njit(cache=True, nogil=True)
def find_distinct(bits, table, found):
    """Write the distinct positive values to `found` (N,), and return their number.

    Args:
        bits: The values (N,).
        table: A hash table filled with zeros. Its size is a power of two and more than twice N.
        found: The output (N,).
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
    """Halve the resolution of an RGB-D image.

    Depth is averaged only over the pixels on the nearest surface.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        intensity: The intensity image (H, W).
        half_depth: The output (h, w), m.
        half_intensity: The output (h, w).
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
    """Compute the surface normal at each pixel from the depth of its four neighbors.

    A normal is 0 unless all neighbors have a reading on the same surface.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        intrinsics: The intrinsics fx, fy, cx, cy, px.
        normals: The output (3, H, W), unit normals in the camera frame.
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
        for u in range(1, width - 1):  # without branches, so that the compiler vectorizes the loop
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
    """Halve the resolution of an intensity image with holes, -1 = not mapped.

    Only mapped pixels are averaged, because a new map has many holes of one pixel.
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
