"""Kernels of alignment.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.voxel_grid_kernels import device, one_more
from framework.sensors.noise_models_kernels import axial_sigma_single

CHUNKS = 16  # number of chunks of image rows, summed in order, so that sums do not depend on the number of threads
BATCH = 160  # number of points per batch; divides the usual image widths
LANES = 16  # number of lanes of a sum; point n of a batch is added to lane n % LANES
ROW = 5  # number of sums per derivative of the error: products with itself, the next three and the error
ENERGY = 6 * ROW  # index of the weighted squared error among the sums of one term of the energy
COLOR = ENERGY + 1  # index of the first sum of the photometric term, after those of the geometric term
BRIGHTNESS = 2 * COLOR  # index of the sum of frame minus model intensity
SUMS = BRIGHTNESS + 1  # number of sums over points, each of LANES lanes
TERMS = SUMS + 6  # number of values of a chunk: its sums, then its six counts
# offsets of the point fields of a batch: in the frame, in the view, and in the model ...
DEPTH, INTENSITY, NX, NY, NZ, PX, PY, PZ, U, V, QZ, MX, MY, MZ, NEAR, A, B, I00, I10, I01, I11 = (
    field * BATCH for field in range(21)
)
POINT_FIELDS = 21
# ... and offsets of its residual terms
J0, J1, J2, J3, J4, J5, W, ERROR, DARKER, ADDED = (field * BATCH for field in range(10))
TERM_SIZE = ADDED + COLOR * LANES  # the fields are followed by the sums of one term over the batch, by lane
FAR = 2.0  # depth above which depth errors are correlated, m
RANGE = 5.0  # largest depth of structured-light cameras, m; errors and gates are proportional to depth beyond it
NEAREST = 0.05  # minimum depth of projected points in the view, m


# Not cv2.blur: other threads that use OpenCV change the split of its running sums, and thus the rounding.
@njit(cache=True, nogil=True, parallel=True)
def smooth_normals(normals, reach, row_sums, smooth):
    """Average normals over squares and normalize them.

    The result is 0 if a square has no normals.

    Args:
        normals: The normals (3, H, W).
        reach: The radius of a square: its side is 2 * reach + 1 px.
        row_sums: A buffer (3, H, W).
        smooth: The output (3, H, W).
    """
    _, height, width = normals.shape
    for v in prange(height):
        for i in range(3):
            row_sums[i, v] = np.float32(0.0)
            for d in range(-reach, reach + 1):
                u0 = max(-d, 0)
                for n in range(width - abs(d)):  # unsigned indices need no wraparound check
                    row_sums[i, v, np.uint64(u0 + n)] += normals[i, v, np.uint64(u0 + d + n)]
    for v in prange(height):
        smooth[:, v] = np.float32(0.0)
        for w in range(max(v - reach, 0), min(v + reach + 1, height)):
            for i in range(3):
                for u in range(width):
                    smooth[i, v, u] += row_sums[i, w, u]
        for u in range(width):
            x, y, z = smooth[0, v, u], smooth[1, v, u], smooth[2, v, u]
            scale = np.float32(1.0) / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
            smooth[0, v, u], smooth[1, v, u], smooth[2, v, u] = x * scale, y * scale, z * scale


@njit(cache=True, nogil=True, parallel=True)
def turn_normals(normals_world, R, normals):
    """Rotate normals (H, W, 3) by `R` (3, 3), and write them to `normals` (3, H, W)."""
    for v in prange(normals.shape[1]):
        for u in range(normals.shape[2]):
            x, y, z = normals_world[v, u, 0], normals_world[v, u, 1], normals_world[v, u, 2]
            for i in range(3):
                normals[i, v, u] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z


@device
def _tukey(r, scale):
    """Return Tukey's biweight of a residual, which is 0 beyond `scale`."""
    s = r / scale
    s = max(np.float32(1.0) - s * s, np.float32(0.0))
    return s * s


@device
def _load(frame, v, u0, points):
    """Copy a batch of pixels of row v, starting at column u0, to `points`.

    Past the end of the row, the depth is 0.
    """
    depth, intensity, normals = frame.depth, frame.intensity, frame.normals
    for n in range(BATCH):
        u = u0 + n
        if u < depth.shape[1]:
            points[DEPTH + n], points[INTENSITY + n] = depth[v, u], intensity[v, u]
            points[NX + n], points[NY + n], points[NZ + n] = normals[0, v, u], normals[1, v, u], normals[2, v, u]
        else:
            points[DEPTH + n] = np.float32(0.0)


@device
def _project(frame, v, u0, model, shape, R, t, points, pixel):
    """Project the points of a batch into the view.

    Sets the position of each point, m, its image position, px from the image corner, and its flat pixel index, -1 =
    outside.
    """
    fx, fy, cx, cy = frame.fx, frame.fy, frame.cx, frame.cy
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    width = np.int32(shape[1])
    right, bottom = np.float32(shape[1]), np.float32(shape[0])
    y = (np.float32(v) - cy) / fy
    x0, dx = (np.float32(u0) - cx) / fx, one / fx
    row_x, row_y, row_z = R[0, 1] * y + R[0, 2], R[1, 1] * y + R[1, 2], R[2, 1] * y + R[2, 2]
    R00, R10, R20 = R[0, 0], R[1, 0], R[2, 0]
    t0, t1, t2 = t[0], t[1], t[2]
    mfx, mfy, mcx, mcy = model.fx, model.fy, model.cx + half, model.cy + half
    for n in range(BATCH):
        d = points[DEPTH + n]
        x = x0 + np.float32(np.int32(n)) * dx
        px, py, pz = d * (R00 * x + row_x) + t0, d * (R10 * x + row_y) + t1, d * (R20 * x + row_z) + t2
        inv_z = one / max(pz, np.float32(NEAREST))
        u, v_ = mfx * px * inv_z + mcx, mfy * py * inv_z + mcy
        inside = (d > zero) & (pz > np.float32(NEAREST)) & (u > zero) & (v_ > zero) & (u < right) & (v_ < bottom)
        index = np.int32(v_) * width + np.int32(u)
        pixel[n] = index if inside else np.int32(-1)
        points[PX + n], points[PY + n], points[PZ + n] = px, py, pz
        points[U + n], points[V + n] = u, v_


@device
def _gather_model(depth, normals, size, pixel, points):
    """Read the depth and normal of the model at the pixel of each point, depth 0 = no surface."""
    for n in range(BATCH):
        i = pixel[n]
        if i >= 0:
            points[QZ + n] = depth[np.uint32(i)]
            points[MX + n] = normals[np.uint32(i)]
            points[MY + n] = normals[np.uint32(i + size)]
            points[MZ + n] = normals[np.uint32(i + size + size)]
        else:
            points[QZ + n] = np.float32(0.0)


@device
def _write_term(J, n, weight, error, gx, gy, gz, px, py, pz):
    """Write the weight, the error and the derivative of the error for one point.

    The derivative is with respect to a left twist (translation, rotation) of T_view_camera. (gx, gy, gz) is the
    derivative with respect to the point (px, py, pz).
    """
    zero = np.float32(0.0)
    weighted = weight > zero  # values of points with weight 0 may be NaN
    J[W + n] = weight
    J[ERROR + n] = error if weighted else zero
    J[J0 + n] = gx if weighted else zero
    J[J1 + n] = gy if weighted else zero
    J[J2 + n] = gz if weighted else zero
    J[J3 + n] = py * gz - pz * gy if weighted else zero
    J[J4 + n] = pz * gx - px * gz if weighted else zero
    J[J5 + n] = px * gy - py * gx if weighted else zero


@device
def _add_geometry(model, R, weights, linear, noise_model, points, J):
    """Compute the point-to-plane terms of a batch, and return the counts (visible, matched, close, behind).

    See NormalEquations for the counts. points[NEAR] is set to 1 for the points that the photometric term uses,
    otherwise to 0.
    """
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    inv_fx, inv_fy = one / model.fx, one / model.fy
    cx, cy = model.cx + half, model.cy + half
    R00, R01, R02, R10, R11, R12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    R20, R21, R22 = R[2, 0], R[2, 1], R[2, 2]
    inv_far, far_range, inv_range = one / np.float32(FAR), np.float32(RANGE), one / np.float32(RANGE)
    max_distance2 = weights.max_distance * weights.max_distance
    close_distance = weights.close_distance
    min_dot, scale, strength = weights.min_normal_dot, weights.geometric_scale, weights.depth_weight
    visible = matched = close = behind = np.int32(0)
    for n in range(BATCH):
        q = points[QZ + n]
        px, py, pz = points[PX + n], points[PY + n], points[PZ + n]
        # the model point is on the ray through the center of the pixel
        qx = (np.floor(points[U + n]) + half - cx) * inv_fx * q
        qy = (np.floor(points[V + n]) + half - cy) * inv_fy * q
        ex, ey, ez = px - qx, py - qy, pz - q
        mapped = q > zero
        distance2 = ex * ex + ey * ey + ez * ez
        z = points[DEPTH + n]
        growth = max(one, z * inv_range)
        if linear is None:  # Numba compiles only the branch for the type of `linear`
            near = mapped & (distance2 <= max_distance2 * growth * growth)
        else:
            near = mapped & (distance2 <= max_distance2)
        nx, ny, nz = points[MX + n], points[MY + n], points[MZ + n]
        fx, fy, fz = points[NX + n], points[NY + n], points[NZ + n]
        dot = (
            nx * (R00 * fx + R01 * fy + R02 * fz)
            + ny * (R10 * fx + R11 * fy + R12 * fz)
            + nz * (R20 * fx + R21 * fy + R22 * fz)
        )
        in_range = min(z, far_range)
        noise = axial_sigma_single(in_range, noise_model) * growth
        sigma = noise * max(one, in_range * inv_far)
        distance = nx * ex + ny * ey + nz * ez
        matches = near & (dot > min_dot)
        if linear is None:
            weight = _tukey(distance / sigma, scale) * strength / (sigma * sigma)
        else:
            nearness = (one - np.sqrt(distance2) / weights.max_distance) + (one - z / linear.max_depth)
            weight = max(half * nearness, zero) * strength
            near = matches
        weight = weight if matches else zero
        points[NEAR + n] = one if near else zero
        _write_term(J, n, weight, distance, nx, ny, nz, px, py, pz)
        apart = max(close_distance, np.float32(3.0) * noise)
        visible = one_more(visible, mapped)
        matched = one_more(matched, weight > zero)
        close = one_more(close, mapped & (abs(ez) < apart))
        behind = one_more(behind, mapped & (ez > apart + apart))
    return visible, matched, close, behind


@device
def _gather_intensities(intensity, shape, inverse_scale, points, pixel):
    """Read the four model intensities around each point, and compute its bilinear weights.

    I00 is -1 for points without a photometric term.
    """
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    width = np.int32(shape[1])
    right, bottom = np.float32(shape[1] - 2), np.float32(shape[0] - 2)
    for n in range(BATCH):
        # the origin of U and V is the corner of the image
        u, v = points[U + n] * inverse_scale - half, points[V + n] * inverse_scale - half
        inside = (points[NEAR + n] > zero) & (u >= one) & (v >= one) & (u < right) & (v < bottom)
        column, row = np.int32(u), np.int32(v)
        points[A + n], points[B + n] = u - np.float32(column), v - np.float32(row)
        pixel[n] = row * width + column if inside else np.int32(-1)
    for n in range(BATCH):
        i = pixel[n]
        if i >= 0:
            points[I00 + n], points[I10 + n] = intensity[np.uint32(i)], intensity[np.uint32(i + 1)]
            points[I01 + n], points[I11 + n] = intensity[np.uint32(i + width)], intensity[np.uint32(i + width + 1)]
        else:
            points[I00 + n] = -one


@device
def _add_photometry(model, inverse_scale, weights, linear, brightness, points, J):
    """Compute the photometric terms of a batch, and return the counts (matched, compared).

    Compared points have a model intensity. Matched points also have a nonzero weight.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    noise, scale = weights.intensity_noise, weights.photometric_scale
    strength = weights.color_weight / (noise * noise)
    fx, fy = model.fx * inverse_scale, model.fy * inverse_scale
    compared = matched = np.int32(0)
    for n in range(BATCH):
        a, b = points[A + n], points[B + n]
        i00, i10, i01, i11 = points[I00 + n], points[I10 + n], points[I01 + n], points[I11 + n]
        seen = (i00 >= zero) & (i10 >= zero) & (i01 >= zero) & (i11 >= zero)
        du0, du1 = i10 - i00, i11 - i01
        top, low = i00 + a * du0, i01 + a * du1
        change = top + b * (low - top) - points[INTENSITY + n]
        px, py, pz = points[PX + n], points[PY + n], points[PZ + n]
        inv_z = one / max(pz, np.float32(NEAREST))
        gx = (du0 + b * (du1 - du0)) * fx * inv_z
        gy = (low - top) * fy * inv_z
        gz = -(gx * px + gy * py) * inv_z
        error = change + brightness  # model minus frame, with compensation
        if linear is None:
            weight = _tukey(error / noise, scale) * strength
        else:
            weight = max(one - abs(error) / linear.max_intensity_difference, zero) * weights.color_weight
        weight = weight if seen else zero
        _write_term(J, n, weight, error, gx, gy, gz, px, py, pz)
        compared = one_more(compared, seen)
        matched = one_more(matched, weight > zero)
        J[DARKER + n] = -change if seen else zero
    return matched, compared


@device
def _multiply(J, a, b, c, d, row):
    """Compute five weighted sums over a batch, by lane: products of field `a` with four fields and the error."""
    zero = np.float32(0.0)
    added = ADDED + row * ROW * LANES
    for lane in range(LANES):
        product0 = product1 = product2 = product3 = product_error = zero
        for step in range(BATCH // LANES):  # the compiler unrolls this loop and vectorizes the loop over lanes
            n = step * LANES + lane
            weighted = J[W + n] * J[a + n]
            product0 += weighted * J[a + n]
            product1 += weighted * J[b + n]
            product2 += weighted * J[c + n]
            product3 += weighted * J[d + n]
            product_error += weighted * J[ERROR + n]
        J[added + lane] = product0
        J[added + LANES + lane] = product1
        J[added + 2 * LANES + lane] = product2
        J[added + 3 * LANES + lane] = product3
        J[added + 4 * LANES + lane] = product_error


@device
def _add_products(J, lanes, first):
    """Add the sums of one term over a batch to `lanes`, in double precision."""
    # w J^T J (upper triangle and three more elements), w J^T r and w r^2
    _multiply(J, J0, J1, J2, J3, 0)
    _multiply(J, J1, J2, J3, J4, 1)
    _multiply(J, J2, J3, J4, J5, 2)
    _multiply(J, J3, J4, J5, J0, 3)
    _multiply(J, J4, J5, J0, J1, 4)
    _multiply(J, J5, J0, J1, J2, 5)
    for lane in range(LANES):
        energy = np.float32(0.0)
        for step in range(BATCH // LANES):
            n = step * LANES + lane
            energy += J[W + n] * J[ERROR + n] * J[ERROR + n]
        J[ADDED + ENERGY * LANES + lane] = energy
    for n in range(COLOR * LANES):
        lanes[first + n] += np.float64(J[ADDED + n])


@device
def _add_brightness(J, lanes):
    """Add the intensity differences of a batch to `lanes`, in double precision."""
    for lane in range(LANES):
        change = np.float32(0.0)
        for step in range(BATCH // LANES):
            n = step * LANES + lane
            change += J[DARKER + n]
        lanes[BRIGHTNESS * LANES + lane] += np.float64(change)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def accumulate(frame, model, model_intensity, inverse_scale, R, t, weights, linear, noise_model, brightness, sums):
    """Compute the sums of the normal equations over each chunk of image rows.

    Args:
        frame: The frame, a FrameView.
        model: The view of the map, a ModelView.
        model_intensity: The intensity (h, w) of the view at the resolution of the frame.
        inverse_scale: The width of `model_intensity` divided by the width of the view.
        R: The rotation (3, 3) of T_view_camera.
        t: The translation (3,) of T_view_camera, m.
        weights: The weights and limits, a Weights.
        linear: The limits of the linear weights, or None for Tukey's weights.
        noise_model: The noise parameters of the depth sensor.
        brightness: The mean of frame minus model intensity.
        sums: The output (CHUNKS, TERMS).
    """
    height, width = frame.depth.shape
    shape, level_shape = model.depth.shape, model_intensity.shape
    size = np.int32(model.depth.size)
    flat_depth, flat_normals, flat_intensity = model.depth.ravel(), model.normals.ravel(), model_intensity.ravel()
    # with LinearWeights, both terms are added to the same lanes and round like a single sum
    color = COLOR * LANES if linear is None else 0
    for chunk in prange(CHUNKS):
        total = np.zeros(TERMS, np.float64)
        lanes = np.zeros(SUMS * LANES, np.float64)
        points = np.zeros(POINT_FIELDS * BATCH, np.float32)
        J = np.empty(TERM_SIZE, np.float32)
        pixel = np.empty(BATCH, np.int32)
        for v in range(chunk * height // CHUNKS, (chunk + 1) * height // CHUNKS):
            for u0 in range(0, width, BATCH):
                _load(frame, v, u0, points)
                _project(frame, v, u0, model, shape, R, t, points, pixel)
                _gather_model(flat_depth, flat_normals, size, pixel, points)
                visible, matched, close, behind = _add_geometry(model, R, weights, linear, noise_model, points, J)
                _add_products(J, lanes, 0)
                total[SUMS] += visible
                total[SUMS + 1] += matched
                total[SUMS + 2] += close
                total[SUMS + 3] += behind
                if weights.color_weight > np.float32(0.0):
                    _gather_intensities(flat_intensity, level_shape, inverse_scale, points, pixel)
                    matched, compared = _add_photometry(model, inverse_scale, weights, linear, brightness, points, J)
                    _add_products(J, lanes, color)
                    _add_brightness(J, lanes)
                    total[SUMS + 4] += matched
                    total[SUMS + 5] += compared
        for i in range(SUMS):
            for lane in range(LANES):
                total[i] += lanes[i * LANES + lane]
        for i in range(TERMS):  # not `sums[chunk] = total`, which takes seconds to compile
            sums[chunk, i] = total[i]
