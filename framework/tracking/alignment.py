"""Aligning a frame to a view of the map: point-to-plane and photometric terms, eq. 2 of the method.

    E(xi) = sum_i w_i (n_i . (T p_i - q_i))^2 + lambda sum_i v_i (I(pi(T p_i)) - I_frame,i)^2

The frame's points p_i are moved by T = T_view_camera and projected into the view, which gives each its model point q_i
with normal n_i, and its model intensity. Residuals are divided by their expected noise, so that both terms count
standard deviations; w_i and v_i are Tukey's biweights. Gauss-Newton steps are twists of the view's frame: T <- exp(xi)
T.

An image row is done in passes that hold no branches, so that the compiler vectorises them; a point that does not count
has weight 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from framework.data import Camera, Float32, Float64, SurfaceView
from framework.mapping.voxel_grid import device
from framework.tracking.pyramid import PyramidLevel

CHUNKS = 16  # of image rows, summed in order: the same sums whatever the number of threads
TERMS = 27 + 7  # of a chunk's sums: 21 + 6 of the normal equations, then the counts below
CLOSE = 0.05  # m, or 3 standard deviations: a reading this far from the model's depth agrees with it
NEAREST = 0.05  # m in front of the view; points nearer than this are not projected


class ModelView(NamedTuple):
    """The view of the map that frames are aligned to."""

    depth: Float32  # (H, W) m, 0 = nothing there
    normals: Float32  # (3, H, W) in the view's camera frame
    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32


def model_view(view: SurfaceView) -> ModelView:
    """What alignment needs of a view of the map."""
    normals = np.empty((3, *view.depth.shape), np.float32)
    _turn_normals(view.normals_world, np.ascontiguousarray(view.T_world_camera[:3, :3].T, np.float32), normals)
    camera = view.camera
    return ModelView(view.depth, normals, *(np.float32(k) for k in (camera.fx, camera.fy, camera.cx, camera.cy)))


@njit(cache=True, nogil=True, parallel=True)
def _turn_normals(normals_world, R, normals):
    """Fills normals (3, H, W) with R n of the normals n of normals_world (H, W, 3)."""
    for v in prange(normals.shape[1]):
        for u in range(normals.shape[2]):
            x, y, z = normals_world[v, u, 0], normals_world[v, u, 1], normals_world[v, u, 2]
            for i in range(3):
                normals[i, v, u] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z


class Weights(NamedTuple):
    """How residuals are weighed."""

    max_distance: np.float32  # m, of a point from its model point
    min_normal_dot: np.float32  # cosine between the frame's and the model's normal
    geometric_scale: np.float32  # standard deviations at which Tukey's weight reaches 0
    photometric_scale: np.float32  # likewise
    intensity_noise: np.float32  # standard deviation of an intensity difference, of [0, 1]
    color_weight: np.float32  # lambda; 0 = geometry alone
    depth_weight: np.float32  # 1, or 0 = colour alone


class NormalEquations(NamedTuple):
    """The linearised problem, and what it is made of."""

    A: Float64  # (6, 6)
    b: Float64  # (6,)
    visible: int  # points that fall on a mapped part of the view
    matched: int  # of these, points with a weight
    close: int  # of the visible, points whose depth in the view agrees with the model's
    behind: int  # of the visible, points so far behind the model that they could not be seen through it
    brightness: float  # mean of frame - model intensity: the change of exposure


@device
def depth_noise(z):
    """Standard deviation (m) of a structured-light reading at depth z (m): Nguyen et al. 2012, eq. 3 (axial noise)."""
    return np.float32(0.0012) + np.float32(0.0019) * (z - np.float32(0.4)) * (z - np.float32(0.4))


@device
def _tukey(r, scale):
    """Tukey's biweight of a residual in standard deviations."""
    s = r / scale
    s = max(np.float32(1.0) - s * s, np.float32(0.0))
    return s * s


@device
def _project(depth, v, fx, fy, cx, cy, model, R, t, points, places, pixels):
    """One row of the frame in the view: points (3, W) m, places (2, W) px, and the model's pixel number (W,).

    The pixel number is -1 where there is no reading or it falls outside the view.
    """
    height, width = model.depth.shape
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    right, bottom = np.float32(width) - half, np.float32(height) - half
    y = (np.float32(v) - cy) / fy
    inv_fx = one / fx
    for u in range(depth.shape[1]):
        d = depth[v, u]
        x = (np.float32(np.int32(u)) - cx) * inv_fx
        px = d * (R[0, 0] * x + R[0, 1] * y + R[0, 2]) + t[0]
        py = d * (R[1, 0] * x + R[1, 1] * y + R[1, 2]) + t[1]
        pz = d * (R[2, 0] * x + R[2, 1] * y + R[2, 2]) + t[2]
        inv_z = one / max(pz, np.float32(NEAREST))
        mu = model.fx * px * inv_z + model.cx
        mv = model.fy * py * inv_z + model.cy
        inside = (d > zero) & (pz > np.float32(NEAREST)) & (mu > -half) & (mv > -half) & (mu < right) & (mv < bottom)
        column = np.int32(mu + half) if inside else np.int32(0)
        line = np.int32(mv + half) if inside else np.int32(0)
        points[0, u], points[1, u], points[2, u] = px, py, pz
        places[0, u], places[1, u] = mu, mv
        pixels[u] = line * np.int32(width) + column if inside else np.int32(-1)


@device
def _add_geometry(depth, normals, v, model, flat_depth, flat_normals, R, weights, points, pixels, matched, J, w, r):
    """The point-to-plane terms of a row into J (6, W), w and r (W,); returns (visible, weighed, close, behind).

    matched (W,) becomes 1 where a point is near enough to its model point, 0 elsewhere.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    inv_fx, inv_fy = one / model.fx, one / model.fy
    max_distance2 = weights.max_distance * weights.max_distance
    width = np.int32(model.depth.shape[1])
    size = np.int32(model.depth.size)
    visible = weighed = close = behind = np.int32(0)
    for u in range(depth.shape[1]):
        pixel = max(pixels[u], np.int32(0))
        q = flat_depth[np.uint32(pixel)] if pixels[u] >= 0 else zero
        column = pixel % width
        line = pixel // width
        qx = (np.float32(column) - model.cx) * inv_fx * q
        qy = (np.float32(line) - model.cy) * inv_fy * q
        px, py, pz = points[0, u], points[1, u], points[2, u]
        ex, ey, ez = px - qx, py - qy, pz - q
        near = (q > zero) & (ex * ex + ey * ey + ez * ez <= max_distance2)
        nx = flat_normals[np.uint32(pixel)]
        ny = flat_normals[np.uint32(pixel + size)]
        nz = flat_normals[np.uint32(pixel + size + size)]
        fx, fy, fz = normals[0, v, u], normals[1, v, u], normals[2, v, u]
        dot = (
            nx * (R[0, 0] * fx + R[0, 1] * fy + R[0, 2] * fz)
            + ny * (R[1, 0] * fx + R[1, 1] * fy + R[1, 2] * fz)
            + nz * (R[2, 0] * fx + R[2, 1] * fy + R[2, 2] * fz)
        )
        sigma = depth_noise(depth[v, u])
        distance = nx * ex + ny * ey + nz * ez
        weight = _tukey(distance / sigma, weights.geometric_scale) * weights.depth_weight / (sigma * sigma)
        weight = weight if near & (dot > weights.min_normal_dot) else zero
        J[0, u], J[1, u], J[2, u] = nx, ny, nz
        J[3, u], J[4, u], J[5, u] = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
        w[u] = weight
        r[u] = distance
        matched[u] = one if near else zero
        visible += np.int32(1) if q > zero else np.int32(0)
        weighed += np.int32(1) if weight > zero else np.int32(0)
        apart = max(np.float32(CLOSE), np.float32(3.0) * sigma)
        close += np.int32(1) if (q > zero) & (abs(ez) < apart) else np.int32(0)
        behind += np.int32(1) if (q > zero) & (ez > apart + apart) else np.int32(0)
    return visible, weighed, close, behind


@device
def _add_photometry(
    intensity, v, model, model_intensity, flat, inverse_scale, weights, brightness, points, places, matched, J, w, r
):
    """The photometric terms of a row, behind the geometric ones in J (6, 2 W), w and r (2 W,).

    Returns (weighed, sum of frame - model intensity, how many). `inverse_scale` is the width of model_intensity over
    that of the view, whose pixels `places` are in.
    """
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    level_height, level_width = model_intensity.shape
    right, bottom = np.float32(level_width - 2), np.float32(level_height - 2)
    row = np.int32(level_width)
    strength = weights.color_weight / (weights.intensity_noise * weights.intensity_noise)
    compared = np.int32(0)
    weighed = np.int32(0)
    darker = zero
    width = intensity.shape[1]
    for u in range(width):
        lu = (places[0, u] + half) * inverse_scale - half
        lv = (places[1, u] + half) * inverse_scale - half
        inside = (matched[u] > zero) & (lu >= one) & (lv >= one) & (lu < right) & (lv < bottom)
        lu = lu if inside else one
        lv = lv if inside else one
        ju, jv = np.int32(lu), np.int32(lv)
        a, b = lu - np.float32(ju), lv - np.float32(jv)
        n = jv * row + ju
        i00, i10 = flat[np.uint32(n)], flat[np.uint32(n + 1)]
        i01, i11 = flat[np.uint32(n + row)], flat[np.uint32(n + row + 1)]
        seen = inside & (min(min(i00, i10), min(i01, i11)) >= zero)
        du0, du1 = i10 - i00, i11 - i01
        top, low = i00 + a * du0, i01 + a * du1
        value = top + b * (low - top)
        change = value - intensity[v, u]
        px, py, pz = points[0, u], points[1, u], points[2, u]
        inv_z = one / max(pz, np.float32(NEAREST))
        gx = (du0 + b * (du1 - du0)) * inverse_scale * model.fx * inv_z
        gy = (low - top) * inverse_scale * model.fy * inv_z
        gz = -(gx * px + gy * py) * inv_z
        residual = change + brightness
        weight = _tukey(residual / weights.intensity_noise, weights.photometric_scale) * strength
        weight = weight if seen else zero
        J[0, width + u], J[1, width + u], J[2, width + u] = gx, gy, gz
        J[3, width + u], J[4, width + u], J[5, width + u] = py * gz - pz * gy, pz * gx - px * gz, px * gy - py * gx
        w[width + u] = weight
        r[width + u] = residual
        compared += np.int32(1) if seen else np.int32(0)
        weighed += np.int32(1) if weight > zero else np.int32(0)
        darker -= change if seen else zero
    return weighed, darker, compared


@device
def _add_row(J, w, r, weighted, total):
    """Adds the sums of w J^T J (upper triangle) and w J^T r over a row to the total."""
    size = w.shape[0]
    n = 0
    for i in range(6):
        for u in range(size):
            weighted[u] = w[u] * J[i, u]
        for j in range(i, 6):
            product = np.float32(0.0)
            for u in range(size):
                product += weighted[u] * J[j, u]
            total[n] += np.float64(product)
            n += 1
        product = np.float32(0.0)
        for u in range(size):
            product += weighted[u] * r[u]
        total[21 + i] += np.float64(product)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _accumulate(
    depth, intensity, normals, fx, fy, cx, cy, model, model_intensity, inverse_scale, R, t, weights, brightness, sums
):
    """Sums the normal equations over one pyramid level of the frame, by chunks of rows, into sums (CHUNKS, TERMS).

    `R`, `t` are T_view_camera.
    """
    height, width = depth.shape
    terms = 2 * width if weights.color_weight > np.float32(0.0) else width
    flat_depth, flat_normals, flat_intensity = model.depth.ravel(), model.normals.ravel(), model_intensity.ravel()
    for chunk in prange(CHUNKS):
        total = np.zeros(TERMS, np.float64)
        points = np.empty((3, width), np.float32)
        places = np.empty((2, width), np.float32)
        pixels = np.empty(width, np.int32)
        matched = np.empty(width, np.float32)
        J = np.empty((6, terms), np.float32)
        w, r, weighted = np.empty(terms, np.float32), np.empty(terms, np.float32), np.empty(terms, np.float32)
        for v in range(chunk * height // CHUNKS, (chunk + 1) * height // CHUNKS):
            _project(depth, v, fx, fy, cx, cy, model, R, t, points, places, pixels)
            visible, weighed, close, behind = _add_geometry(
                depth, normals, v, model, flat_depth, flat_normals, R, weights, points, pixels, matched, J, w, r
            )
            total[27] += visible
            total[28] += weighed
            total[29] += close
            total[30] += behind
            if terms > width:
                weighed, darker, compared = _add_photometry(
                    intensity,
                    v,
                    model,
                    model_intensity,
                    flat_intensity,
                    inverse_scale,
                    weights,
                    brightness,
                    points,
                    places,
                    matched,
                    J,
                    w,
                    r,
                )
                total[31] += weighed
                total[32] += np.float64(darker)
                total[33] += compared
            _add_row(J, w, r, weighted, total)
        sums[chunk] = total


def linearise(
    level: PyramidLevel,
    model: ModelView,
    model_intensity: Float32,
    T_view_camera: Float64,
    weights: Weights,
    brightness: float,
) -> NormalEquations:
    """The normal equations of E at T_view_camera for one pyramid level of the frame.

    `model_intensity` (h, w) is the view's intensity at that level's resolution, negative where nothing is mapped.
    """
    sums = np.empty((CHUNKS, TERMS))
    camera: Camera = level.camera
    scale = round(model.depth.shape[1] / model_intensity.shape[1])  # a power of 2
    _accumulate(
        level.depth,
        level.intensity,
        level.normals,
        np.float32(camera.fx),
        np.float32(camera.fy),
        np.float32(camera.cx),
        np.float32(camera.cy),
        model,
        model_intensity,
        np.float32(1 / scale),
        np.ascontiguousarray(T_view_camera[:3, :3], np.float32),
        np.ascontiguousarray(T_view_camera[:3, 3], np.float32),
        weights,
        np.float32(brightness),
        sums,
    )
    total = sums.sum(axis=0)
    A = np.zeros((6, 6))
    A[np.triu_indices(6)] = total[:21]
    A = A + np.triu(A, 1).T
    return NormalEquations(
        A=A,
        b=total[21:27],
        visible=int(total[27]),
        matched=int(total[28]) if weights.depth_weight > 0 else int(total[31]),
        close=int(total[29]),
        behind=int(total[30]),
        brightness=float(total[32] / max(total[33], 1)),
    )
