"""Cluster refinement by density: an object is one dense piece, what a mask caught beside it is another or none."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Frame, Int32, Int64, PointClusters
from framework.interfaces import ClusterRefiner
from framework.parameters import check_bounds
from framework.refinement.neighborhood import grouped
from framework.refinement.selection import keep_points
from framework.refinement.union_find import root

REACH = 2  # cells on each side that eps spans, with cells whose diagonal is eps
NEAR, FAR, UNCLEAR = 0, 1, 2  # what a cell tells about the distance of its points to a piece
MARGIN = 1e-6  # relative, by which cells are smaller, so that rounding takes no two points of one cell apart


def _offsets() -> Int64:
    """(124, 3) the neighboring cells that within eps can reach, the touching ones first."""
    side = np.arange(-REACH, REACH + 1)
    cells = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = cells[np.argsort((cells**2).sum(axis=1), kind="stable")]
    return np.asarray(cells[1:], np.int64)


AROUND = _offsets()


@dataclass
class Dbscan(ClusterRefiner):
    """Keeps of each cluster its largest dense piece.

    DBSCAN (Ester, Kriegel, Sander and Xu, "A Density-Based Algorithm for Discovering Clusters in Large Spatial
    Databases with Noise", KDD 1996), exact, on a grid whose cells have the diagonal eps, as Gunawan's (2013). A core
    point has at least `min_points` points, itself among them, within eps = `eps` + `eps_per_depth` * the cluster's
    median depth. Core points within eps of each other hang together; the piece with the most of them stays, of equally
    large ones the one seen first in the image, with all points within eps of its core points. (Such border points may
    be near to other pieces too; DBSCAN gives them to whichever comes first, here they stay.)

    With a `stride` above 1 only the pixels of every `stride`-th row and column are searched for core points, and
    `min_points` counts these; all points are judged by them. A cluster without any core point, too sparse to tell, is
    left as it is. A dropped point leaves the arrays, clusters keep their index.
    """

    eps: float = 0.04  # m, from 0.001
    eps_per_depth: float = 0.01  # m per m, from 0; the spacing of readings grows with depth
    min_points: int = 10  # from 1
    stride: int = 2  # px, from 1; 1 = no thinning

    def __post_init__(self) -> None:
        check_bounds(
            self,
            eps=(1e-3, np.inf),
            eps_per_depth=(0.0, np.inf),
            min_points=(1, 10**9),
            stride=(1, 64),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if clusters.exact:
            return clusters
        order, firsts = grouped(clusters.cluster, len(clusters))
        kept = np.ones(len(clusters.cluster), np.bool_)
        _keep_largest(
            clusters.points_world, clusters.pixels, order, firsts, frame.depth,
            self.eps, self.eps_per_depth, self.min_points, self.stride, kept,
        )  # fmt: skip
        return keep_points(clusters, kept)


@njit(cache=True, nogil=True, parallel=True)
def _keep_largest(
    points: Float32, pixels: Int32, order: Int64, firsts: Int64, depth: Float32,
    eps: float, eps_per_depth: float, min_points: int, stride: int, kept: Bool,
) -> None:  # fmt: skip
    for k in prange(len(firsts) - 1):
        members = order[firsts[k] : firsts[k + 1]]
        sampled = _sampled(pixels, members, stride)
        if len(sampled) > 0:
            reach = eps + eps_per_depth * _median_depth(pixels, sampled, depth)
            _keep_largest_of(points[members], points[sampled], members, reach, min_points, kept)


@njit(cache=True, nogil=True)
def _sampled(pixels: Int32, members: Int64, stride: int) -> Int64:
    chosen = np.empty(len(members), np.int64)
    n = 0
    for i in members:
        if pixels[i, 0] % stride == 0 and pixels[i, 1] % stride == 0:
            chosen[n] = i
            n += 1
    return chosen[:n]


@njit(cache=True, nogil=True)
def _median_depth(pixels: Int32, members: Int64, depth: Float32) -> float:
    depths = np.empty(len(members), np.float32)
    for j, i in enumerate(members):
        depths[j] = depth[pixels[i, 1], pixels[i, 0]]
    return float(np.median(depths))


@njit(cache=True, nogil=True)
def _keep_largest_of(
    points: Float32, sampled: Float32, members: Int64, eps: float, min_points: int, kept: Bool
) -> None:
    """Drops of the `points`, whose indices are `members`, those that are not near the largest piece of `sampled`."""
    size = _cell_size(eps)
    table, cells, cell_of = _grid(sampled, size)
    by_cell, starts = grouped(cell_of, len(cells))
    xyz = sampled[by_cell]
    is_core = _cores(xyz, table, cells, starts, eps, min_points)
    pieces = _pieces(xyz, is_core, table, cells, starts, eps)
    core_counts = np.zeros(len(cells), np.int64)
    for c in range(len(cells)):
        if pieces[c] >= 0:
            core_counts[pieces[c]] += is_core[starts[c] : starts[c + 1]].sum()
    largest = np.argmax(core_counts)
    if core_counts[largest] == 0:
        return
    clear = np.empty(len(cells), np.int8)
    for c in range(len(cells)):
        clear[c] = _clear_case(c, table, cells, pieces, largest)
    for j in range(len(points)):
        x, y, z = _coordinates(points[j], size)
        own = table[_slot(table, cells, x, y, z)]
        case = UNCLEAR if own < 0 else clear[own]
        kept[members[j]] = case == NEAR or (
            case == UNCLEAR and _is_near(points[j], x, y, z, xyz, is_core, table, cells, starts, pieces, largest, eps)
        )


@njit(cache=True, nogil=True)
def _clear_case(c: int, table: Int32, cells: Int64, pieces: Int32, piece: int) -> int:
    """Whether all points of the cell are NEAR the piece, FAR from it, or each has to be looked at."""
    if pieces[c] == piece:
        return NEAR
    around = np.empty(len(AROUND), np.int32)
    for other in around[: _cells_around(table, cells, cells[c, 0], cells[c, 1], cells[c, 2], around)]:
        if pieces[other] == piece:
            return UNCLEAR
    return FAR


@njit(cache=True, nogil=True)
def dense_pieces(points: Float32, eps: float, min_points: int) -> Int32:
    """(P,) the piece of each core point of `points` (P, 3), P > 0; -1 = not a core point."""
    table, cells, cell_of = _grid(points, _cell_size(eps))
    by_cell, starts = grouped(cell_of, len(cells))
    xyz = points[by_cell]
    is_core = _cores(xyz, table, cells, starts, eps, min_points)
    pieces = _pieces(xyz, is_core, table, cells, starts, eps)
    labels = np.full(len(points), -1, np.int32)
    for s, i in enumerate(by_cell):
        if is_core[s]:
            labels[i] = pieces[cell_of[i]]
    return labels


@njit(cache=True, nogil=True)
def _cell_size(eps: float) -> float:
    """The side of a cell with the diagonal eps: all points of one cell are within eps of each other."""
    return eps / math.sqrt(3.0) * (1.0 - MARGIN)


@njit(cache=True, nogil=True)
def _grid(points: Float32, size: float) -> tuple[Int32, Int64, Int32]:
    """The occupied cells: a hash table of them, their coordinates (C, 3), and the cell of each point.

    Cells are numbered as they come, so that the first one is the one seen first in the image.
    """
    slots = 16
    while slots < 2 * len(points):
        slots *= 2
    table, cells = np.full(slots, -1, np.int32), np.empty((len(points), 3), np.int64)
    cell_of = np.empty(len(points), np.int32)
    n = 0
    for i in range(len(points)):
        x, y, z = _coordinates(points[i], size)
        c = cell_of[i - 1] if i > 0 else 0  # neighbors in the image mostly share their cell
        if i == 0 or cells[c, 0] != x or cells[c, 1] != y or cells[c, 2] != z:
            slot = _slot(table, cells, x, y, z)
            if table[slot] < 0:
                table[slot] = n
                cells[n, 0], cells[n, 1], cells[n, 2] = x, y, z
                n += 1
            c = table[slot]
        cell_of[i] = c
    return table, cells[:n], cell_of


@njit(cache=True, nogil=True)
def _coordinates(point: Float32, size: float) -> tuple[int, int, int]:
    return math.floor(point[0] / size), math.floor(point[1] / size), math.floor(point[2] / size)


@njit(cache=True, nogil=True)
def _slot(table: Int32, cells: Int64, x: int, y: int, z: int) -> int:
    """Where the cell is in the table, or the free slot for it (primes: Teschner et al. 2003)."""
    slot = ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & (len(table) - 1)
    while True:
        c = table[slot]
        if c < 0 or (cells[c, 0] == x and cells[c, 1] == y and cells[c, 2] == z):
            return slot
        slot = (slot + 1) & (len(table) - 1)


@njit(cache=True, nogil=True)
def _cores(xyz: Float32, table: Int32, cells: Int64, starts: Int64, eps: float, min_points: int) -> Bool:
    """(P,) which points, in the order of their cells, are core points."""
    is_core = np.ones(len(xyz), np.bool_)
    around = np.empty(len(AROUND), np.int32)
    for c in range(len(cells)):
        if starts[c + 1] - starts[c] < min_points:  # else the cell alone is dense
            n = _cells_around(table, cells, cells[c, 0], cells[c, 1], cells[c, 2], around)
            for s in range(starts[c], starts[c + 1]):
                is_core[s] = _has_neighbors(xyz, s, starts[c + 1] - starts[c], around[:n], starts, eps, min_points)
    return is_core


@njit(cache=True, nogil=True)
def _cells_around(table: Int32, cells: Int64, x: int, y: int, z: int, around: Int32) -> int:
    """Fills `around` with the occupied cells within reach of the cell at x, y, z, without itself; their number."""
    n = 0
    for o in range(len(AROUND)):
        other = table[_slot(table, cells, x + AROUND[o, 0], y + AROUND[o, 1], z + AROUND[o, 2])]
        if other >= 0:
            around[n] = other
            n += 1
    return n


@njit(cache=True, nogil=True)
def _has_neighbors(xyz: Float32, s: int, count: int, around: Int32, starts: Int64, eps: float, min_points: int) -> bool:
    """Whether `count` and the points near point s in the cells `around` are at least `min_points`."""
    for other in around:
        for t in range(starts[other], starts[other + 1]):
            count += _are_near(xyz[s], xyz[t], eps)
            if count >= min_points:
                return True
    return False


@njit(cache=True, nogil=True)
def _are_near(p: Float32, q: Float32, eps: float) -> bool:
    x, y, z = np.float64(p[0]) - q[0], np.float64(p[1]) - q[1], np.float64(p[2]) - q[2]
    return bool(x * x + y * y + z * z <= eps * eps)


@njit(cache=True, nogil=True)
def _pieces(xyz: Float32, is_core: Bool, table: Int32, cells: Int64, starts: Int64, eps: float) -> Int32:
    """(C,) the piece that the core points of each cell are in, named after its first cell; -1 = no core point."""
    parents = np.full(len(cells), -1, np.int32)
    for c in range(len(cells)):
        if is_core[starts[c] : starts[c + 1]].any():
            parents[c] = c
    for o in range(len(AROUND)):  # touching cells first: most others are then united already
        for c in range(len(cells)):
            if parents[c] < 0:
                continue
            x, y, z = cells[c, 0] + AROUND[o, 0], cells[c, 1] + AROUND[o, 1], cells[c, 2] + AROUND[o, 2]
            other = table[_slot(table, cells, x, y, z)]
            if other < c or parents[other] < 0:  # each pair once
                continue
            a, b = root(parents, c), root(parents, other)
            if a != b and _touch(xyz, is_core, starts, c, other, eps):
                parents[max(a, b)] = min(a, b)
    for c in range(len(cells)):
        if parents[c] >= 0:
            parents[c] = root(parents, c)
    return parents


@njit(cache=True, nogil=True)
def _touch(xyz: Float32, is_core: Bool, starts: Int64, c: int, other: int, eps: float) -> bool:
    """Whether a core point of one cell is within eps of a core point of the other."""
    for s in range(starts[c], starts[c + 1]):
        if is_core[s]:
            for t in range(starts[other], starts[other + 1]):
                if is_core[t] and _are_near(xyz[s], xyz[t], eps):
                    return True
    return False


@njit(cache=True, nogil=True)
def _is_near(
    point: Float32, x: int, y: int, z: int, xyz: Float32, is_core: Bool, table: Int32, cells: Int64, starts: Int64,
    pieces: Int32, piece: int, eps: float,
) -> bool:  # fmt: skip
    """Whether a point of the cell at x, y, z, which holds no core point of the piece, is within eps of one."""
    around = np.empty(len(AROUND), np.int32)
    for other in around[: _cells_around(table, cells, x, y, z, around)]:
        if pieces[other] == piece:
            for t in range(starts[other], starts[other + 1]):
                if is_core[t] and _are_near(point, xyz[t], eps):
                    return True
    return False
