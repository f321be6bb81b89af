"""Aligning a frame to a view of the map: point-to-plane and photometric terms, eq. 2 of the method.

    E(xi) = sum_i w_i (n_i . (T p_i - q_i))^2 + lambda sum_i v_i (I(pi(T p_i)) - I_frame,i)^2

The frame's points p_i are moved by T = T_view_camera and projected into the view, which gives each its model point q_i
with normal n_i, and its model intensity. Residuals are divided by their expected noise, so that both terms count
standard deviations; w_i and v_i are Tukey's biweights. Gauss-Newton steps are twists of the view's frame: T <- exp(xi)
T.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from framework.data import Camera, Float32, Float64
from framework.tracking.pyramid import PyramidLevel

CHUNKS = 16  # of image rows, summed in order: the same sums whatever the number of threads
TERMS = 27 + 6  # of a chunk's sums: 21 + 6 of the normal equations, then the counts and squares below


class ModelView(NamedTuple):
    """The view of the map that frames are aligned to."""

    depth: Float32  # (H, W) m, 0 = nothing there
    normals: Float32  # (H, W, 3) in the view's camera frame
    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32


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
    matched: int  # of these, points near enough to their model point to be weighed
    residual: float  # root mean square of the matched points' distances, m
    brightness: float  # mean of frame - model intensity: the change of exposure


@njit(cache=True, nogil=True, forceinline=True)
def depth_noise(z):
    """Standard deviation (m) of a structured-light reading at depth z (m): Nguyen et al. 2012, eq. 3 (axial noise)."""
    return np.float32(0.0012) + np.float32(0.0019) * (z - np.float32(0.4)) * (z - np.float32(0.4))


@njit(cache=True, nogil=True, forceinline=True)
def _frame_normal(depth, u, v, inv_fx, inv_fy, cx, cy, z):
    """The normal of the frame's surface at a pixel, towards the camera, from its four neighbours; 0 if they differ."""
    zero = np.float32(0.0)
    if u < 1 or v < 1 or u >= depth.shape[1] - 1 or v >= depth.shape[0] - 1:
        return zero, zero, zero
    left, right, up, down = depth[v, u - 1], depth[v, u + 1], depth[v - 1, u], depth[v + 1, u]
    gap = np.float32(0.05) * z
    if min(min(left, right), min(up, down)) <= zero:
        return zero, zero, zero
    if max(max(abs(left - z), abs(right - z)), max(abs(up - z), abs(down - z))) > gap:
        return zero, zero, zero
    x = (np.float32(u) - cx) * inv_fx
    y = (np.float32(v) - cy) * inv_fy
    # tangents along u and v
    ax = (x + inv_fx) * right - (x - inv_fx) * left
    ay = y * (right - left)
    az = right - left
    bx = x * (down - up)
    by = (y + inv_fy) * down - (y - inv_fy) * up
    bz = down - up
    nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
    norm = np.sqrt(nx * nx + ny * ny + nz * nz)
    if norm == zero:
        return zero, zero, zero
    return nx / norm, ny / norm, nz / norm


@njit(cache=True, nogil=True, forceinline=True)
def _tukey(r, scale):
    """Tukey's biweight of a residual in standard deviations."""
    s = r / scale
    s = np.float32(1.0) - s * s
    return s * s if s > np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True, forceinline=True)
def _add(sums, J, r, w):
    """Adds w J^T J (upper triangle) and w J^T r to the sums."""
    n = 0
    for i in range(6):
        wj = w * J[i]
        for j in range(i, 6):
            sums[n] += np.float64(wj * J[j])
            n += 1
        sums[21 + i] += np.float64(wj * r)


@njit(cache=True, nogil=True, parallel=True)
def _accumulate(depth, intensity, fx, fy, cx, cy, model, model_intensity, level_scale, R, t, weights, brightness, sums):
    """Sums the normal equations over one pyramid level of the frame, by chunks of rows, into sums (CHUNKS, TERMS).

    `R`, `t` are T_view_camera. `level_scale` is the width of the view over that of model_intensity, a power of 2.
    """
    height, width = depth.shape
    model_height, model_width = model.depth.shape
    level_height, level_width = model_intensity.shape
    one = np.float32(1.0)
    half = np.float32(0.5)
    zero = np.float32(0.0)
    inv_fx, inv_fy = one / fx, one / fy
    inverse_scale = one / level_scale
    for chunk in prange(CHUNKS):
        total = np.zeros(TERMS, np.float64)
        J = np.empty(6, np.float32)
        for v in range(chunk * height // CHUNKS, (chunk + 1) * height // CHUNKS):
            for u in range(width):
                d = depth[v, u]
                if d <= zero:
                    continue
                x = (np.float32(u) - cx) * inv_fx * d
                y = (np.float32(v) - cy) * inv_fy * d
                px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * d + t[0]
                py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * d + t[1]
                pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * d + t[2]
                if pz <= np.float32(0.05):
                    continue
                inv_z = one / pz
                mu = model.fx * px * inv_z + model.cx
                mv = model.fy * py * inv_z + model.cy
                if not (mu > -half and mv > -half):
                    continue
                iu, iv = int(mu + half), int(mv + half)
                if iu >= model_width or iv >= model_height:
                    continue
                q = model.depth[iv, iu]
                if q <= zero:
                    continue
                total[27] += 1.0
                qx = (np.float32(iu) - model.cx) / model.fx * q
                qy = (np.float32(iv) - model.cy) / model.fy * q
                nx, ny, nz = model.normals[iv, iu, 0], model.normals[iv, iu, 1], model.normals[iv, iu, 2]
                ex, ey, ez = px - qx, py - qy, pz - q
                if ex * ex + ey * ey + ez * ez > weights.max_distance * weights.max_distance:
                    continue
                sigma = depth_noise(d)
                r = nx * ex + ny * ey + nz * ez
                if weights.depth_weight > zero:
                    fnx, fny, fnz = _frame_normal(depth, u, v, inv_fx, inv_fy, cx, cy, d)
                    dot = (
                        nx * (R[0, 0] * fnx + R[0, 1] * fny + R[0, 2] * fnz)
                        + ny * (R[1, 0] * fnx + R[1, 1] * fny + R[1, 2] * fnz)
                        + nz * (R[2, 0] * fnx + R[2, 1] * fny + R[2, 2] * fnz)
                    )
                    if dot > weights.min_normal_dot:
                        w = _tukey(r / sigma, weights.geometric_scale) * weights.depth_weight
                        if w > zero:
                            J[0], J[1], J[2] = nx, ny, nz
                            J[3], J[4], J[5] = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
                            w /= sigma * sigma
                            _add(total, J, r, w)
                            total[28] += 1.0
                            total[29] += np.float64(r * r)
                if weights.color_weight > zero:
                    # the level's intensity image, whose pixels are level_scale view pixels wide
                    lu = (mu + half) * inverse_scale - half
                    lv = (mv + half) * inverse_scale - half
                    ju, jv = int(np.floor(lu)), int(np.floor(lv))
                    if ju < 1 or jv < 1 or ju + 2 >= level_width or jv + 2 >= level_height:
                        continue
                    a, b = lu - np.float32(ju), lv - np.float32(jv)
                    i00, i10 = model_intensity[jv, ju], model_intensity[jv, ju + 1]
                    i01, i11 = model_intensity[jv + 1, ju], model_intensity[jv + 1, ju + 1]
                    if min(min(i00, i10), min(i01, i11)) < zero:
                        continue
                    value = (one - b) * ((one - a) * i00 + a * i10) + b * ((one - a) * i01 + a * i11)
                    gu = ((one - b) * (i10 - i00) + b * (i11 - i01)) * inverse_scale
                    gv = ((one - a) * (i01 - i00) + a * (i11 - i10)) * inverse_scale
                    change = value - intensity[v, u]
                    total[30] += 1.0
                    total[31] -= np.float64(change)
                    r = change + brightness
                    w = _tukey(r / weights.intensity_noise, weights.photometric_scale) * weights.color_weight
                    if w <= zero:
                        continue
                    gx = gu * model.fx * inv_z
                    gy = gv * model.fy * inv_z
                    gz = -(gx * px + gy * py) * inv_z
                    J[0], J[1], J[2] = gx, gy, gz
                    J[3], J[4], J[5] = py * gz - pz * gy, pz * gx - px * gz, px * gy - py * gx
                    w /= weights.intensity_noise * weights.intensity_noise
                    _add(total, J, r, w)
                    total[32] += 1.0
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
    _accumulate(
        level.depth,
        level.intensity,
        np.float32(camera.fx),
        np.float32(camera.fy),
        np.float32(camera.cx),
        np.float32(camera.cy),
        model,
        model_intensity,
        np.float32(round(model.depth.shape[1] / model_intensity.shape[1])),
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
        matched=int(total[28]) if weights.depth_weight > 0 else int(total[32]),
        residual=float(np.sqrt(total[29] / max(total[28], 1))),
        brightness=float(total[31] / max(total[30], 1)),
    )
