"""Each mask's points together with a ring of points around the mask: what tells an object from its background."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Bool, Camera, Float32, Frame, Int32, PointClusters

Int64 = npt.NDArray[np.int64]

# 3-4 chamfer distance (Borgefors 1986), at most 8 % from the Euclidean one; floats of whole numbers are exact
CHAMFER_STEP, CHAMFER_DIAGONAL = np.float32(3), np.float32(4)
FAR = np.float32(1e6)  # beyond every image
MAX_RING_WIDTH = 80  # px; wider rings tell nothing about the object


@dataclass(frozen=True)
class Neighborhoods:
    """For each of N clusters its own points, then those of the ring around its mask, in one flat array.

    Neighborhood k is `points_camera[starts[k]:starts[k + 1]]`; its first `mask_counts[k]` points are the cluster's own.
    """

    points_camera: Float32  # (S, 3) m
    depth_in_mask: Float32  # (S,) px to the mask's border: positive inside, negative in the ring
    source: Int32  # (S,) index of the cluster's point in the PointClusters, -1 for a point of the ring
    starts: Int64  # (N + 1,)
    mask_counts: Int64  # (N,)
    ring_widths: Int64  # (N,) px
    mask_radii: Float32  # (N,) px, depth in the mask of its innermost point; 0 for an empty cluster

    def __len__(self) -> int:
        return len(self.mask_counts)

    @property
    def ring_counts(self) -> Int64:
        """(N,) points in each ring; 0 where nothing around the mask has a depth reading."""
        return np.asarray(np.diff(self.starts) - self.mask_counts)

    def of_at_least(self, min_points: int) -> Bool:
        """(N,) which clusters have at least `min_points` points, and as many in their ring."""
        return np.asarray((self.mask_counts >= min_points) & (self.ring_counts >= min_points))

    def kept(self, good: Bool, judged: Bool, points: int) -> Bool:
        """(`points`,) which points of the PointClusters stay: the `good` (S,) ones of clusters that were `judged` (N,).

        Points of clusters that were not judged stay, and so do those of no cluster.
        """
        return np.asarray(_kept(good, judged, self.starts, self.mask_counts, self.source, points), np.bool_)

    def thinned(self, max_points: int) -> Neighborhoods:
        """Every n-th point of each neighborhood, n chosen so that at most `max_points` are left of it."""
        points, depth_in_mask, source, starts, mask_counts = _every_nth(
            self.points_camera, self.depth_in_mask, self.source, self.starts, self.mask_counts, max_points
        )
        return Neighborhoods(points, depth_in_mask, source, starts, mask_counts, self.ring_widths, self.mask_radii)


def ring_bounds(min_ring: int) -> dict[str, tuple[float, float]]:
    """For `check_bounds`: what the parameters may be by which a plugin chooses rings and what it looks at of them."""
    return {
        "ring_fraction": (0.0, 10.0),
        "min_ring": (1, MAX_RING_WIDTH),
        "max_ring": (min_ring, MAX_RING_WIDTH),
        "max_points": (100, 10**9),
        "min_points": (10, 10**9),
    }


def neighborhoods(
    clusters: PointClusters, frame: Frame, ring_fraction: float, min_ring: int, max_ring: int
) -> Neighborhoods:
    """The N clusters of one frame with their rings, in camera coordinates.

    A ring holds the pixels that have a depth reading, are not in the cluster themselves and lie within
    `ring_fraction` * sqrt(points in the cluster) px of it, bounded to [`min_ring`, `max_ring`] px. Pixels of other
    clusters belong to it like any other. `max_ring` is at most MAX_RING_WIDTH.
    """
    camera, pixels = frame.camera, clusters.pixels
    order, firsts = grouped(clusters.cluster, len(clusters))
    areas = np.diff(firsts)
    widths = np.clip(np.rint(ring_fraction * np.sqrt(areas)), min_ring, max_ring).astype(np.int64)
    shares = thread_shares(areas)
    windows = np.zeros((len(clusters), 4), np.int64)
    _bound(pixels, order, firsts, widths, *shares, *camera.shape, windows)
    cells = np.concatenate([[0], np.cumsum((windows[:, 2] - windows[:, 0]) * (windows[:, 3] - windows[:, 1]))])
    steps, ring_counts = _signed_distances(pixels, order, firsts, widths, windows, cells, frame.depth, *shares)
    starts = np.concatenate([[0], np.cumsum(areas + ring_counts)])
    points, depth_in_mask, source, radii = _gather(
        pixels, order, firsts, windows, cells, steps, frame.depth, starts, pinhole(camera), *shares
    )
    return Neighborhoods(points, depth_in_mask, source, starts, areas, widths, radii)


@njit(cache=True, nogil=True)
def grouped(cluster: Int32, n: int) -> tuple[Int64, Int64]:
    """The points in the order of their clusters: (members,) indices and (n + 1,) where each cluster begins.

    Within a cluster the points keep their order. Points of no cluster (-1) are left out.
    """
    if np.all(cluster[:-1] <= cluster[1:]):  # as geometry.lift leaves them
        firsts = np.searchsorted(cluster, np.arange(n + 1))
        return np.arange(firsts[0], firsts[n]), firsts - firsts[0]
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


def thread_shares(costs: Int64) -> tuple[Int64, Int64]:
    """Which thread takes which of N clusters: (N,) their order and (threads + 1,) where each thread's share begins.

    Numba cuts a parallel loop into parts of equal length, but a few large clusters have most of the points. Here the
    costliest goes first, to the thread that has least to do (Graham 1969). Clusters do not know of each other, so that
    results do not depend on it.
    """
    order, starts = _longest_first(costs, numba.get_num_threads())
    return order, starts


@njit(cache=True, nogil=True)
def _longest_first(costs: Int64, threads: int) -> tuple[Int64, Int64]:
    loads, owners, starts = np.zeros(threads, np.int64), np.empty(len(costs), np.int64), np.zeros(threads + 1, np.int64)
    for k in np.argsort(-costs, kind="mergesort"):
        owners[k] = np.argmin(loads)
        loads[owners[k]] += costs[k] + 1
    order = np.argsort(owners, kind="mergesort")
    for k in range(len(costs)):
        starts[owners[k] + 1] += 1
    return order, np.cumsum(starts)


def pinhole(camera: Camera) -> Float32:
    """(4,) fx, fy, cx, cy in the precision of geometry.back_project, for kernels."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)


@njit(cache=True, nogil=True)
def _kept(good: Bool, judged: Bool, starts: Int64, mask_counts: Int64, source: Int64, points: int) -> Bool:
    kept = np.ones(points, np.bool_)
    for k in range(len(judged)):
        if judged[k]:
            for s in range(starts[k], starts[k] + mask_counts[k]):
                kept[source[s]] = good[s]
    return kept


@njit(cache=True, nogil=True)
def _every_nth(
    points: Float32, depth_in_mask: Float32, source: Int32, starts: Int64, mask_counts: Int64, max_points: int
) -> tuple[Float32, Float32, Int32, Int64, Int64]:
    n = len(mask_counts)
    thin_starts, thin_mask_counts, steps = np.zeros(n + 1, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
    for k in range(n):
        count = starts[k + 1] - starts[k]
        steps[k] = max((count + max_points - 1) // max_points, 1)
        thin_starts[k + 1] = thin_starts[k] + (count + steps[k] - 1) // steps[k]
        thin_mask_counts[k] = (mask_counts[k] + steps[k] - 1) // steps[k]
    thin_points, thin_depth = np.empty((thin_starts[n], 3), np.float32), np.empty(thin_starts[n], np.float32)
    thin_source = np.empty(thin_starts[n], np.int32)
    for k in range(n):
        for j in range(thin_starts[k + 1] - thin_starts[k]):
            s, i = thin_starts[k] + j, starts[k] + j * steps[k]
            for a in range(3):
                thin_points[s, a] = points[i, a]
            thin_depth[s], thin_source[s] = depth_in_mask[i], source[i]
    return thin_points, thin_depth, thin_source, thin_starts, thin_mask_counts


@njit(cache=True, nogil=True, parallel=True)
def _bound(
    pixels: Int32, order: Int64, firsts: Int64, widths: Int64, share_order: Int64, share_starts: Int64,
    height: int, width: int, windows: Int64,
) -> None:  # fmt: skip
    """Sets (N, 4) v0 u0 v1 u1 (half open): each cluster's bounding box grown by its ring, within the image."""
    for share in prange(len(share_starts) - 1):
        for k in share_order[share_starts[share] : share_starts[share + 1]]:
            if firsts[k] == firsts[k + 1]:
                continue
            v0, u0, v1, u1 = height, width, 0, 0
            for i in order[firsts[k] : firsts[k + 1]]:
                u, v = pixels[i, 0], pixels[i, 1]
                v0, u0, v1, u1 = min(v0, v), min(u0, u), max(v1, v), max(u1, u)
            windows[k, 0], windows[k, 1] = max(v0 - widths[k], 0), max(u0 - widths[k], 0)
            windows[k, 2], windows[k, 3] = min(v1 + widths[k] + 1, height), min(u1 + widths[k] + 1, width)


@njit(cache=True, nogil=True, parallel=True)
def _signed_distances(
    pixels: Int32, order: Int64, firsts: Int64, widths: Int64, windows: Int64, cells: Int64, depth: Float32,
    share_order: Int64, share_starts: Int64,
) -> tuple[Float32, Int64]:  # fmt: skip
    """In every window (cells,) how deep each of the mask's pixels lies in it, and how many readings the ring has.

    Distances are in thirds of a pixel: above 0 in the mask, to the next reading outside; below 0 in the ring, to the
    mask; 0 elsewhere. A pixel without a reading is no border of the mask: holes in the depth are common inside of
    objects.
    """
    steps = np.empty(cells[-1], np.float32)
    ring_counts = np.zeros(len(widths), np.int64)
    for share in prange(len(share_starts) - 1):
        for k in share_order[share_starts[share] : share_starts[share + 1]]:
            if cells[k] < cells[k + 1]:
                ring_counts[k] = _signed_distances_of(
                    pixels, order[firsts[k] : firsts[k + 1]], CHAMFER_STEP * np.float32(widths[k]), windows[k], depth,
                    steps[cells[k] : cells[k + 1]],
                )  # fmt: skip
    return steps, ring_counts


@njit(cache=True, nogil=True)
def _signed_distances_of(
    pixels: Int32, members: Int64, ring: np.float32, window: Int64, depth: Float32, steps: Float32
) -> int:
    v0, u0 = window[0], window[1]
    rows, columns = window[2] - v0, window[3] - u0
    in_mask, in_rest = np.zeros((rows, columns), np.bool_), np.empty((rows, columns), np.bool_)
    to_mask, to_rest = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    for i in members:
        in_mask[pixels[i, 1] - v0, pixels[i, 0] - u0] = True
    for r in range(rows):
        _mark_rest(in_mask[r], depth[v0 + r, u0 : u0 + columns], in_rest[r])
    _chamfer(in_mask, to_mask)
    _chamfer(in_rest, to_rest)
    count = 0
    for r in range(rows):
        count += _sign(
            in_mask[r], to_mask[r], to_rest[r], depth[v0 + r, u0 : u0 + columns], ring,
            steps[r * columns : (r + 1) * columns],
        )  # fmt: skip
    return count


@njit(cache=True, nogil=True)
def _mark_rest(in_mask: Bool, depth: Float32, in_rest: Bool) -> None:
    for c in range(len(in_rest)):
        in_rest[c] = (not in_mask[c]) & (depth[c] > 0)


@njit(cache=True, nogil=True)
def _sign(in_mask: Bool, to_mask: Float32, to_rest: Float32, depth: Float32, ring: np.float32, steps: Float32) -> int:
    """Puts one row of the two distances together; the number of its readings in the ring."""
    count = 0
    for c in range(len(steps)):
        in_ring = (not in_mask[c]) & (to_mask[c] <= ring) & (depth[c] > 0)
        outside = -to_mask[c] if in_ring else np.float32(0)
        steps[c] = to_rest[c] if in_mask[c] else outside
        count += bool(in_ring)
    return count


@njit(cache=True, nogil=True)
def _chamfer(sources: Bool, grid: Float32) -> None:
    """The distance of every cell to the nearest source.

    A shortest way may make its level steps first, all in the row of its source. So those rows are filled by runs, and
    the steps down and up, straight and diagonal, are left to two sweeps in vector code.
    """
    rows = len(grid)
    for r in range(rows):
        _distances_along(sources[r], grid[r])
    for r in range(1, rows):
        _spread_across(grid[r - 1], grid[r])
    for r in range(rows - 2, -1, -1):
        _spread_across(grid[r + 1], grid[r])


@njit(cache=True, nogil=True)
def _distances_along(sources: Bool, row: Float32) -> None:
    """The distance of every cell to the nearest source of its row, FAR without one."""
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
def _fill_gap(gap: Float32, source_before: bool, source_behind: bool) -> None:
    n = np.int32(len(gap))
    for c in range(n):
        left = CHAMFER_STEP * np.float32(np.int32(c) + np.int32(1)) if source_before else FAR
        right = CHAMFER_STEP * np.float32(n - np.int32(c)) if source_behind else FAR
        gap[c] = left if left < right else right


@njit(cache=True, nogil=True)
def _spread_across(neighbors: Float32, row: Float32) -> None:
    n = len(row)
    if n == 1:
        row[0] = min(row[0], neighbors[0] + CHAMFER_STEP)
        return
    row[0] = min(row[0], neighbors[0] + CHAMFER_STEP, neighbors[1] + CHAMFER_DIAGONAL)
    row[n - 1] = min(row[n - 1], neighbors[n - 1] + CHAMFER_STEP, neighbors[n - 2] + CHAMFER_DIAGONAL)
    _lower(row[1 : n - 1], neighbors[: n - 2], neighbors[1 : n - 1], neighbors[2:])


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _lower(row: Float32, before: Float32, across: Float32, behind: Float32) -> None:
    """row = min(row, across + a step, before or behind + a diagonal); without min() and offsets, so it vectorizes."""
    for i in range(len(row)):
        diagonal = (before[i] if before[i] < behind[i] else behind[i]) + CHAMFER_DIAGONAL
        straight = across[i] + CHAMFER_STEP
        nearest = straight if straight < diagonal else diagonal
        row[i] = nearest if nearest < row[i] else row[i]


@njit(cache=True, nogil=True, parallel=True)
def _gather(
    pixels: Int32, order: Int64, firsts: Int64, windows: Int64, cells: Int64, steps: Float32, depth: Float32,
    starts: Int64, pinhole: Float32, share_order: Int64, share_starts: Int64,
) -> tuple[Float32, Float32, Int32, Float32]:  # fmt: skip
    """Points (as geometry.back_project gives them: tested), their depth in the mask, their source; the masks' radii."""
    points = np.empty((starts[-1], 3), np.float32)
    depth_in_mask, source = np.empty(starts[-1], np.float32), np.empty(starts[-1], np.int32)
    radii = np.zeros(len(firsts) - 1, np.float32)
    for share in prange(len(share_starts) - 1):
        for k in share_order[share_starts[share] : share_starts[share + 1]]:
            own = slice(starts[k], starts[k + 1])
            radii[k] = _gather_one(
                pixels, order[firsts[k] : firsts[k + 1]], windows[k], steps[cells[k] : cells[k + 1]], depth, pinhole,
                points[own], depth_in_mask[own], source[own],
            )  # fmt: skip
    return points, depth_in_mask, source, radii


@njit(cache=True, nogil=True)
def _gather_one(
    pixels: Int32, members: Int64, window: Int64, steps: Float32, depth: Float32, pinhole: Float32,
    points: Float32, depth_in_mask: Float32, source: Int32,
) -> np.float32:  # fmt: skip
    v0, u0 = window[0], window[1]
    rows, columns = window[2] - v0, window[3] - u0
    px_per_step = np.float32(1.0) / CHAMFER_STEP
    radius, s = np.float32(0), 0
    for i in members:
        u, v = pixels[i, 0], pixels[i, 1]
        _back_project(u, v, depth[v, u], pinhole, points, s)
        depth_in_mask[s] = px_per_step * steps[(v - v0) * columns + u - u0]
        radius = max(radius, depth_in_mask[s])
        source[s] = i
        s += 1
    for r in range(rows):
        for c in range(columns):
            if steps[r * columns + c] < 0:
                _back_project(u0 + c, v0 + r, depth[v0 + r, u0 + c], pinhole, points, s)
                depth_in_mask[s] = px_per_step * steps[r * columns + c]
                source[s] = -1
                s += 1
    return radius


@njit(cache=True, nogil=True)
def _back_project(u: int, v: int, z: np.float32, pinhole: Float32, points: Float32, s: int) -> None:
    points[s, 0] = np.float32(u - pinhole[2]) * (z / pinhole[0])
    points[s, 1] = np.float32(v - pinhole[3]) * (z / pinhole[1])
    points[s, 2] = z
