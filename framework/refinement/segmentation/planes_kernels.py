"""Kernels of planes.py."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Float64, Int32, Int64, UInt8
from framework.refinement.refine_kernels import PART
from framework.sensors.noise_models import DepthNoise
from framework.sensors.noise_models_kernels import noise_ratio

CELL = 16  # side of a cell, px: 9 cm at 3 m and 540 px focal length, smaller than a relevant plane
STEP = 2  # stride of the readings used in a cell, px
FULL = (CELL // STEP) ** 2  # number of readings in a full cell
REFITS = 3  # number of passes that collect the cells of a plane again; the last pass hardly changes the plane
TRIM = 1.5  # maximum deviation of a cell in a fit, relative to the median deviation of all cells on the plane
SIGMAS = 3.0  # maximum distance of a reading on a plane, in standard deviations of the noise
MAX_PLANES = 32  # maximum number of planes; frames have fewer large planes


@njit(cache=True, nogil=True, parallel=True)
def sum_moments(depth: Float32, pinhole: Float32, moments: Float64) -> None:
    """Compute the moments (rows, columns, 10) of the depth readings in each cell.

    The moments are the sums of 1, x, y, x x, x y, y y, q, x q, y q, q q over the readings. Here, x = (u - cx) / fx, y =
    (v - cy) / fy, and q is the inverse depth, 1/m. `pinhole` contains fx, fy, cx, cy, px.
    """
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
    """Fit a plane (3,) to readings by least squares, and return False if there is no unique plane."""
    # centered normal equations, because x and y vary only little within a cell; solved by Cramer's rule
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
    """Return the root mean square deviation of readings from a plane in inverse depth, 1/m, given their moments."""
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
def _allowed(moment: Float64, noise: float, sensor: DepthNoise) -> float:
    """Return the maximum rms deviation of a cell from a plane in inverse depth, 1/m."""
    # at least the noise of KINECT_V1, because real floors and walls are not flat
    return float(noise * max(noise_ratio(moment[0] / moment[6], sensor), 1.0))


@njit(cache=True, nogil=True)
def _lies_in(moment: Float64, m: Float64, distance: float, noise: float, sensor: DepthNoise) -> bool:
    """Return True if a cell is on the plane."""
    allowed = _allowed(moment, noise, sensor)
    # the distance at inverse depth q is |q - m . r| / (|m| q)
    return bool(_deviation(moment, m) <= allowed + distance * _length(m) * moment[6] / moment[0])


@njit(cache=True, nogil=True)
def _area(moment: Float64, m: Float64, spacing: float) -> float:
    """Return the area of a cell on the plane, m^2."""
    n = moment[0]
    z = n / moment[6]
    # a reading covers spacing^2 z^2 / |n . r| = spacing^2 |m| z^3
    return float(n * spacing * spacing * _length(m) * z * z * z)


@njit(cache=True, nogil=True)
def write_flatness(cells: Float64, distance: float, noise: float, sensor: DepthNoise, flatness: Float64) -> None:
    """Compute the rms deviation (C,) of each cell that can start a plane, in inverse depth, 1/m.

    A cell can start a plane if it is flat and has at least half of its readings. The entries of other cells are not
    changed.
    """
    m = np.zeros(3)
    for i in range(len(cells)):
        if 2 * cells[i, 0] >= FULL and _solve(cells[i], m) and _lies_in(cells[i], m, distance, noise, sensor):
            flatness[i] = _deviation(cells[i], m)


@njit(cache=True, nogil=True)
def find_plane_cells(
    cells: Float64, columns: int, seeds: Int64, free: Bool, distance: float, noise: float, sensor: DepthNoise,
    min_area: float, spacing: float, found: Float64,
) -> int:  # fmt: skip
    """Find the planes of a frame, and return their number.

    See find_planes() for the method.

    Args:
        cells: The moments (C, 10) of the cells, row by row.
        columns: The number of cells per row.
        seeds: The cells that can start a plane, flattest first.
        free: The cells (C,) that belong to no plane, modified in place.
        distance: The maximum rms distance of a cell from the plane, m, in addition to the noise.
        noise: The noise of inverse depth for KINECT_V1, 1/m.
        sensor: The noise parameters of the sensor.
        min_area: The minimum visible area of a plane, m^2.
        spacing: The distance between neighboring readings at a depth of 1 m, m.
        found: The output (MAX_PLANES, 7): m (3), deviation, area, fraction and behind, as in Planes.
    """
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
        size = _grow(cells, columns, seed, free, distance, noise, sensor, m, region)
        area = 0.0
        for j in range(size):
            i = region[j]
            tried[i] = True
            area += _area(cells[i], m, spacing)
        if 4 * area < min_area:
            continue
        total[:] = 0.0
        for _ in range(REFITS):
            _collect(cells, free, m, distance, noise, sensor, deviations)
            _refit(cells, deviations, m, total)
        _collect(cells, free, m, distance, noise, sensor, deviations)
        area, count = 0.0, 0.0
        for i in range(len(cells)):
            if deviations[i] < np.inf:
                area += _area(cells[i], m, spacing)
                count += cells[i, 0]
        if area < min_area or total[0] == 0:
            continue
        for i in range(len(cells)):
            free[i] = free[i] and deviations[i] == np.inf
        found[k, 0], found[k, 1], found[k, 2] = m[0], m[1], m[2]
        found[k, 3] = min(_deviation(total, m), _allowed(total, noise, sensor))
        found[k, 4], found[k, 5] = area, count / readings
        found[k, 6] = _readings_behind(cells, m, found[k, 3], distance) / count
        k += 1
    return k


@njit(cache=True, nogil=True)
def _grow(
    cells: Float64, columns: int, seed: int, free: Bool, distance: float, noise: float, sensor: DepthNoise, m: Float64,
    region: Int64,
) -> int:  # fmt: skip
    """Grow a plane from a cell, and return the number of its cells.

    The plane (3,) is written to `m`, and its cells to `region`. The plane is refitted after each added cell.
    """
    seen, total = np.zeros(len(cells), np.bool_), cells[seed].copy()
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
                if _lies_in(cells[j], m, distance, noise, sensor):
                    region[size] = j
                    size += 1
                    for a in range(10):
                        total[a] += cells[j, a]
                    _solve(total, m)
    return size


@njit(cache=True, nogil=True)
def _collect(
    cells: Float64, free: Bool, m: Float64, distance: float, noise: float, sensor: DepthNoise, deviations: Float64
) -> None:
    """Compute the rms deviation (C,) of each free cell on the plane, infinity for all other cells."""
    slope = distance * _length(m)
    for i in range(len(cells)):
        deviations[i] = np.inf
        if free[i]:
            deviation = _deviation(cells[i], m)
            if deviation <= _allowed(cells[i], noise, sensor) + slope * cells[i, 6] / cells[i, 0]:
                deviations[i] = deviation


@njit(cache=True, nogil=True)
def _refit(cells: Float64, deviations: Float64, m: Float64, total: Float64) -> None:
    """Refit a plane to its best-fitting cells, and set `total` (10,) to their moments."""
    # Use the cells with at most TRIM times the median deviation. The others are at the intersection of two planes and
    # would tilt the planes toward each other.
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
        total[:] = best


@njit(cache=True, nogil=True)
def _order(values: Float64, k: int) -> float:
    """Return the value with index k in ascending order, and reorder the values."""
    # Hoare's selection algorithm (1961), because np.median compiles slowly
    low, high = 0, len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(values[k])


@njit(cache=True, nogil=True)
def _readings_behind(cells: Float64, m: Float64, deviation: float, distance: float) -> float:
    """Return the number of readings in cells that are clearly behind the plane."""
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
def label_points(
    depth: Float32, pinhole: Float32, m: Float32, lengths: Float32, reach: Float32, sigmas: Float32,
    image: UInt8,
) -> None:  # fmt: skip
    """Set `image` (H, W) to 1 + the index of the nearest plane of each depth reading on a plane.

    A reading at depth z is on plane k if |z m . r - 1| <= reach[k] + sigmas[k] z; see planes.py.

    Args:
        depth: The depth image (H, W), m.
        pinhole: The intrinsics fx, fy, cx, cy, px.
        m: The planes (K, 3), 1/m.
        lengths: The norms (K,) of `m`, 1/m.
        reach: The maximum distance (K,), relative to the distance of the plane.
        sigmas: The maximum noise (K,) of inverse depth, 1/m.
        image: The output (H, W).
    """
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


@njit(cache=True, nogil=True, parallel=True)
def find_off_planes(
    cluster: Int32, pixels: Int32, on_plane: UInt8, max_own: float, counts: Int64, stays: Bool, structure: Bool
) -> Bool:
    """Return a Boolean array (P,), True for the points to keep.

    See off_planes().

    Args:
        cluster: The cluster (P,) of each point, -1 = none.
        pixels: The pixels (P, 2), u and v, of the points.
        on_plane: The plane (H, W) of each pixel, 0 = none.
        max_own: The maximum fraction of the readings of a plane that is removed from a cluster.
        counts: The number of points by cluster and plane (parts, N + 1, K + 1), initially 0.
        stays: The pairs of cluster and plane (N + 1, K + 1) whose points are kept, initially True.
        structure: The pixels (H, W) on planes, set to False at kept points.
    """
    labels, kept = np.empty(len(cluster), np.uint8), np.empty(len(cluster), np.bool_)
    for part in prange(len(counts)):
        own = slice(part * PART, (part + 1) * PART)
        _count_on_planes(cluster[own], pixels[own], on_plane, labels[own], counts[part])
    _judge(counts, on_plane, max_own, stays)
    for i in prange(len(cluster)):
        kept[i] = stays[cluster[i], labels[i]]
        if kept[i] and cluster[i] >= 0 and labels[i] > 0:
            structure[pixels[i, 1], pixels[i, 0]] = False
    return kept


@njit(cache=True, nogil=True)
def _judge(counts: Int64, on_plane: UInt8, max_own: float, stays: Bool) -> None:
    """Decide for each cluster and plane whether the points are kept."""
    # points that belong to no cluster (last row) or to no plane (column 0) are always kept
    parts, rows, columns = counts.shape
    for label in range(1, columns):
        most = max_own * _count(on_plane.ravel(), label)
        for k in range(rows - 1):
            own = 0
            for part in range(parts):
                own += counts[part, k, label]
            stays[k, label] = own > most


@njit(cache=True, nogil=True)
def _count_on_planes(cluster: Int32, pixels: Int32, on_plane: UInt8, labels: UInt8, counts: Int64) -> None:
    """Count the points by cluster and plane, and set `labels` to the plane of each point, 0 = none."""
    k, label, count = 0, 0, 0
    for i in range(len(cluster)):  # count runs of equal labels, to avoid a write for each point
        labels[i] = on_plane[pixels[i, 1], pixels[i, 0]]
        if labels[i] != label or cluster[i] != k:
            counts[k, label] += count
            k, label, count = cluster[i], labels[i], 0
        count += 1
    counts[k, label] += count


@njit(cache=True, nogil=True)
def _count(labels: UInt8, label: int) -> int:
    wanted, count = np.uint8(label), 0
    for begin in range(0, len(labels), 128):  # a byte counter vectorizes best
        some = np.uint8(0)
        for found in labels[begin : begin + 128]:
            some += np.uint8(found == wanted)
        count += int(some)
    return count
