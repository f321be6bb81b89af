"""Each mask's points together with a ring of points around the mask: what tells an object from its background."""

from __future__ import annotations

from dataclasses import dataclass

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
    source: Int64  # (S,) index of the cluster's point in the PointClusters, -1 for a point of the ring
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

    @property
    def owner(self) -> Int64:
        """(S,) the neighborhood that each point is in."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def kept(self, good: Bool, judged: Bool, points: int) -> Bool:
        """(`points`,) which points of the PointClusters stay: the `good` (S,) ones of clusters that were `judged` (N,).

        Points of clusters that were not judged stay, and so do those of no cluster.
        """
        return np.asarray(_kept(good, judged, self.starts, self.mask_counts, self.source, points), np.bool_)

    def thinned(self, max_points: int) -> Neighborhoods:
        """Every n-th point of each neighborhood, n chosen so that at most `max_points` are left of it."""
        counts = np.diff(self.starts)
        chosen, starts, mask_counts = _every_nth(self.starts, self.mask_counts, -(-counts // max_points))
        return Neighborhoods(
            self.points_camera[chosen],
            self.depth_in_mask[chosen],
            self.source[chosen],
            starts,
            mask_counts,
            self.ring_widths,
            self.mask_radii,
        )


def neighborhoods(
    clusters: PointClusters, frame: Frame, ring_fraction: float, min_ring: int, max_ring: int
) -> Neighborhoods:
    """The N clusters of one frame with their rings, in camera coordinates.

    A ring holds the pixels that have a depth reading, are not in the cluster themselves and lie within
    `ring_fraction` * sqrt(points in the cluster) px of it, bounded to [`min_ring`, `max_ring`] px. Pixels of other
    clusters belong to it like any other; those of known structure are as if they had no reading: they need not be told
    from the object any more, and are no border to it. `max_ring` is at most MAX_RING_WIDTH.
    """
    camera, pixels = frame.camera, clusters.pixels
    depth = frame.depth if clusters.structure is None else np.where(clusters.structure, np.float32(0), frame.depth)
    order, firsts = grouped(clusters.cluster, len(clusters))
    areas = np.diff(firsts)
    widths = np.clip(np.rint(ring_fraction * np.sqrt(areas)), min_ring, max_ring).astype(np.int64)
    windows = _windows(pixels, order, firsts, widths, *camera.shape)
    cells = np.concatenate([[0], np.cumsum((windows[:, 2] - windows[:, 0]) * (windows[:, 3] - windows[:, 1]))])
    outside, inside, ring_counts = _distances(pixels, order, firsts, widths, windows, cells, depth)
    starts = np.concatenate([[0], np.cumsum(areas + ring_counts)])
    points, depth_in_mask, source, radii = _gather(
        pixels, order, firsts, widths, windows, cells, outside, inside, depth, starts, pinhole(camera)
    )
    return Neighborhoods(points, depth_in_mask, source, starts, areas, widths, radii)


@njit(cache=True, nogil=True)
def grouped(cluster: Int32, n: int) -> tuple[Int64, Int64]:
    """The points in the order of their clusters: (members,) indices and (n + 1,) where each cluster begins.

    Within a cluster the points keep their order. Points of no cluster (-1) are left out.
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
def _every_nth(starts: Int64, mask_counts: Int64, steps: Int64) -> tuple[Int64, Int64, Int64]:
    n = len(steps)
    thin_starts, thin_mask_counts = np.zeros(n + 1, np.int64), np.zeros(n, np.int64)
    for k in range(n):
        step = max(steps[k], 1)
        thin_starts[k + 1] = thin_starts[k] + (starts[k + 1] - starts[k] + step - 1) // step
        thin_mask_counts[k] = (mask_counts[k] + step - 1) // step
    chosen = np.empty(thin_starts[n], np.int64)
    for k in range(n):
        for j in range(thin_starts[k + 1] - thin_starts[k]):
            chosen[thin_starts[k] + j] = starts[k] + j * max(steps[k], 1)
    return chosen, thin_starts, thin_mask_counts


@njit(cache=True, nogil=True)
def _windows(pixels: Int32, order: Int64, firsts: Int64, widths: Int64, height: int, width: int) -> Int64:
    """(N, 4) v0 u0 v1 u1 (half open): each cluster's bounding box grown by its ring, within the image."""
    n = len(widths)
    windows = np.zeros((n, 4), np.int64)
    for k in range(n):
        if firsts[k] == firsts[k + 1]:
            continue
        v0, u0, v1, u1 = height, width, 0, 0
        for i in order[firsts[k] : firsts[k + 1]]:
            u, v = pixels[i, 0], pixels[i, 1]
            v0, u0, v1, u1 = min(v0, v), min(u0, u), max(v1, v), max(u1, u)
        windows[k, 0], windows[k, 1] = max(v0 - widths[k], 0), max(u0 - widths[k], 0)
        windows[k, 2], windows[k, 3] = min(v1 + widths[k] + 1, height), min(u1 + widths[k] + 1, width)
    return windows


@njit(cache=True, nogil=True, parallel=True)
def _distances(
    pixels: Int32, order: Int64, firsts: Int64, widths: Int64, windows: Int64, cells: Int64, depth: Float32
) -> tuple[Float32, Float32, Int64]:
    """In every window (cells,) the distance to the mask and that to what is not the mask, and the ring's readings.

    Distances are in thirds of a pixel. A pixel without a reading is no border of the mask: holes in the depth are
    common inside of objects.
    """
    n = len(widths)
    outside, inside = np.full(cells[n], FAR), np.full(cells[n], FAR)
    ring_counts = np.zeros(n, np.int64)
    for k in prange(n):
        v0, u0 = windows[k, 0], windows[k, 1]
        rows, columns = windows[k, 2] - v0, windows[k, 3] - u0
        to_mask = outside[cells[k] : cells[k + 1]].reshape((rows, columns))
        to_rest = inside[cells[k] : cells[k + 1]].reshape((rows, columns))
        for i in order[firsts[k] : firsts[k + 1]]:
            to_mask[pixels[i, 1] - v0, pixels[i, 0] - u0] = 0
        for r in range(rows):
            for c in range(columns):
                if to_mask[r, c] > 0 and depth[v0 + r, u0 + c] > 0:
                    to_rest[r, c] = 0
        if rows > 0:
            _chamfer(to_mask)
            _chamfer(to_rest)
        count = 0
        for r in range(rows):
            for c in range(columns):
                if 0 < to_mask[r, c] <= CHAMFER_STEP * widths[k] and depth[v0 + r, u0 + c] > 0:
                    count += 1
        ring_counts[k] = count
    return outside, inside, ring_counts


@njit(cache=True, nogil=True)
def _chamfer(grid: Float32) -> None:
    """Spreads the distance from the cells that are 0, down the grid and up again."""
    rows = grid.shape[0]
    _spread_right(grid[0])
    for r in range(1, rows):
        _spread_across(grid[r - 1], grid[r])
        _spread_right(grid[r])
    _spread_left(grid[rows - 1])
    for r in range(rows - 2, -1, -1):
        _spread_across(grid[r + 1], grid[r])
        _spread_left(grid[r])


@njit(cache=True, nogil=True)
def _spread_across(neighbors: Float32, row: Float32) -> None:
    _lower(row, neighbors, CHAMFER_STEP)
    _lower(row[:-1], neighbors[1:], CHAMFER_DIAGONAL)
    _lower(row[1:], neighbors[:-1], CHAMFER_DIAGONAL)


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _lower(values: Float32, others: Float32, step: np.float32) -> None:
    """values = min(values, others + step); without min() and without offsets in indices, so that it vectorizes."""
    for i in range(len(values)):
        other = others[i] + step
        values[i] = other if other < values[i] else values[i]


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _spread_right(row: Float32) -> None:
    nearest = FAR
    for c in range(len(row)):
        nearest += CHAMFER_STEP
        nearest = row[c] if row[c] < nearest else nearest
        row[c] = nearest


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _spread_left(row: Float32) -> None:
    nearest = FAR
    for c in range(len(row) - 1, -1, -1):
        nearest += CHAMFER_STEP
        nearest = row[c] if row[c] < nearest else nearest
        row[c] = nearest


@njit(cache=True, nogil=True, parallel=True)
def _gather(
    pixels: Int32, order: Int64, firsts: Int64, widths: Int64, windows: Int64, cells: Int64,
    outside: Float32, inside: Float32, depth: Float32, starts: Int64, pinhole: Float32,
) -> tuple[Float32, Float32, Int64, Float32]:  # fmt: skip
    """Points (as geometry.back_project gives them: tested), their depth in the mask, their source; the masks' radii."""
    n = len(widths)
    points = np.empty((starts[n], 3), np.float32)
    depth_in_mask = np.empty(starts[n], np.float32)
    source = np.full(starts[n], -1, np.int64)
    radii = np.zeros(n, np.float32)
    px_per_step = np.float32(1.0) / CHAMFER_STEP
    for k in prange(n):
        v0, u0 = windows[k, 0], windows[k, 1]
        rows, columns = windows[k, 2] - v0, windows[k, 3] - u0
        to_mask = outside[cells[k] : cells[k + 1]].reshape((rows, columns))
        to_rest = inside[cells[k] : cells[k + 1]].reshape((rows, columns))
        s = starts[k]
        for i in order[firsts[k] : firsts[k + 1]]:
            u, v = pixels[i, 0], pixels[i, 1]
            _back_project(u, v, depth[v, u], pinhole, points[s])
            depth_in_mask[s] = px_per_step * to_rest[v - v0, u - u0]
            source[s] = i
            radii[k] = max(radii[k], depth_in_mask[s])
            s += 1
        for r in range(rows):
            for c in range(columns):
                z = depth[v0 + r, u0 + c]
                if 0 < to_mask[r, c] <= CHAMFER_STEP * widths[k] and z > 0:
                    _back_project(u0 + c, v0 + r, z, pinhole, points[s])
                    depth_in_mask[s] = -px_per_step * to_mask[r, c]
                    s += 1
    return points, depth_in_mask, source, radii


@njit(cache=True, nogil=True)
def _back_project(u: int, v: int, z: np.float32, pinhole: Float32, point: Float32) -> None:
    point[0] = np.float32(u - pinhole[2]) * (z / pinhole[0])
    point[1] = np.float32(v - pinhole[3]) * (z / pinhole[1])
    point[2] = z
