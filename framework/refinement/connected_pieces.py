"""Pieces of a cluster that are connected in the image and in depth.

Pixels up to some rows apart are connected where their depths agree, for which no library has a kernel: OpenCV and SciPy
label binary images, and a graph of all near pairs takes 12 edges a point.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Frame, Int32, Int64, PointClusters
from framework.refinement.neighborhood import bounding_box, members, thread_shares
from framework.refinement.union_find import root, unite

CELLS = 512  # that are looked at together


def in_largest_piece(clusters: PointClusters, frame: Frame, gap: float, gap_per_depth: float, reach: int) -> Bool:
    """(P,) which points are in their cluster's largest connected piece, of equals the one seen first in the image.

    Two points are connected when they are at most `reach` px apart and their depths differ by less than `gap` (m) +
    `gap_per_depth` * depth of the nearer one. Points of no cluster are in.
    """
    order, firsts = members(clusters)
    in_largest = np.empty(firsts[-1], np.bool_)
    _find_largest(
        clusters.pixels[order], firsts, frame.depth, np.float32(gap), np.float32(gap_per_depth), reach,
        *thread_shares(np.diff(firsts)), in_largest,
    )  # fmt: skip
    kept = np.ones(len(clusters.cluster), np.bool_)
    kept[order] = in_largest
    return kept


@njit(cache=True, nogil=True, parallel=True)
def _find_largest(
    pixels: Int32, firsts: Int64, depth: Float32, gap: np.float32, gap_per_depth: np.float32, reach: int,
    share_order: Int64, share_starts: Int64, in_largest: Bool,
) -> None:  # fmt: skip
    for share in prange(len(share_starts) - 1):
        for k in share_order[share_starts[share] : share_starts[share + 1]]:
            if firsts[k + 1] > firsts[k]:
                own = slice(firsts[k], firsts[k + 1])
                _find_largest_of(pixels[own], depth, gap, gap_per_depth, reach, in_largest[own])


@njit(cache=True, nogil=True)
def _find_largest_of(
    pixels: Int32, depth: Float32, gap: np.float32, gap_per_depth: np.float32, reach: int, in_largest: Bool
) -> None:
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
    of_largest = parents[:count] == np.argmax(pieces)
    for i in range(len(pixels)):
        in_largest[i] = of_largest[runs[(pixels[i, 1] - v0) * stride + pixels[i, 0] - u0]]


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
