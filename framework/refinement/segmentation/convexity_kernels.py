"""Kernels of convexity.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Int32
from framework.refinement.mixtures.gaussian import SIMD
from framework.refinement.segmentation.union_find import root, unite
from framework.sensors.noise_models_kernels import axial_sigma, axial_sigma_single

MIN_CELLS = 6  # minimum number of cells of a plane fit; any three cells fit a plane exactly
MIN_SPREAD = 0.1  # minimum determinant of the covariance of the positions in a window, cells^4; 0 for a line
SWITCH = 1.5  # minimum factor by which an adjacent window must fit better than the window of the cell
STRIP = 16  # number of rows of cells in a strip; strips are connected in parallel


class Noise(NamedTuple):
    """Noise limits.

    The tuple is flat because parallel kernels do not accept nested tuples.
    """

    factor: float  # depth difference that counts as noise, standard deviations
    min_noise: float  # minimum standard deviation of depth, m
    least: float  # coefficients least, near and growth of the depth noise of the sensor
    near: float
    growth: float


_axial_sigma = njit(inline="always")(axial_sigma_single.py_func)  # with the fast-math flags of the caller


@njit(cache=True, nogil=True)
def _sigma(z: float, noise: Noise) -> float:
    """Return the standard deviation of a depth reading, m, at depth `z`, m."""
    return float(max(axial_sigma(z, noise), noise.min_noise))


@njit(cache=True, nogil=True)
def _noise_at(inverse: float, noise: Noise) -> np.float32:
    """Return the maximum noise of inverse depth, 1 / m, at the given inverse depth."""
    return np.float32(noise.factor * _sigma(1.0 / inverse, noise) * inverse * inverse)


@njit(cache=True, nogil=True, parallel=True)
def mean_inverse_depth(depth: Float32, cell: int, noise: Noise, slope: np.float32) -> Float32:
    """Return the mean inverse depth (rows, columns), 1 / m, of the nearest surface in each cell.

    The result is 0 for cells without a reading.

    Args:
        depth: The depth image (H, W), m.
        cell: The side of a cell, px.
        noise: The noise limits.
        slope: The maximum relative change of depth on a surface per cell.
    """
    height, width = depth.shape
    rows, columns = -(-height // cell), -(-width // cell)
    inverse = np.zeros((rows, columns), np.float32)
    for row in prange(rows):
        r = int(np.int64(row))
        for c in range(columns):
            nearest = np.float32(np.inf)
            for v in range(r * cell, min((r + 1) * cell, height)):
                for u in range(c * cell, min((c + 1) * cell, width)):
                    if 0 < depth[v, u] < nearest:
                        nearest = depth[v, u]
            if nearest == np.inf:
                continue
            farthest = nearest * (1 + slope) + 2 * noise.factor * _sigma(nearest, noise)
            total, count = np.float32(0), 0
            for v in range(r * cell, min((r + 1) * cell, height)):
                for u in range(c * cell, min((c + 1) * cell, width)):
                    if 0 < depth[v, u] <= farthest:
                        total += np.float32(1) / depth[v, u]
                        count += 1
            inverse[r, c] = total / np.float32(count)
    return inverse


@njit(cache=True, nogil=True, fastmath=SIMD)
def _add_offset(
    own: Float32, other: Float32, gate: Float32, gate_slope: Float32, x: np.float32, y: np.float32, reach: np.float32,
    sums: Float32,
) -> None:  # fmt: skip
    """Add the moments of the cells at one offset to the sums (10, columns) of the cells of a row.

    Cells with a larger depth difference than gate + gate_slope * reach are skipped.
    """
    zero, one = np.float32(0), np.float32(1)
    n, sx, sy, sxx, sxy, syy, se, sxe, sye, see = sums
    for c in range(len(own)):
        e = other[c] - own[c]
        limit = gate[c] + gate_slope[c] * reach
        w = one if (e < limit) & (e > -limit) & (other[c] > zero) else zero
        we = w * e
        n[c] += w
        sx[c] += w * x
        sy[c] += w * y
        sxx[c] += w * (x * x)
        sxy[c] += w * (x * y)
        syy[c] += w * (y * y)
        se[c] += we
        sxe[c] += we * x
        sye[c] += we * y
        see[c] += we * e


@njit(cache=True, nogil=True, parallel=True)
def fit_planes(inverse: Float32, window: int, noise: Noise, slope: np.float32) -> Float32:
    """Fit a plane to the window around each cell.

    Returns (4, rows, columns): the coefficients a, b and c of the inverse depth a x + b y + c, and the mean squared
    residual. x and y are in cells, and inverse depth is in 1 / m. The residual is inf if no plane can be fitted.
    """
    rows, columns = inverse.shape
    fits = np.zeros((4, rows, columns), np.float32)
    for row in prange(rows):
        r = int(np.int64(row))  # prange counts in unsigned integers
        gate, gate_slope = np.zeros(columns, np.float32), np.zeros(columns, np.float32)  # noise and slope per cell
        for c in range(columns):
            if inverse[r, c] > 0:
                gate[c], gate_slope[c] = _noise_at(inverse[r, c], noise), slope * inverse[r, c]
        sums = np.zeros((10, columns), np.float32)
        for dy in range(-window, window + 1):
            for dx in range(-window, window + 1):
                if not 0 <= r + dy < rows or abs(dx) >= columns:
                    continue
                here = slice(max(0, -dx), min(columns, columns - dx))
                there = slice(max(0, dx), min(columns, columns + dx))
                _add_offset(
                    inverse[r, here], inverse[r + dy, there], gate[here], gate_slope[here], np.float32(dx),
                    np.float32(dy), np.float32(np.sqrt(dx * dx + dy * dy)), sums[:, here],
                )  # fmt: skip
        _solve(inverse[r], sums, fits[:, r])
    return fits


@njit(cache=True, nogil=True, fastmath=SIMD)
def _solve(own: Float32, sums: Float32, fit: Float32) -> None:
    """Fit a plane to the window of each cell of a row by least squares."""
    zero, one = np.float32(0), np.float32(1)
    n, sx, sy, sxx, sxy, syy, se, sxe, sye, see = sums
    for c in range(len(own)):
        k = one / (n[c] if n[c] > zero else one)
        xx, xy, yy = sxx[c] - k * sx[c] * sx[c], sxy[c] - k * sx[c] * sy[c], syy[c] - k * sy[c] * sy[c]
        xe, ye, ee = sxe[c] - k * sx[c] * se[c], sye[c] - k * sy[c] * se[c], see[c] - k * se[c] * se[c]
        determinant = xx * yy - xy * xy
        fits = (own[c] > zero) & (n[c] >= MIN_CELLS) & (determinant > np.float32(MIN_SPREAD) * n[c] * n[c])
        s = one / (determinant if fits else one)
        a, b = (yy * xe - xy * ye) * s, (xx * ye - xy * xe) * s
        residual = k * (ee - a * xe - b * ye)
        fit[0, c] = a if fits else zero
        fit[1, c] = b if fits else zero
        fit[2, c] = own[c] + k * (se[c] - a * sx[c] - b * sy[c]) if fits else zero
        fit[3, c] = (residual if residual > zero else zero) if fits else np.float32(np.inf)


@njit(cache=True, nogil=True, parallel=True)
def best_planes(inverse: Float32, fits: Float32, window: int, noise: Noise) -> Float32:
    """Return the plane (3, rows, columns) of the window with the best fit around or next to each cell.

    If the fits differ only by noise, the window around the cell is used. The last coefficient is 0 if no window has a
    plane.
    """
    rows, columns = inverse.shape
    planes = fits[:3].copy()
    for row in prange(rows):
        r = int(np.int64(row))
        score, variance = np.empty(columns, np.float32), np.zeros(columns, np.float32)
        for c in range(columns):
            d = inverse[r, c]
            if d > 0:
                variance[c] = (_sigma(1.0 / d, noise) * d * d) ** 2
            score[c] = variance[c] + fits[3, r, c] + (d - fits[2, r, c]) ** 2
        for dy in (0, -window, window):
            if not 0 <= r + dy < rows:
                continue
            for dx in (0, -window, window):
                if (dx == 0 and dy == 0) or abs(dx) >= columns:
                    continue
                here = slice(max(0, -dx), min(columns, columns - dx))
                there = slice(max(0, dx), min(columns, columns + dx))
                _take_better(
                    inverse[r, here], fits[:, r + dy, there], np.float32(dx), np.float32(dy), variance[here],
                    score[here], planes[:, r, here],
                )  # fmt: skip
    return planes


@njit(cache=True, nogil=True, fastmath=SIMD)
def _take_better(
    own: Float32, fit: Float32, dx: np.float32, dy: np.float32, variance: Float32, score: Float32, plane: Float32
) -> None:  # fmt: skip
    switch = np.float32(SWITCH)
    fit_a, fit_b, fit_c, residual = fit
    plane_a, plane_b, plane_c = plane
    for c in range(len(own)):
        predicted = fit_c[c] - fit_a[c] * dx - fit_b[c] * dy
        off = own[c] - predicted
        offered = switch * (variance[c] + residual[c] + off * off)
        better = (offered < score[c]) & (own[c] > np.float32(0))
        plane_a[c] = fit_a[c] if better else plane_a[c]
        plane_b[c] = fit_b[c] if better else plane_b[c]
        plane_c[c] = predicted if better else plane_c[c]
        score[c] = offered if better else score[c]


@njit(cache=True, nogil=True, parallel=True)
def count_edges(planes: Float32, pinhole: Float32, noise: Noise, max_angle: float, normal_sigma_1m: float) -> Bool:
    """Return a Boolean array (rows, columns), True at the edges of surfaces and at cells without a plane.

    Args:
        planes: The planes (3, rows, columns), from best_planes().
        pinhole: The intrinsics fx, fy, cx, cy, in cells.
        noise: The noise limits.
        max_angle: The maximum angle of a concave bend, rad.
        normal_sigma_1m: The standard deviation of the angle between two fitted normals at a depth of 1 m, rad per m of
            depth noise.
    """
    _, rows, columns = planes.shape
    surface = np.empty((9, rows, columns), np.float32)
    for r in prange(rows):
        y = np.float32(r) - pinhole[3]
        _set_surface(planes[:, r], y, pinhole, noise, max_angle, normal_sigma_1m, surface[:, r])
    edges = np.zeros((rows, columns), np.bool_)
    for row in prange(rows):
        r = int(np.int64(row))
        for c in range(columns):
            edges[r, c] = planes[2, r, c] <= 0
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
            if r - dy < 0 or r + dy >= rows or columns < 3:
                continue
            begin, end = abs(dx), columns - abs(dx)
            _mark_between(
                surface[:, r - dy, begin - dx : end - dx], surface[:, r + dy, begin + dx : end + dx],
                np.float32(4 * np.sqrt(dx * dx + dy * dy) / (pinhole[0] + pinhole[1])), edges[r, begin:end],
            )  # fmt: skip
    return edges


@njit(cache=True, nogil=True, fastmath=SIMD)
def _set_surface(
    plane: Float32, y: np.float32, pinhole: Float32, noise: Noise, max_angle: float, normal_sigma_1m: float,
    surface: Float32,
) -> None:  # fmt: skip
    """Compute the surface (9, columns) of a row of cells.

    The entries are the unit normal (3) away from the camera, the plane distance, m, and the point (3), m. They are
    followed by the noise of the distance to a plane, m, and the minimum cosine between normals of a flat surface. The
    point is 0 if the cell has no plane.
    """
    # 1 / z = A (u - cx) + B (v - cy) + C is the plane (A fx, B fy, C) . p = 1
    zero, one = np.float32(0), np.float32(1)
    fx, fy, cx, _ = pinhole
    a, b, d = plane
    nx, ny, nz, distance, px, py, pz, gate, min_cosine = surface
    k, floor = np.float32(noise.factor), np.float32(noise.min_noise)
    angle, angle_sigma = np.float32(max_angle), np.float32(normal_sigma_1m)
    for c in range(len(d)):
        valid = d[c] > zero
        x = np.float32(c) - cx
        z = one / (d[c] if valid else one)
        mx, my, mz = a[c] * fx, b[c] * fy, (d[c] if valid else one) - a[c] * x - b[c] * y
        length = one / np.sqrt(mx * mx + my * my + mz * mz)
        nx[c], ny[c], nz[c], distance[c] = mx * length, my * length, mz * length, length
        px[c], py[c], pz[c] = x / fx * z, y / fy * z, z if valid else zero
        sigma = _axial_sigma(z, noise)
        gate[c] = k * (sigma if sigma > floor else floor)
        # cos t = 1 - t^2 / 2 + t^4 / 24, within 0.02 up to a right angle; a larger angle is not a crease
        t = angle + gate[c] * angle_sigma / z
        t2 = t * t
        min_cosine[c] = one - np.float32(0.5) * t2 + t2 * t2 * np.float32(1 / 24) if t < np.float32(1.5) else zero


@njit(cache=True, nogil=True, fastmath=SIMD)
def _mark_between(one: Float32, other: Float32, spacing: np.float32, edges: Bool) -> None:
    """Mark the cells whose opposite neighbors are on different surfaces or form a concave crease.

    `spacing` is the distance between the neighbors at a depth of 1 m, m.
    """
    zero = np.float32(0)
    ax, ay, az, ad, apx, apy, apz, gate, min_cosine = one
    bx, by, bz, bd, bpx, bpy, bpz, _, _ = other
    for c in range(len(edges)):
        # distance of the point of each neighbor in front of the plane of the other neighbor
        h = ad[c] - (ax[c] * bpx[c] + ay[c] * bpy[c] + az[c] * bpz[c])
        g = bd[c] - (bx[c] * apx[c] + by[c] * apy[c] + bz[c] * apz[c])
        cosine = ax[c] * bx[c] + ay[c] * by[c] + az[c] * bz[c]
        far, near = h if h > zero else -h, g if g > zero else -g
        z = apz[c] if apz[c] < bpz[c] else bpz[c]
        # at a convex edge, a neighbor may be behind the plane of the other neighbor by the distance between them
        jump = (far if far < near else near) > gate[c] + (spacing * z if h * g > zero else zero)
        concave = (h + g > zero) & (cosine < min_cosine[c])
        both = (apz[c] > zero) & (bpz[c] > zero)
        edges[c] |= both & (jump | concave)


@njit(cache=True, nogil=True)
def _unite_row(
    inverse: Float32, edges: Bool, noise: Noise, slope: np.float32, r: int, upwards: bool, parents: Int32
) -> None:
    """Unite the cells of a row with their left or upper neighbors, except at edges and depth jumps."""
    columns = inverse.shape[1]
    step = columns if upwards else 1
    flat_inverse, flat_edges = inverse.ravel(), edges.ravel()
    for cell in range(r * columns + (not upwards), (r + 1) * columns):
        other = cell - step
        if flat_edges[cell] or flat_edges[other] or parents[cell] == parents[other]:
            continue
        d, e = flat_inverse[cell], flat_inverse[other]
        if abs(d - e) < _noise_at(d, noise) + slope * d:
            unite(parents, cell, other)


@njit(cache=True, nogil=True, parallel=True)
def connected(inverse: Float32, edges: Bool, noise: Noise, slope: np.float32, min_cells: int) -> tuple[Int32, int]:
    """Return the connected component (rows, columns) of each cell, and the number of components.

    The component is -1 at edges and in components with fewer than `min_cells` cells.
    """
    rows, columns = inverse.shape
    parents = np.arange(rows * columns).astype(np.int32)
    strips = -(-rows // STRIP)
    for strip in prange(strips):
        s = int(np.int64(strip))
        for r in range(s * STRIP, min((s + 1) * STRIP, rows)):
            _unite_row(inverse, edges, noise, slope, r, False, parents)
            if r > s * STRIP:
                _unite_row(inverse, edges, noise, slope, r, True, parents)
    for s in range(1, strips):
        _unite_row(inverse, edges, noise, slope, s * STRIP, True, parents)
    sizes = np.zeros(rows * columns, np.int32)
    flat_edges = edges.ravel()
    for cell in range(rows * columns):
        if not flat_edges[cell]:
            sizes[root(parents, cell)] += 1
    piece_labels, count = np.full(rows * columns, -1, np.int32), 0
    labels = np.full(rows * columns, -1, np.int32)
    for cell in range(rows * columns):
        piece = root(parents, cell)
        if flat_edges[cell] or sizes[piece] < min_cells:
            continue
        if piece_labels[piece] < 0:
            piece_labels[piece] = count
            count += 1
        labels[cell] = piece_labels[piece]
    return labels.reshape((rows, columns)), count


@njit(cache=True, nogil=True)  # too little work for threads
def absorbed(inverse: Float32, labels: Int32, planes: Float32, noise: Noise) -> tuple[Int32, Float32]:
    """Return the labels and planes, grown by one cell.

    An unlabeled cell joins the neighbor that best predicts its depth.
    """
    rows, columns = inverse.shape
    new_labels, new_planes = labels.copy(), planes.copy()
    for r in range(rows):
        for c in range(columns):
            d = inverse[r, c]
            if labels[r, c] >= 0 or d <= 0:
                continue
            least = _noise_at(d, noise)
            for dy, dx in ((0, -1), (-1, 0), (0, 1), (1, 0)):
                s, t = r + dy, c + dx
                if not (0 <= s < rows and 0 <= t < columns) or labels[s, t] < 0:
                    continue
                predicted = planes[2, s, t] - planes[0, s, t] * dx - planes[1, s, t] * dy
                if abs(d - predicted) < least:
                    least = abs(d - predicted)
                    new_labels[r, c] = labels[s, t]
                    new_planes[0, r, c], new_planes[1, r, c] = planes[0, s, t], planes[1, s, t]
                    new_planes[2, r, c] = predicted
    return new_labels, new_planes


@njit(cache=True, nogil=True, parallel=True)
def pixel_labels(
    depth: Float32, inverse: Float32, labels: Int32, planes: Float32, cell: int, noise: Noise, slope: np.float32
) -> Int32:
    """Return the label (H, W) of each pixel, from the nearby cell whose plane best predicts its depth.

    If no plane predicts the depth, the pixel gets the label of its own cell if its depth is similar.
    """
    height, width = depth.shape
    rows, columns = labels.shape
    found = np.full((height, width), -1, np.int32)
    middle = np.float32(0.5 * (cell - 1))
    for row in prange(rows):
        r = int(np.int64(row))
        near_labels, near_planes = np.empty(9, np.int32), np.empty((9, 3), np.float32)
        for c in range(columns):
            if inverse[r, c] <= 0:
                continue
            d = inverse[r, c]
            gate = _noise_at(d, noise)
            label = labels[r, c]
            alone = True  # True if all adjacent cells have the same label
            for n in range(9):
                s, t = r + n // 3 - 1, c + n % 3 - 1
                inside = 0 <= s < rows and 0 <= t < columns
                near_labels[n] = labels[s, t] if inside else label
                alone &= near_labels[n] == label
            for n in range(0 if alone else 9):
                s, t = min(max(r + n // 3 - 1, 0), rows - 1), min(max(c + n % 3 - 1, 0), columns - 1)
                _plane_of_cell(planes, inverse, s, t, near_planes[n])
            for v in range(r * cell, min((r + 1) * cell, height)):
                y = (np.float32(v - r * cell) - middle) / np.float32(cell)
                for u in range(c * cell, min((c + 1) * cell, width)):
                    if depth[v, u] <= 0:
                        continue
                    x = (np.float32(u - c * cell) - middle) / np.float32(cell)
                    e = np.float32(1) / depth[v, u]
                    if abs(e - d) < gate + slope * d:
                        found[v, u] = label
                    if alone:
                        continue
                    least = gate
                    for dy in range(0 if y < 0 else 1, 3 if y > 0 else 2):
                        for dx in range(0 if x < 0 else 1, 3 if x > 0 else 2):
                            n = 3 * dy + dx
                            plane = near_planes[n]
                            off = abs(e - plane[2] - plane[0] * (x - (dx - 1)) - plane[1] * (y - (dy - 1)))
                            if near_labels[n] >= 0 and off < least:
                                least = off
                                found[v, u] = near_labels[n]
    return found


@njit(cache=True, nogil=True)
def _plane_of_cell(planes: Float32, inverse: Float32, r: int, c: int, plane: Float32) -> None:
    """Set `plane` (3,) to the plane of a cell, or to constant depth if the cell has no plane."""
    if planes[2, r, c] > 0:
        plane[0], plane[1], plane[2] = planes[0, r, c], planes[1, r, c], planes[2, r, c]
    else:
        plane[0], plane[1], plane[2] = 0, 0, inverse[r, c]
