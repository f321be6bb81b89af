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

import os
COMPAT = bool(os.environ.get("COMPAT"))
CELLS = 512  # that are looked at together


def in_largest_piece(clusters: PointClusters, frame: Frame, gap: float, gap_per_depth: float, reach: int) -> Bool:
    """(P,) which points are in their cluster's largest connected piece, of equals the one seen first in the image.

    Two points are connected when they are at most `reach` px apart and their depths differ by less than `gap` (m) +
    `gap_per_depth` * depth of the nearer one. Points of no cluster are in.
    """
    return _in_pieces(clusters, frame, gap, gap_per_depth, reach, 2.0, 0.0)


def in_hidden_apart_pieces(
    clusters: PointClusters,
    frame: Frame,
    gap: float,
    gap_per_depth: float,
    reach: int,
    min_share: float,
    steepest: float,
) -> Bool:
    """(P,) which points are in their cluster's largest piece, or in one that only an occluder parts from it.

    Pieces are those of `in_largest_piece`. Such a piece has `min_share` of the largest one's points or more, and on the
    way through the image from most of its points to the nearest ones of the largest piece there is something nearer
    than both, by more than the gap; the depths at both ends differ by no more than a surface would at `steepest` m of
    depth a metre aside, and by the gap.
    """
    return _in_pieces(clusters, frame, gap, gap_per_depth, reach, min_share, steepest)


def _in_pieces(
    clusters: PointClusters, frame: Frame, gap: float, gap_per_depth: float, reach: int, min_share: float, steepest: float
) -> Bool:
    order, firsts = members(clusters)
    in_largest = np.empty(firsts[-1], np.bool_)
    _find_largest(
        clusters.pixels[order], firsts, frame.depth, np.float32(gap), np.float32(gap_per_depth), reach,
        np.float32(min_share), np.float32(steepest / frame.camera.fx), *thread_shares(np.diff(firsts)), in_largest,
    )  # fmt: skip
    kept = np.ones(len(clusters.cluster), np.bool_)
    kept[order] = in_largest
    return kept


@njit(cache=True, nogil=True, parallel=True)
def _find_largest(
    pixels: Int32, firsts: Int64, depth: Float32, gap: np.float32, gap_per_depth: np.float32, reach: int,
    min_share: np.float32, steepest: np.float32, share_order: Int64, share_starts: Int64, in_largest: Bool,
) -> None:  # fmt: skip
    for share in prange(len(share_starts) - 1):
        for k in share_order[share_starts[share] : share_starts[share + 1]]:
            if firsts[k + 1] > firsts[k]:
                own = slice(firsts[k], firsts[k + 1])
                _find_largest_of(pixels[own], depth, gap, gap_per_depth, reach, min_share, steepest, in_largest[own])


@njit(cache=True, nogil=True)
def _find_largest_of(
    pixels: Int32, depth: Float32, gap: np.float32, gap_per_depth: np.float32, reach: int, min_share: np.float32,
    steepest: np.float32, in_largest: Bool,
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
    largest = np.argmax(pieces)
    least = max(min_share * np.float32(pieces[largest]), np.float32(2.0))
    stays = np.zeros(count, np.bool_)
    stays[largest] = True
    piece = np.empty(len(pixels), np.int32)
    for i in range(len(pixels)):
        piece[i] = parents[runs[(pixels[i, 1] - v0) * stride + pixels[i, 0] - u0]]
    if min_share <= np.float32(1.0):
        for other in range(1, count):
            if other != largest and pieces[other] >= least:
                stays[other] = _hidden_apart(pixels, piece, largest, other, depth, gap, gap_per_depth, steepest)
    for i in range(len(pixels)):
        in_largest[i] = stays[piece[i]]


@njit(cache=True, nogil=True)
def _some_of(piece: Int32, wanted: int, most: int) -> Int64:
    """Up to `most` places of `wanted`, evenly over all."""
    places = np.flatnonzero(piece == wanted)
    step = (len(places) + most - 1) // most
    return places[step // 2 :: step]


@njit(cache=True, nogil=True)
def _hidden_apart(
    pixels: Int32, piece: Int32, largest: int, other: int, depth: Float32, gap: np.float32, gap_per_depth: np.float32,
    steepest: np.float32,
) -> bool:  # fmt: skip
    """Whether something nearer stands between most of the points of a piece and the largest one."""
    ends = pixels[_some_of(piece, largest, 256)]
    starts = pixels[_some_of(piece, other, 32)]
    hidden = 0
    for k in range(len(starts)):
        u, v = starts[k, 0], starts[k, 1]
        best, nearest = 0, np.int64(1) << 60
        for e in range(len(ends)):
            away = np.int64(ends[e, 0] - u) ** 2 + np.int64(ends[e, 1] - v) ** 2
            if away < nearest:
                best, nearest = e, away
        hidden += _is_hidden_between(
            depth, u, v, ends[best, 0], ends[best, 1], gap, gap_per_depth, steepest * np.float32(np.sqrt(nearest))
        )
    return 2 * hidden > len(starts)


@njit(cache=True, nogil=True)
def _is_hidden_between(
    depth: Float32, u0: int, v0: int, u1: int, v1: int, gap: np.float32, gap_per_depth: np.float32, slope: np.float32
) -> bool:
    """Whether a pixel on the line between two has a reading nearer than both, by the gap; see in_hidden_apart_pieces."""
    z0, z1 = depth[v0, u0], depth[v1, u1]
    nearer = min(z0, z1)
    tolerance = gap + gap_per_depth * nearer
    if abs(z0 - z1) > tolerance + slope * nearer:
        return False
    if COMPAT:
        return True
    steps = max(abs(u1 - u0), abs(v1 - v0))
    for step in range(1, steps):
        t = step / steps
        z = depth[v0 + int(round(t * (v1 - v0))), u0 + int(round(t * (u1 - u0)))]
        if z > np.float32(0.0) and z < nearer - tolerance:
            return True
    return False


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
