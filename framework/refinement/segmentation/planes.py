"""The large planes of a depth image, by region growing on a coarse grid of cells.

The idea of PEAC (Feng, Taguchi and Kamat, "Fast Plane Extraction in Organized Point Clouds Using Agglomerative
Hierarchical Clustering", ICRA 2014) and CAPE (Proenca and Gao, "Fast Cylinder and Plane Extraction from Depth Cameras
for Visual Odometry", IROS 2018), with fits in inverse depth. Of a plane n . p = d a camera reads the inverse depth
q = 1 / z = m . r, where r = ((u - cx) / fx, (v - cy) / fy, 1) and m = n / d. That is linear in the pixel: a fit is a
3x3 system, the fit of a union of cells comes from the sum of their moments, and the noise of stereo and
structured-light sensors, which grows with z^2, is the same everywhere. Open3D's RANSAC finds one plane at a time, by
chance, in a cloud that has forgotten the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Bool, Float32, Float64, Frame, Int64, UInt8
from framework.refinement.neighborhood import pinhole

CELL = 16  # px a side: 9 cm at 3 m and 540 px focal length, smaller than what should count as a plane
STEP = 2  # px between the readings of a cell that are looked at
FULL = (CELL // STEP) ** 2  # of them in a whole cell
REFITS = 3  # passes that collect the cells of a plane anew; it hardly moves in the last
TRIM = 1.5  # times the median deviation of a plane's cells: what lies worse is left out of the fit
SIGMAS = 3.0  # standard deviations of the noise that a reading may lie off its plane
MAX_PLANES = 32  # more than a frame has large ones


@dataclass(frozen=True)
class Planes:
    """The K planes found in one frame, in the order in which they were found."""

    m: Float64  # (K, 3) 1/m, normal over distance: a point p in camera coordinates is on plane k where m . p = 1
    deviations: Float64  # (K,) 1/m, rms of its readings' inverse depth around it, at most the noise allowed
    areas: Float64  # (K,) m^2, of what is seen of it
    shares: Float64  # (K,) of the frame's readings
    behind: Float64  # (K,) readings on the far side of it, over readings on it

    def __len__(self) -> int:
        return len(self.m)

    @property
    def normals(self) -> Float64:
        """(K, 3) in camera coordinates, unit length, towards the camera."""
        return np.asarray(-self.m / np.linalg.norm(self.m, axis=1, keepdims=True))

    def chosen(self, which: Bool) -> Planes:
        """The planes where `which` (K,) is True."""
        return Planes(*(values[which] for values in vars(self).values()))


def find_planes(frame: Frame, distance: float, noise: float, min_area: float) -> Planes:
    """The planes of which at least `min_area` m^2 are seen in the frame, a quarter of it in one piece.

    A cell of 16x16 px belongs to a plane when its readings lie around it with an rms of at most `distance` (m, along
    the normal) for what is not flat plus `noise` (1/m, of inverse depth, so `noise` * z^2 m at depth z) for the sensor.
    A plane begins at the flattest cell that is left, grows over neighboring cells and then takes all cells of the frame
    that lie in it: what stands before a wall does not cut it in two.
    """
    height, width = frame.camera.shape
    moments = np.zeros(((height + CELL - 1) // CELL, (width + CELL - 1) // CELL, 10))
    _sum_moments(frame.depth, pinhole(frame.camera), moments)
    cells = moments.reshape(-1, 10)
    flatness = np.full(len(cells), np.inf)
    _write_flatness(cells, distance, noise, flatness)
    free = flatness < np.inf
    seeds = np.argsort(flatness, kind="stable")[: free.sum()]
    pixel_size = 1.0 / math.sqrt(frame.camera.fx * frame.camera.fy)
    found = np.empty((MAX_PLANES, 7))
    count = _find(cells, moments.shape[1], seeds, free, distance, noise, min_area, STEP * pixel_size, found)
    return Planes(found[:count, :3].copy(), *found[:count, 3:].T.copy())


def plane_image(frame: Frame, planes: Planes, distance: float) -> UInt8:
    """(H, W) 1 + the plane on which each reading lies, 0 = on none; of several the nearest.

    A reading is on a plane within `distance` (m, along the normal) and three standard deviations of the noise, which
    the plane's own readings tell.
    """
    image = np.zeros(frame.depth.shape, np.uint8)
    if len(planes):
        lengths = np.linalg.norm(planes.m, axis=1)
        _label(
            frame.depth, pinhole(frame.camera), planes.m.astype(np.float32), lengths.astype(np.float32),
            (distance * lengths).astype(np.float32), (SIGMAS * planes.deviations).astype(np.float32), image,
        )  # fmt: skip
    return image


@njit(cache=True, nogil=True, parallel=True)
def _sum_moments(depth: Float32, pinhole: Float32, moments: Float64) -> None:
    """(rows, columns, 10) of each cell: the sums of 1, x, y, x x, x y, y y, q, x q, y q, q q over its readings."""
    height, width = depth.shape
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    for row in prange(moments.shape[0]):
        for column in range(moments.shape[1]):
            n, sx, sy, sxx, sxy, syy, sq, sxq, syq, sqq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for v in range(row * CELL, min((row + 1) * CELL, height), STEP):
                y = (v - cy) / fy
                for u in range(column * CELL, min((column + 1) * CELL, width), STEP):
                    if depth[v, u] > 0:
                        x, q = (u - cx) / fx, 1.0 / depth[v, u]
                        n += 1.0
                        sx += x
                        sy += y
                        sxx += x * x
                        sxy += x * y
                        syy += y * y
                        sq += q
                        sxq += x * q
                        syq += y * q
                        sqq += q * q
            cell = moments[row, column]
            cell[0], cell[1], cell[2], cell[3], cell[4] = n, sx, sy, sxx, sxy
            cell[5], cell[6], cell[7], cell[8], cell[9] = syy, sq, sxq, syq, sqq


@njit(cache=True, nogil=True)
def _solve(moment: Float64, m: Float64) -> bool:
    """Sets m to the least-squares plane of the readings, by Cramer's rule; False where they do not tell one.

    The normal equations are centered: x and y of one cell vary by a hundredth of their size.
    """
    n = moment[0]
    if n < 3:
        return False
    x, y, q = moment[1] / n, moment[2] / n, moment[6] / n
    xx, xy, yy = moment[3] / n - x * x, moment[4] / n - x * y, moment[5] / n - y * y
    xq, yq = moment[7] / n - x * q, moment[8] / n - y * q
    determinant = xx * yy - xy * xy
    if determinant <= 1e-9 * xx * yy:
        return False
    m[0] = (xq * yy - yq * xy) / determinant
    m[1] = (yq * xx - xq * xy) / determinant
    m[2] = q - m[0] * x - m[1] * y
    return True


@njit(cache=True, nogil=True)
def _deviation(moment: Float64, m: Float64) -> float:
    """The rms of q - m . r over the readings, 1/m."""
    n, sx, sy, sxx, sxy = moment[0], moment[1], moment[2], moment[3], moment[4]
    syy, sq, sxq, syq, sqq = moment[5], moment[6], moment[7], moment[8], moment[9]
    a, b, c = m[0], m[1], m[2]
    linear = a * sxq + b * syq + c * sq
    quadratic = a * a * sxx + b * b * syy + c * c * n + 2.0 * (a * b * sxy + a * c * sx + b * c * sy)
    return math.sqrt(max(sqq - 2.0 * linear + quadratic, 0.0) / n)


@njit(cache=True, nogil=True)
def _length(m: Float64) -> float:
    return math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])


@njit(cache=True, nogil=True)
def _lies_in(moment: Float64, m: Float64, distance: float, noise: float) -> bool:
    """A point at inverse depth q is |q - m . r| / (|m| q) m off the plane."""
    return bool(_deviation(moment, m) <= noise + distance * _length(m) * moment[6] / moment[0])


@njit(cache=True, nogil=True)
def _area(moment: Float64, m: Float64, spacing: float) -> float:
    """m^2 of the plane that the cell's readings stand for: each for spacing^2 z^2 / |n . r| = spacing^2 |m| z^3."""
    n = moment[0]
    z = n / moment[6]
    return float(n * spacing * spacing * _length(m) * z * z * z)


@njit(cache=True, nogil=True)
def _write_flatness(cells: Float64, distance: float, noise: float, flatness: Float64) -> None:
    """Writes the deviation of each cell (C, 10) that is full and flat enough to begin a plane."""
    m = np.zeros(3)
    for i in range(len(cells)):
        if 2 * cells[i, 0] >= FULL and _solve(cells[i], m) and _lies_in(cells[i], m, distance, noise):
            flatness[i] = _deviation(cells[i], m)


@njit(cache=True, nogil=True)
def _find(
    cells: Float64, columns: int, seeds: Int64, free: Bool, distance: float, noise: float, min_area: float,
    spacing: float, found: Float64,
) -> int:  # fmt: skip
    """Writes m, deviation, area, share and what is behind of each plane; how many there are. `free` is used up."""
    m, total = np.zeros(3), np.zeros(10)
    tried = np.zeros(len(cells), np.bool_)
    readings = 0.0
    for i in range(len(cells)):
        readings += cells[i, 0]
    k = 0
    region, deviations = np.empty(len(cells), np.int64), np.empty(len(cells))
    for seed in seeds:
        if not free[seed] or tried[seed] or k == MAX_PLANES:
            continue
        size = _grow(cells, columns, seed, free, distance, noise, m, region)
        area = 0.0
        for j in range(size):
            i = region[j]
            tried[i] = True
            area += _area(cells[i], m, spacing)
        if 4 * area < min_area:
            continue
        for a in range(10):
            total[a] = 0.0
        for _ in range(REFITS):
            _collect(cells, free, m, distance, noise, deviations)
            _refit(cells, deviations, m, total)
        _collect(cells, free, m, distance, noise, deviations)
        area, count = 0.0, 0.0
        for i in range(len(cells)):
            if deviations[i] < np.inf:
                area += _area(cells[i], m, spacing)
                count += cells[i, 0]
        if area < min_area or total[0] == 0:
            continue
        for i in range(len(cells)):
            free[i] = free[i] and deviations[i] == np.inf
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = m[0], m[1], m[2], min(_deviation(total, m), noise)
        found[k, 4], found[k, 5] = area, count / readings
        found[k, 6] = _readings_behind(cells, m, found[k, 3], distance) / count
        k += 1
    return k


@njit(cache=True, nogil=True)
def _grow(
    cells: Float64, columns: int, seed: int, free: Bool, distance: float, noise: float, m: Float64, region: Int64
) -> int:
    """Fills `region` with the cells that hang together with the seed in one plane, and m with the plane; their number.

    The plane is fitted again with every cell that comes in.
    """
    seen = np.zeros(len(cells), np.bool_)
    total = np.zeros(10)
    for a in range(10):
        total[a] = cells[seed, a]
    _solve(total, m)
    region[0], seen[seed] = seed, True
    size, done = 1, 0
    while done < size:
        i = region[done]
        done += 1
        row, column = i // columns, i % columns
        for j, exists in (
            (i - columns, row > 0),
            (i - 1, column > 0),
            (i + 1, column < columns - 1),
            (i + columns, i + columns < len(cells)),
        ):
            if exists and free[j] and not seen[j]:
                seen[j] = True
                if _lies_in(cells[j], m, distance, noise):
                    region[size] = j
                    size += 1
                    for a in range(10):
                        total[a] += cells[j, a]
                    _solve(total, m)
    return size


@njit(cache=True, nogil=True)
def _collect(cells: Float64, free: Bool, m: Float64, distance: float, noise: float, deviations: Float64) -> None:
    """Sets the deviation of each free cell that lies in the plane, infinity for all others."""
    slope = distance * _length(m)
    for i in range(len(cells)):
        deviations[i] = np.inf
        if free[i]:
            deviation = _deviation(cells[i], m)
            if deviation <= noise + slope * cells[i, 6] / cells[i, 0]:
                deviations[i] = deviation


@njit(cache=True, nogil=True)
def _refit(cells: Float64, deviations: Float64, m: Float64, total: Float64) -> None:
    """The plane of the cells that lie best in m, and the sum of their moments: at least half of those that lie in it.

    The others are cells across the line where two planes meet, which would tilt both towards each other.
    """
    inside, count = np.empty(len(deviations)), 0
    for i in range(len(deviations)):
        if deviations[i] < np.inf:
            inside[count] = deviations[i]
            count += 1
    if count == 0:
        return
    inside, middle = inside[:count], count // 2
    upper = _order(inside, middle)
    bound = TRIM * (upper if count % 2 else (_order(inside, middle - 1) + upper) / 2)
    best = np.zeros(10)
    for i in range(len(cells)):
        if deviations[i] <= bound:
            for a in range(10):
                best[a] += cells[i, a]
    if _solve(best, m):
        for a in range(10):
            total[a] = best[a]


@njit(cache=True, nogil=True)
def _order(values: Float64, k: int) -> float:
    """The k-th smallest value; moves the values (Hoare 1961, "Find"). np.median takes longer to compile."""
    first, last = 0, len(values) - 1
    while first < last:
        pivot = values[(first + last) // 2]
        i, j = first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if k <= j:
            last = j
        elif k >= i:
            first = i
        else:
            break
    return float(values[k])


@njit(cache=True, nogil=True)
def _readings_behind(cells: Float64, m: Float64, deviation: float, distance: float) -> float:
    """Readings of the cells whose mean lies on the far side of the plane, clear of it."""
    behind = 0.0
    for i in range(len(cells)):
        n = cells[i, 0]
        if n > 0:
            q = cells[i, 6] / n
            expected = (m[0] * cells[i, 1] + m[1] * cells[i, 2]) / n + m[2]
            if expected - q > SIGMAS * (deviation + distance * _length(m) * q):
                behind += n
    return behind


@njit(cache=True, nogil=True, parallel=True)
def _label(
    depth: Float32, pinhole: npt.NDArray[np.float32], m: Float32, lengths: Float32, reach: Float32, sigmas: Float32,
    image: UInt8,
) -> None:  # fmt: skip
    fx, fy, cx, cy = pinhole
    for v in prange(depth.shape[0]):
        y = np.float32(v - cy) / fy
        nearest = np.full(depth.shape[1], np.float32(np.inf))
        for k in range(len(m)):
            a, b = m[k, 0] / fx, m[k, 1] * y + m[k, 2] - m[k, 0] * cx / fx
            for u in range(depth.shape[1]):
                z = depth[v, u]
                off = abs(z * (a * np.float32(u) + b) - np.float32(1.0))
                if z > 0 and off <= reach[k] + sigmas[k] * z and off < nearest[u] * lengths[k]:
                    nearest[u] = off / lengths[k]
                    image[v, u] = k + 1
