"""Kernels of connected_pieces.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Int32, Int64
from framework.refinement.neighborhood_kernels import ThreadSchedule, bounding_box
from framework.refinement.segmentation.union_find import root, unite

CHUNK = 512  # number of cells compared at once
CANDIDATE_SAMPLES, KEPT_SAMPLES = 32, 256  # maximum number of sampled pixels of a candidate and a kept component


class Connection(NamedTuple):
    """Limits of the distance between connected points."""

    gap: np.float32  # maximum depth difference at depth 0, m
    gap_per_depth: np.float32  # increase of the maximum difference with the depth of the nearer point, m per m
    radius: int  # maximum offset along u and along v, px


@njit(cache=True, nogil=True, parallel=True)
def find_pieces(
    pixels: Int32, firsts: Int64, depth: Float32, connection: Connection, min_ratio: np.float32, max_slope: np.float32,
    schedule: ThreadSchedule, stays: Bool,
) -> None:  # fmt: skip
    """Find the points in the kept connected components of their cluster.

    Args:
        pixels: The pixels (M, 2), u and v, of the points, cluster by cluster.
        firsts: The start (N + 1,) of each cluster.
        depth: The depth image (H, W), m.
        connection: The limits of the distance between connected points.
        min_ratio: The minimum size of a kept component, relative to the largest component.
        max_slope: The maximum slope, m per m, divided by the focal length, px.
        schedule: The clusters of each thread.
        stays: The output (M,), True for points to keep.
    """
    for thread in prange(len(schedule.starts) - 1):
        for k in schedule.order[schedule.starts[thread] : schedule.starts[thread + 1]]:
            if firsts[k + 1] > firsts[k]:
                own = slice(firsts[k], firsts[k + 1])
                _find_pieces_of(pixels[own], depth, connection, min_ratio, max_slope, stays[own])


@njit(cache=True, nogil=True)
def _find_pieces_of(
    pixels: Int32, depth: Float32, connection: Connection, min_ratio: np.float32, max_slope: np.float32, stays: Bool
) -> None:
    """Find the kept points of one cluster by union-find over runs of connected pixels."""
    # Cells are in flat arrays, row by row, with empty cells at the end of each row. Therefore, offsets to neighbors are
    # constant, and no run continues in the next row.
    u0, v0, u1, v1 = bounding_box(pixels)
    reach = connection.radius
    stride = u1 - u0 + 1 + reach
    cells = (v1 - v0 + 1) * stride
    readings = np.full(cells + reach * stride + reach, np.float32(np.nan), np.float32)  # NaN = not in the cluster
    for i in range(len(pixels)):
        readings[(pixels[i, 1] - v0) * stride + pixels[i, 0] - u0] = depth[pixels[i, 1], pixels[i, 0]]
    runs = np.zeros(len(readings), np.int32)
    parents, sizes = np.empty(len(pixels) + 1, np.int32), np.empty(len(pixels) + 1, np.int32)
    count = _find_runs(readings[:cells], connection, runs, parents, sizes)
    _unite_near(readings, runs, cells, stride, connection, parents)
    _name_by_roots(parents[:count])
    for cell in range(cells):
        runs[cell] = parents[runs[cell]]
    for dv in range(reach + 1):  # one half-plane, so that each pair of neighbors occurs once
        for du in range(-reach if dv > 0 else 2, reach + 1):
            _unite_near(readings, runs, cells, dv * stride + du, connection, parents)
    _name_by_roots(parents[:count])
    pieces = np.zeros(count, np.int32)
    for run in range(count):
        pieces[parents[run]] += sizes[run]
    largest = 0
    for run in range(count):
        largest = run if pieces[run] > pieces[largest] else largest
    piece = np.empty(len(pixels), np.int32)
    for i in range(len(pixels)):
        piece[i] = parents[runs[(pixels[i, 1] - v0) * stride + pixels[i, 0] - u0]]
    piece_stays = np.zeros(count, np.bool_)
    piece_stays[largest] = True
    _keep_near(pixels, piece, pieces, largest, min_ratio, depth, connection, max_slope, piece_stays)
    for i in range(len(pixels)):
        stays[i] = piece_stays[piece[i]]


@njit(cache=True, nogil=True)
def _keep_near(
    pixels: Int32, piece: Int32, sizes: Int32, largest: int, min_ratio: np.float32, depth: Float32,
    connection: Connection, max_slope: np.float32, stays: Bool,
) -> None:  # fmt: skip
    """Mark the components at a similar depth to the kept components, in order of decreasing size."""
    least = min_ratio * np.float32(sizes[largest])
    candidates, waiting, count = np.empty(len(sizes), np.int64), np.zeros(len(sizes), np.bool_), 0
    for other in range(len(sizes)):
        if other != largest and sizes[other] > 0 and sizes[other] >= least:
            candidates[count], waiting[other] = other, True
            count += 1
    if count == 0:
        return
    samples, kept = np.empty((CANDIDATE_SAMPLES, 2), np.int32), np.empty((len(pixels), 2), np.int32)
    kept_count = _sample(pixels, piece, largest, KEPT_SAMPLES, kept)
    for _ in range(count):
        candidate = _largest(candidates[:count], sizes, waiting)
        waiting[candidate] = False
        sample_count = _sample(pixels, piece, candidate, CANDIDATE_SAMPLES, samples)
        if _is_near(samples[:sample_count], kept[:kept_count], depth, connection, max_slope):
            stays[candidate] = True
            kept_count += _sample(pixels, piece, candidate, KEPT_SAMPLES, kept[kept_count:])


@njit(cache=True, nogil=True)
def _largest(pieces: Int64, sizes: Int32, waiting: Bool) -> int:
    """Return the largest component that is still waiting."""
    largest = -1
    for piece in pieces:  # np.argsort compiles slowly
        if waiting[piece] and (largest < 0 or sizes[piece] > sizes[largest]):
            largest = piece
    return largest


@njit(cache=True, nogil=True)
def _sample(pixels: Int32, piece: Int32, wanted: int, most: int, samples: Int32) -> int:
    """Write at most `most` evenly spaced pixels of a component to `samples`, and return their number."""
    size = 0
    for i in range(len(pixels)):
        size += piece[i] == wanted
    step = (size + most - 1) // most
    count, skip = 0, step // 2
    for i in range(len(pixels)):
        if piece[i] == wanted:
            if skip == 0:
                samples[count, 0], samples[count, 1] = pixels[i, 0], pixels[i, 1]
                count, skip = count + 1, step
            skip -= 1
    return count


@njit(cache=True, nogil=True)
def _is_near(samples: Int32, kept: Int32, depth: Float32, connection: Connection, max_slope: np.float32) -> bool:
    """Return True if most samples agree in depth with the nearest kept pixel."""
    near = 0
    for k in range(len(samples)):
        u, v = samples[k, 0], samples[k, 1]
        nearest, least = 0, np.int64(1) << 60
        for e in range(len(kept)):
            distance = np.int64(kept[e, 0] - u) ** 2 + np.int64(kept[e, 1] - v) ** 2
            if distance < least:
                nearest, least = e, distance
        z, z_kept = depth[v, u], depth[kept[nearest, 1], kept[nearest, 0]]
        slope = connection.gap_per_depth + max_slope * np.float32(np.sqrt(least))
        near += abs(z - z_kept) <= connection.gap + slope * min(z, z_kept)
    return 2 * near > len(samples)


@njit(cache=True, nogil=True)
def _name_by_roots(parents: Int32) -> None:
    for run in range(len(parents)):
        parents[run] = root(parents, run)


@njit(cache=True, nogil=True)
def _find_runs(readings: Float32, connection: Connection, runs: Int32, parents: Int32, sizes: Int32) -> int:
    """Label each run of connected pixels from 1 on, and return the number of labels, including 0 for empty cells."""
    run, begin = 0, 0
    parents[0], sizes[0] = 0, 0
    previous = np.float32(np.nan)
    for cell in range(len(readings)):
        z = readings[cell]
        if z == z:
            if not _connected(z, previous, connection):
                run, begin = run + 1, cell
                parents[run] = run
            runs[cell] = run
            sizes[run] = cell + 1 - begin
        previous = z
    return run + 1


@njit(cache=True, nogil=True)
def _connected(a: np.float32, b: np.float32, connection: Connection) -> bool:
    return bool(abs(a - b) < connection.gap + connection.gap_per_depth * (a if a < b else b))


@njit(cache=True, nogil=True)
def _unite_near(
    readings: Float32, runs: Int32, cells: int, offset: int, connection: Connection, parents: Int32
) -> None:
    """Unite the runs of all connected cells with the given offset between them."""
    for begin in range(0, cells, CHUNK):
        end = min(begin + CHUNK, cells)
        here, there = slice(begin, end), slice(begin + offset, end + offset)
        _unite_near_of(readings[here], readings[there], runs[here], runs[there], connection, parents)


@njit(cache=True, nogil=True)
def _unite_near_of(
    z: Float32, z_there: Float32, runs: Int32, runs_there: Int32, connection: Connection, parents: Int32
) -> None:
    apart = False
    for i in range(len(z)):  # vectorized check: usually all connected cells are already united
        apart |= _connected(z[i], z_there[i], connection) & (runs[i] != runs_there[i])
    if not apart:
        return
    last, last_there = 0, 0
    for i in range(len(z)):
        a, b = runs[i], runs_there[i]
        if a != b and not (a == last and b == last_there) and _connected(z[i], z_there[i], connection):
            unite(parents, a, b)
            last, last_there = a, b
