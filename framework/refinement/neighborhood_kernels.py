"""Kernels of neighborhood.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Int32, Int64

Int16 = npt.NDArray[np.int16]

# 3-4 chamfer distance (Borgefors, 1986) in thirds of a pixel; within 8% of the Euclidean distance
CHAMFER_STEP, CHAMFER_DIAGONAL = np.int16(3), np.int16(4)
FAR = np.int16(30000)  # 10,000 px; two more steps do not overflow
PX_PER_STEP = np.float32(1) / np.float32(CHAMFER_STEP)


class Windows(NamedTuple):
    """The pixels of N clusters, and the image window of each cluster and its ring."""

    pixels: Int32  # (M, 2) (u, v), cluster by cluster
    firsts: Int64  # (N + 1,) start of each cluster in `pixels`
    bounds: Int64  # (N, 4) v0, u0, v1, u1; v1 and u1 are exclusive
    cells: Int64  # (N + 1,) start of each window in flat arrays of all windows


class ThreadSchedule(NamedTuple):
    """The clusters of each thread.

    Thread t processes order[starts[t]:starts[t + 1]].
    """

    order: Int64  # (N,)
    starts: Int64  # (threads + 1,)


@njit(cache=True, nogil=True)
def grouped(cluster: Int32, n: int) -> tuple[Int64, Int64]:
    """Return the indices (M,) of the points sorted by cluster, and the start (n + 1,) of each cluster.

    The sort is stable. Points that belong to no cluster are omitted.
    """
    firsts = np.zeros(n + 1, np.int64)
    for k in cluster:
        if k >= 0:
            firsts[k + 1] += 1
    for k in range(n):
        firsts[k + 1] += firsts[k]
    order = np.empty(firsts[n], np.int64)
    free = firsts[:n].copy()
    for i, k in enumerate(cluster):
        if k >= 0:
            order[free[k]] = i
            free[k] += 1
    return order, firsts


@njit(cache=True, nogil=True)
def share_among_threads(costs: Int64, longest_first: Int64, threads: int) -> tuple[Int64, Int64]:
    """Return the clusters (N,) sorted by thread, and the start (threads + 1,) of each thread.

    Each cluster is assigned to the thread with the least work, in the order of `longest_first`.
    """
    loads, owners, starts = np.zeros(threads, np.int64), np.empty(len(costs), np.int64), np.zeros(threads + 1, np.int64)
    for k in longest_first:
        least = 0
        for thread in range(1, threads):
            least = thread if loads[thread] < loads[least] else least
        owners[k] = least
        loads[least] += costs[k] + 1
    for k in range(len(costs)):
        starts[owners[k] + 1] += 1
    for thread in range(threads):
        starts[thread + 1] += starts[thread]
    free, order = starts.copy(), np.empty(len(costs), np.int64)
    for k in range(len(costs)):
        order[free[owners[k]]] = k
        free[owners[k]] += 1
    return order, starts


@njit(cache=True, nogil=True)
def bound(pixels: Int32, firsts: Int64, widths: Int64, height: int, width: int, bounds: Int64) -> None:
    """Compute the image window of each cluster and its ring.

    Args:
        pixels: The pixels (M, 2), u and v, of the points, cluster by cluster.
        firsts: The start (N + 1,) of each cluster.
        widths: The width (N,) of each ring, px.
        height: The height of the image, px.
        width: The width of the image, px.
        bounds: The output (N, 4): v0, u0, v1, u1, with exclusive v1 and u1.
    """
    for k in range(len(widths)):
        if firsts[k] < firsts[k + 1]:
            u0, v0, u1, v1 = bounding_box(pixels[firsts[k] : firsts[k + 1]])
            bounds[k, 0], bounds[k, 1] = max(v0 - widths[k], 0), max(u0 - widths[k], 0)
            bounds[k, 2], bounds[k, 3] = min(v1 + widths[k] + 1, height), min(u1 + widths[k] + 1, width)


@njit(cache=True, nogil=True)
def bounding_box(pixels: Int32) -> tuple[int, int, int, int]:
    """Return the minimum u and v and the maximum u and v of the pixels."""
    u0, v0 = pixels[0, 0], pixels[0, 1]
    u1, v1 = u0, v0
    for i in range(len(pixels)):
        u, v = pixels[i, 0], pixels[i, 1]
        u0 = u if u < u0 else u0
        u1 = u if u > u1 else u1
        v0 = v if v < v0 else v0
        v1 = v if v > v1 else v1
    return u0, v0, u1, v1


@njit(cache=True, nogil=True, parallel=True)
def signed_distances(
    windows: Windows, widths: Int64, depth: Float32, schedule: ThreadSchedule, steps: Int16, ring_counts: Int64,
    radii: Float32,
) -> None:  # fmt: skip
    """Compute the distance of each pixel to the border of the mask, and the size of the ring.

    The border is next to depth readings outside the mask. Pixels without a reading are not a border, because the depth
    of objects often has holes.

    Args:
        windows: The windows of the clusters.
        widths: The width (N,) of each ring, px.
        depth: The depth image (H, W), m.
        schedule: The clusters of each thread.
        steps: The output (cells,), the distance in thirds of a pixel; positive in the mask, negative in the ring,
            otherwise 0.
        ring_counts: The output (N,), the number of readings in each ring.
        radii: The output (N,), the largest distance in each mask, px.
    """
    firsts, cells = windows.firsts, windows.cells
    for thread in prange(len(schedule.starts) - 1):
        for k in schedule.order[schedule.starts[thread] : schedule.starts[thread + 1]]:
            if cells[k] < cells[k + 1]:
                ring_counts[k], radii[k] = _signed_distances_of(
                    windows.pixels[firsts[k] : firsts[k + 1]], np.int16(CHAMFER_STEP * widths[k]), windows.bounds[k],
                    depth, steps[cells[k] : cells[k + 1]],
                )  # fmt: skip


@njit(cache=True, nogil=True)
def _signed_distances_of(
    pixels: Int32, ring: np.int16, bounds: Int64, depth: Float32, steps: Int16
) -> tuple[int, np.float32]:
    """Compute the distances for one cluster, and return the size of its ring and the radius of its mask, px."""
    # One grid holds the distances to the mask and to the readings outside it side by side, each surrounded by FAR
    # cells. Each row is first filled with the distances along the row, because a shortest path may take its horizontal
    # steps first. Two vectorized sweeps, down and up, then add the vertical and diagonal steps.
    v0, u0 = bounds[0], bounds[1]
    rows, columns = bounds[2] - v0, bounds[3] - u0
    middle = columns + 1  # FAR cell between the two distances
    in_mask, in_rest = np.zeros((rows, columns), np.bool_), np.empty(columns, np.bool_)
    for i in range(len(pixels)):
        in_mask[pixels[i, 1] - v0, pixels[i, 0] - u0] = True
    grid = np.empty((rows, 2 * columns + 3), np.int16)
    for r in range(rows):
        row = grid[r]
        row[0] = row[middle] = row[-1] = FAR
        _mark_rest(in_mask[r], depth[v0 + r, u0 : u0 + columns], in_rest)
        _distances_along(in_mask[r], row[1:middle])
        _distances_along(in_rest, row[middle + 1 : middle + 1 + columns])
        if r > 0:
            _spread_across(grid[r - 1], row, middle)
    count, radius = 0, np.int16(0)
    for r in range(rows - 1, -1, -1):
        row = grid[r]
        if r < rows - 1:
            _spread_across(grid[r + 1], row, middle)
        of_row = steps[r * columns : (r + 1) * columns]
        count += _sign(
            in_mask[r], row[1:middle], row[middle + 1 : middle + 1 + columns], depth[v0 + r, u0 : u0 + columns], ring,
            of_row,
        )  # fmt: skip
        radius = max(radius, _highest(of_row))
    return count, PX_PER_STEP * np.float32(radius)


@njit(cache=True, nogil=True)
def _mark_rest(in_mask: Bool, depth: Float32, in_rest: Bool) -> None:
    for c in range(len(in_rest)):
        in_rest[c] = (not in_mask[c]) & (depth[c] > 0)


@njit(cache=True, nogil=True)
def _sign(in_mask: Bool, to_mask: Int16, to_rest: Int16, depth: Float32, ring: np.int16, steps: Int16) -> int:
    """Set the signed distances of one row, and return the number of readings in the ring."""
    count = np.int32(0)
    for c in range(len(steps)):
        in_ring = (not in_mask[c]) & (to_mask[c] <= ring) & (depth[c] > 0)
        outside = np.int16(-to_mask[c]) if in_ring else np.int16(0)
        steps[c] = to_rest[c] if in_mask[c] else outside
        count += np.int32(in_ring)
    return int(count)


@njit(cache=True, nogil=True)
def _highest(steps: Int16) -> np.int16:
    highest = np.int16(0)
    for step in steps:
        highest = step if step > highest else highest
    return highest


@njit(cache=True, nogil=True)
def _distances_along(sources: Bool, row: Int16) -> None:
    """Set each cell of a row to its distance to the nearest source in the row, FAR = no source."""
    columns = len(row)
    row[:] = 0
    begin = 0
    while begin < columns:
        if sources[begin]:
            begin += 1
            continue
        end = begin + 1
        while end < columns and not sources[end]:
            end += 1
        _fill_gap(row[begin:end], begin > 0, end < columns)
        begin = end + 1


@njit(cache=True, nogil=True)
def _fill_gap(gap: Int16, source_before: bool, source_behind: bool) -> None:
    n, step, far = np.int32(len(gap)), np.int32(CHAMFER_STEP), np.int32(FAR)
    for c in range(n):
        left = step * (np.int32(c) + np.int32(1)) if source_before else far
        right = step * (n - np.int32(c)) if source_behind else far
        nearest = left if left < right else right
        gap[c] = nearest if nearest < far else far


@njit(cache=True, nogil=True)
def _spread_across(neighbors: Int16, row: Int16, middle: int) -> None:
    n = len(row)
    _lower(row[1 : n - 1], neighbors[: n - 2], neighbors[1 : n - 1], neighbors[2:])
    row[middle] = FAR


@njit(cache=True, nogil=True)
def _lower(row: Int16, before: Int16, across: Int16, behind: Int16) -> None:
    """Update one row of the chamfer distance transform from an adjacent row."""
    for i in range(len(row)):
        diagonal = np.int16((before[i] if before[i] < behind[i] else behind[i]) + CHAMFER_DIAGONAL)
        straight = np.int16(across[i] + CHAMFER_STEP)
        nearest = straight if straight < diagonal else diagonal
        row[i] = nearest if nearest < row[i] else row[i]


@njit(cache=True, nogil=True, parallel=True)
def gather(
    windows: Windows, steps: Int16, depth: Float32, pinhole: Float32, starts: Int64, mask_counts: Int64, nth: Int64,
    schedule: ThreadSchedule, points: Float32, depth_in_mask: Float32,
) -> None:  # fmt: skip
    """Gather the points of the neighborhoods in the camera frame.

    Args:
        windows: The windows of the clusters.
        steps: The distances of the pixels, from signed_distances().
        depth: The depth image (H, W), m.
        pinhole: The intrinsics fx, fy, cx, cy, px.
        starts: The start (N + 1,) of each neighborhood in `points`.
        mask_counts: The number of gathered points (N,) of each mask.
        nth: The sampling step (N,) of each neighborhood.
        schedule: The clusters of each thread.
        points: The output (S, 3), m.
        depth_in_mask: The output (S,), the distance to the border of the mask, px.
    """
    firsts, cells = windows.firsts, windows.cells
    for thread in prange(len(schedule.starts) - 1):
        for k in schedule.order[schedule.starts[thread] : schedule.starts[thread + 1]]:
            middle, end = starts[k] + mask_counts[k], starts[k + 1]
            bounds, own_steps = windows.bounds[k], steps[cells[k] : cells[k + 1]]
            _gather_mask(
                windows.pixels[firsts[k] : firsts[k + 1]], bounds, own_steps, depth, pinhole, nth[k],
                points[starts[k] : middle], depth_in_mask[starts[k] : middle],
            )  # fmt: skip
            if middle < end:
                # every n-th point of mask and ring together
                skipped = mask_counts[k] * nth[k] - (firsts[k + 1] - firsts[k])
                _gather_ring(
                    bounds, own_steps, depth, pinhole, skipped, nth[k], points[middle:end], depth_in_mask[middle:end]
                )


@njit(cache=True, nogil=True)
def _gather_mask(
    pixels: Int32, bounds: Int64, steps: Int16, depth: Float32, pinhole: Float32, nth: int, points: Float32,
    depth_in_mask: Float32,
) -> None:  # fmt: skip
    v0, u0, columns = bounds[0], bounds[1], bounds[3] - bounds[1]
    for s in range(len(points)):
        u, v = pixels[s * nth, 0], pixels[s * nth, 1]
        _back_project(u, v, depth[v, u], pinhole, points, s)
        depth_in_mask[s] = PX_PER_STEP * np.float32(steps[(v - v0) * columns + u - u0])


@njit(cache=True, nogil=True)
def _gather_ring(
    bounds: Int64, steps: Int16, depth: Float32, pinhole: Float32, skipped: int, nth: int, points: Float32,
    depth_in_mask: Float32,
) -> None:  # fmt: skip
    v0, u0, columns = bounds[0], bounds[1], bounds[3] - bounds[1]
    s, until_next = 0, skipped
    for cell in range(len(steps)):
        if steps[cell] < 0:
            if until_next == 0:
                u, v = u0 + cell % columns, v0 + cell // columns
                _back_project(u, v, depth[v, u], pinhole, points, s)
                depth_in_mask[s] = PX_PER_STEP * np.float32(steps[cell])
                s, until_next = s + 1, nth
            until_next -= 1


@njit(cache=True, nogil=True)
def _back_project(u: int, v: int, z: np.float32, pinhole: Float32, points: Float32, s: int) -> None:
    points[s, 0] = np.float32(u - pinhole[2]) * (z / pinhole[0])
    points[s, 1] = np.float32(v - pinhole[3]) * (z / pinhole[1])
    points[s, 2] = z


@njit(cache=True, nogil=True)
def ramps(
    depth_in_mask: Float32, starts: Int64, widths: Float32, expected_bleed: float, largest: float, log_odds: Float32
) -> None:
    """Compute the log-odds of each point for the object, from its distance to the border of the mask.

    Args:
        depth_in_mask: The distance (S,) of each point to the border of the mask, px.
        starts: The start (N + 1,) of each neighborhood.
        widths: The distance (N,) over which the log-odds change by `largest`, px.
        expected_bleed: The distance of the zero from the border, in ring widths.
        largest: The maximum log-odds.
        log_odds: The output (S,).
    """
    zero = np.float32(expected_bleed / (1 - expected_bleed))
    for k in range(len(widths)):
        own = slice(starts[k], starts[k + 1])
        _ramp(depth_in_mask[own], np.float32(1) / widths[k], zero, np.float32(largest), log_odds[own])


@njit(cache=True, nogil=True)
def _ramp(depth_in_mask: Float32, scale: np.float32, zero: np.float32, largest: np.float32, log_odds: Float32) -> None:
    one = np.float32(1)
    for i in range(len(log_odds)):
        ramp = depth_in_mask[i] * scale - zero
        ramp = ramp if ramp < one else one
        log_odds[i] = largest * (ramp if ramp > -one else -one)
