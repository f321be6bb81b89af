"""Kernels of connected_pieces.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Int32, Int64
from framework.refinement.neighborhood_kernels import bounding_box
from framework.refinement.segmentation.union_find import root, unite

CELLS = 512  # that are looked at together
STARTS, ENDS = 32, 256  # samples of a piece that may stay, and of one that does


@njit(cache=True, nogil=True, parallel=True)
def find_pieces(
    pixels: Int32, firsts: Int64, depth: Float32, gap: np.float32, gap_per_depth: np.float32, reach: int,
    min_share: np.float32, steepest: np.float32, share_order: Int64, share_starts: Int64, stays: Bool,
) -> None:  # fmt: skip
    for share in prange(len(share_starts) - 1):
        for k in share_order[share_starts[share] : share_starts[share + 1]]:
            if firsts[k + 1] > firsts[k]:
                own = slice(firsts[k], firsts[k + 1])
                _find_pieces_of(pixels[own], depth, gap, gap_per_depth, reach, min_share, steepest, stays[own])


@njit(cache=True, nogil=True)
def _find_pieces_of(
    pixels: Int32, depth: Float32, gap: np.float32, gap_per_depth: np.float32, reach: int, min_share: np.float32,
    steepest: np.float32, stays: Bool,
) -> None:  # fmt: skip
    """Union-find over the runs of connected pixels in each row, of which there are far fewer than pixels.

    Cells lie row by row in flat arrays, with empty ones at the end of each row, so that a neighbor is as far away
    everywhere and no piece goes on in the next row.
    """
    u0, v0, u1, v1 = bounding_box(pixels)
    stride = u1 - u0 + 1 + reach
    cells = (v1 - v0 + 1) * stride
    readings = np.full(cells + reach * stride + reach, np.float32(np.nan), np.float32)  # NaN = not in the cluster
    for i in range(len(pixels)):
        readings[(pixels[i, 1] - v0) * stride + pixels[i, 0] - u0] = depth[pixels[i, 1], pixels[i, 0]]
    runs = np.zeros(len(readings), np.int32)
    parents, sizes = np.empty(len(pixels) + 1, np.int32), np.empty(len(pixels) + 1, np.int32)
    count = _find_runs(readings[:cells], gap, gap_per_depth, runs, parents, sizes)
    _unite_near(readings, runs, cells, stride, gap, gap_per_depth, parents)
    _name_by_roots(parents[:count])
    for cell in range(cells):
        runs[cell] = parents[runs[cell]]
    for dv in range(reach + 1):  # the half-plane behind: each pair of neighbors is met once
        for du in range(-reach if dv > 0 else 2, reach + 1):
            _unite_near(readings, runs, cells, dv * stride + du, gap, gap_per_depth, parents)
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
    _keep_near(pixels, piece, pieces, largest, min_share, depth, gap, gap_per_depth, steepest, piece_stays)
    for i in range(len(pixels)):
        stays[i] = piece_stays[piece[i]]


@njit(cache=True, nogil=True)
def _keep_near(
    pixels: Int32, piece: Int32, sizes: Int32, largest: int, min_share: np.float32, depth: Float32, gap: np.float32,
    gap_per_depth: np.float32, steepest: np.float32, stays: Bool,
) -> None:  # fmt: skip
    """Marks the pieces that no large step parts from those that stay, the larger ones first."""
    least = min_share * np.float32(sizes[largest])
    others, waiting, count = np.empty(len(sizes), np.int64), np.zeros(len(sizes), np.bool_), 0
    for other in range(len(sizes)):
        if other != largest and sizes[other] > 0 and sizes[other] >= least:
            others[count], waiting[other] = other, True
            count += 1
    if count == 0:
        return
    starts, ends = np.empty((STARTS, 2), np.int32), np.empty((len(pixels), 2), np.int32)
    end = _take_some(pixels, piece, largest, ENDS, ends)
    for _ in range(count):
        other = _largest(others[:count], sizes, waiting)
        waiting[other] = False
        start = _take_some(pixels, piece, other, STARTS, starts)
        if _is_near(starts[:start], ends[:end], depth, gap, gap_per_depth, steepest):
            stays[other] = True
            end += _take_some(pixels, piece, other, ENDS, ends[end:])


@njit(cache=True, nogil=True)
def _largest(pieces: Int64, sizes: Int32, waiting: Bool) -> int:
    """The largest of the pieces that wait, of several such the first; they are few, and np.argsort compiles slowly."""
    largest = -1
    for piece in pieces:
        if waiting[piece] and (largest < 0 or sizes[piece] > sizes[largest]):
            largest = piece
    return largest


@njit(cache=True, nogil=True)
def _take_some(pixels: Int32, piece: Int32, wanted: int, most: int, some: Int32) -> int:
    """Writes up to `most` pixels of a piece, evenly over all; their number."""
    size = 0
    for i in range(len(pixels)):
        size += piece[i] == wanted
    step = (size + most - 1) // most
    count, skip = 0, step // 2
    for i in range(len(pixels)):
        if piece[i] == wanted:
            if skip == 0:
                some[count, 0], some[count, 1] = pixels[i, 0], pixels[i, 1]
                count, skip = count + 1, step
            skip -= 1
    return count


@njit(cache=True, nogil=True)
def _is_near(
    starts: Int32, ends: Int32, depth: Float32, gap: np.float32, gap_per_depth: np.float32, steepest: np.float32
) -> bool:
    """Whether most of `starts` differ from the nearest of `ends` in depth by no more than a surface may rise."""
    near = 0
    for k in range(len(starts)):
        u, v = starts[k, 0], starts[k, 1]
        nearest, away = 0, np.int64(1) << 60
        for e in range(len(ends)):
            distance = np.int64(ends[e, 0] - u) ** 2 + np.int64(ends[e, 1] - v) ** 2
            if distance < away:
                nearest, away = e, distance
        here, there = depth[v, u], depth[ends[nearest, 1], ends[nearest, 0]]
        rise = gap + (gap_per_depth + steepest * np.float32(np.sqrt(away))) * min(here, there)
        near += abs(here - there) <= rise
    return 2 * near > len(starts)


@njit(cache=True, nogil=True)
def _name_by_roots(parents: Int32) -> None:
    for run in range(len(parents)):
        parents[run] = root(parents, run)


@njit(cache=True, nogil=True)
def _find_runs(
    readings: Float32, gap: np.float32, gap_per_depth: np.float32, runs: Int32, parents: Int32, sizes: Int32
) -> int:
    """Numbers the runs from 1, in the order of their first cells; returns one more than the last number.

    Each is a piece of its own, and so is 0, the empty one.
    """
    run, begin = 0, 0
    parents[0], sizes[0] = 0, 0
    before = np.float32(np.nan)
    for cell in range(len(readings)):
        z = readings[cell]
        if z == z:
            if not _near(z, before, gap, gap_per_depth):
                run, begin = run + 1, cell
                parents[run] = run
            runs[cell] = run
            sizes[run] = cell + 1 - begin
        before = z
    return run + 1


@njit(cache=True, nogil=True)
def _near(a: np.float32, b: np.float32, gap: np.float32, gap_per_depth: np.float32) -> bool:
    return bool(abs(a - b) < gap + gap_per_depth * (a if a < b else b))


@njit(cache=True, nogil=True)
def _unite_near(
    readings: Float32, runs: Int32, cells: int, offset: int, gap: np.float32, gap_per_depth: np.float32, parents: Int32
) -> None:
    """Unites the runs of all cells that are `offset` apart and near in depth."""
    for first in range(0, cells, CELLS):
        last = min(first + CELLS, cells)
        here, there = slice(first, last), slice(first + offset, last + offset)
        _unite_near_of(readings[here], readings[there], runs[here], runs[there], gap, gap_per_depth, parents)


@njit(cache=True, nogil=True)
def _unite_near_of(
    z: Float32, z_there: Float32, runs: Int32, runs_there: Int32, gap: np.float32, gap_per_depth: np.float32,
    parents: Int32,
) -> None:  # fmt: skip
    apart = False
    for i in range(len(z)):  # in vector code: mostly all that are near are one piece already
        apart |= _near(z[i], z_there[i], gap, gap_per_depth) & (runs[i] != runs_there[i])
    if not apart:
        return
    last, last_there = 0, 0
    for i in range(len(z)):
        a, b = runs[i], runs_there[i]
        if a != b and not (a == last and b == last_there) and _near(z[i], z_there[i], gap, gap_per_depth):
            unite(parents, a, b)
            last, last_there = a, b
