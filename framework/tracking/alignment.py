"""Aligning a frame to a view of the map: point-to-plane and photometric terms, as ElasticFusion (Whelan et al. 2015).

    E(xi) = sum_i w_i (n_i . (T p_i - q_i))^2 + lambda sum_i v_i (I(pi(T p_i)) - I_frame,i)^2

The frame's points p_i are moved by T = T_view_camera and projected into the view, which gives each its model point q_i
with normal n_i, and its model intensity. Residuals are divided by their expected noise, so that both terms count
standard deviations; w_i and v_i are Tukey's biweights. Beyond `FAR` a depth's standard deviation is its noise times
depth / FAR: what a structured-light camera gets wrong there is wrong in whole regions of the image and does not average
out. Gauss-Newton steps are twists of the view's frame: T <- exp(xi) T.

Points are done in batches of a fixed size, in passes that the compiler vectorises: loops without branches over fields
of one array, and other loops that only fetch from images. A point that does not count has weight 0. Sums of points are
kept in lanes: vectors then need no reordered additions (fast math), so that every compilation rounds alike.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Camera, Float32, Float64, SurfaceView
from framework.tracking.alignment_kernels import CHUNKS, ROW, SUMS, TERMS, accumulate, smooth_normals, turn_normals
from framework.tracking.pyramid import PyramidLevel


def _places() -> npt.NDArray[np.int64]:
    """(6, 6) where the numbers of the symmetric matrix stand among the sums."""
    places = np.empty((6, 6), np.int64)
    for i in range(6):
        following = (i + np.arange(4)) % 6
        places[i, following] = places[following, i] = i * ROW + np.arange(4)
    return places


PLACES = _places()


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
    turn_normals(view.normals_world, np.ascontiguousarray(view.T_world_camera[:3, :3].T, np.float32), normals)
    camera = view.camera
    return ModelView(view.depth, normals, *(np.float32(k) for k in (camera.fx, camera.fy, camera.cx, camera.cy)))


def smoothed(model: ModelView, level: int) -> ModelView:
    """The model for `level` halvings of its resolution: its normals are the means of squares about as large.

    A young map is noisy, and a normal's noise looks like a surface that resists motions along the real one.
    """
    if level == 0:
        return model
    across, normals = np.empty_like(model.normals), np.empty_like(model.normals)
    smooth_normals(model.normals, 2**level - 1, across, normals)
    return model._replace(normals=normals)


class Weights(NamedTuple):
    """How residuals are weighed."""

    max_distance: np.float32  # m, of a point from its model point
    close_distance: np.float32  # m, or 3 standard deviations: a reading this far from the model's depth agrees with it
    min_normal_dot: np.float32  # cosine between the frame's and the model's normal
    geometric_scale: np.float32  # standard deviations at which Tukey's weight reaches 0
    photometric_scale: np.float32  # likewise
    intensity_noise: np.float32  # standard deviation of an intensity difference, of [0, 1]
    color_weight: np.float32  # lambda; 0 = geometry alone
    depth_weight: np.float32  # 0 = colour alone


class NormalEquations(NamedTuple):
    """The linearized problem, and what it is made of."""

    A: Float64  # (6, 6)
    b: Float64  # (6,)
    visible: int  # points that fall on a mapped part of the view
    matched: int  # of these, points with a weight
    close: int  # of the visible, points whose depth in the view agrees with the model's
    behind: int  # of the visible, points so far behind the model that they could not be seen through it
    brightness: float  # mean of frame - model intensity: the change of exposure


def linearize(
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
    scale = 1 << round(math.log2(model.depth.shape[1] / model_intensity.shape[1]))  # odd columns are dropped
    accumulate(
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
    visible, weighed, close, behind, weighed_colors, compared = (int(count) for count in total[SUMS:])
    return NormalEquations(
        A=total[PLACES],
        b=total[ROW - 1 : 6 * ROW : ROW].copy(),
        visible=visible,
        matched=weighed if weights.depth_weight > 0 else weighed_colors,
        close=close,
        behind=behind,
        brightness=float(total[SUMS - 1] / max(compared, 1)),
    )
