"""Alignment of a frame to a view of the map.

The energy has a point-to-plane and a photometric term, as in ElasticFusion (Whelan et al., 2015):

    E(xi) = sum_i w_i (n_i . (T p_i - q_i))^2 + lambda sum_i v_i (I(pi(T p_i)) - I_frame,i)^2

T = T_view_camera moves the points p_i of the frame into the view. The pixel of a point in the view is pi(T p_i), where
pi is the projection. There, the model has the point q_i, the normal n_i and the intensity I in [0, 1]. A Gauss-Newton
step is a twist xi in the camera frame of the view, which changes T to exp(xi) T.

The weights w_i and v_i are Tukey's biweights, and lambda is `color_weight`. Residuals are divided by their expected
noise. Beyond the depth FAR, depth errors are correlated over whole image regions and do not average out, so their
standard deviation is increased. Beyond RANGE, the maximum depth of structured-light cameras, standard deviations and
gates are proportional to depth.

`LinearWeights` replaces Tukey's weights with those in the published code of VoxelHashing, for residuals in m and in [0,
1]. They depend on the distance d of p_i from q_i, the depth z of p_i and the intensity difference dI:

    w_i = max(0, ((1 - d / max_distance) + (1 - z / max_depth)) / 2)
    v_i = max(0, 1 - |dI| / max_intensity_difference)

The kernels process points in batches of a fixed size, in loops without branches that the compiler vectorizes. Each sum
has several lanes, so that every compilation rounds identically.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Float32, Float64, SurfaceView
from framework.tracking.alignment_kernels import (
    BRIGHTNESS,
    CHUNKS,
    COLOR,
    ENERGY,
    ROW,
    SUMS,
    TERMS,
    accumulate,
    smooth_normals,
    turn_normals,
)
from framework.tracking.pyramid import PyramidLevel, intrinsics


def _matrix_sums() -> npt.NDArray[np.int64]:
    """Return the index (6, 6) of each matrix element in the array of sums."""
    indices = np.empty((6, 6), np.int64)
    for row in range(6):
        columns = (row + np.arange(4)) % 6
        indices[row, columns] = indices[columns, row] = row * ROW + np.arange(4)
    return indices


MATRIX_SUMS = _matrix_sums()


class ModelView(NamedTuple):
    """A view of the map, to which frames are aligned."""

    depth: Float32  # (H, W) m, 0 = nothing mapped
    normals: Float32  # (3, H, W) unit normals in the camera frame of the view; 0 = nothing mapped
    fx: np.float32  # px, as cx, cy and fy
    fy: np.float32
    cx: np.float32
    cy: np.float32


class FrameView(NamedTuple):
    """One pyramid level of a frame.

    The tuple is flat because parallel kernels do not accept nested tuples.
    """

    depth: Float32  # (H, W) m, 0 = no reading
    intensity: Float32  # (H, W) in [0, 1]
    normals: Float32  # (3, H, W) unit normals in the camera frame; 0 = unknown
    fx: np.float32  # px, as cx, cy and fy
    fy: np.float32
    cx: np.float32
    cy: np.float32


def model_view(view: SurfaceView) -> ModelView:
    """Return the model view for a rendered view of the map."""
    normals = np.empty((3, *view.depth.shape), np.float32)
    turn_normals(view.normals_world, np.ascontiguousarray(view.T_world_camera[:3, :3].T, np.float32), normals)
    return ModelView(view.depth, normals, *intrinsics(view.camera))


def smoothed(model: ModelView, level: int) -> ModelView:
    """Return the model with smoothed normals for a pyramid level.

    In a new map, normals are noisy, and noisy normals penalize motion along the surface.
    """
    if level == 0:
        return model
    # mean over squares of side 2^(level + 1) - 1 px
    row_sums, normals = np.empty_like(model.normals), np.empty_like(model.normals)
    smooth_normals(model.normals, 2**level - 1, row_sums, normals)
    return model._replace(normals=normals)


class Weights(NamedTuple):
    """Weights of residuals and limits for matching points."""

    max_distance: np.float32  # maximum distance of a point from its model point, m; proportional to depth beyond RANGE
    close_distance: np.float32  # maximum depth difference for agreement with the model, m; at least 3 sigma
    min_normal_dot: np.float32  # minimum cosine between the normals of frame and model
    geometric_scale: np.float32  # geometric residual with Tukey's weight 0, in standard deviations
    photometric_scale: np.float32  # photometric residual with Tukey's weight 0, in standard deviations
    intensity_noise: np.float32  # standard deviation of an intensity difference; intensities are in [0, 1]
    color_weight: np.float32  # lambda; 0 = geometry only
    depth_weight: np.float32  # weight of the geometric term; 0 = color only


class LinearWeights(NamedTuple):
    """Limits of the linear weights, which replace Tukey's weights."""

    max_depth: np.float32  # maximum depth z_max, m
    # intensity difference at which the weight reaches 0; intensities are in [0, 1]
    max_intensity_difference: np.float32


class NormalEquations(NamedTuple):
    """The normal equations A xi = -b of a Gauss-Newton step, and counts of points.

    The twist xi is in m and rad.
    """

    A: Float64  # (6, 6) J^T W J for the residuals r with the weights W
    b: Float64  # (6,) J^T W r
    visible: int  # number of points on a mapped part of the view
    matched: int  # number of visible points with a nonzero weight
    close: int  # number of visible points at a depth that agrees with the model
    behind: int  # number of visible points clearly behind the model, which should occlude them
    A_color: Float64  # (6, 6) part of A from the photometric term; 0 for LinearWeights
    energy: float  # sum of w r^2 over the residuals r of the geometric term; of both terms for LinearWeights
    color_energy: float  # sum of v r^2 over the residuals r of the photometric term; 0 for LinearWeights
    matched_colors: int  # number of visible points with a nonzero photometric weight
    brightness: float  # mean of frame minus model intensity; nonzero after a change in exposure


def linearize(
    level: PyramidLevel, model: ModelView, model_intensity: Float32, T_view_camera: Float64, weights: Weights,
    brightness: float, linear: LinearWeights | None = None,
) -> NormalEquations:  # fmt: skip
    """Return the normal equations for one pyramid level of a frame.

    Args:
        level: The pyramid level of the frame.
        model: The view of the map.
        model_intensity: The intensity (h, w) of the view at the resolution of the level, in [0, 1]; negative = not
            mapped.
        T_view_camera: The current pose (4, 4) of the frame in the view.
        weights: The weights and limits.
        brightness: The mean of frame minus model intensity, which is compensated.
        linear: The limits of the linear weights, or None for Tukey's weights.
    """
    sums = np.empty((CHUNKS, TERMS))
    scale = 1 << round(math.log2(model.depth.shape[1] / model_intensity.shape[1]))  # halving drops odd columns
    accumulate(
        FrameView(level.depth, level.intensity, level.normals, *intrinsics(level.camera)), model, model_intensity,
        np.float32(1 / scale), np.ascontiguousarray(T_view_camera[:3, :3], np.float32),
        np.ascontiguousarray(T_view_camera[:3, 3], np.float32), weights, linear, level.sensor.noise,
        np.float32(brightness), sums,
    )  # fmt: skip
    total = sums.sum(axis=0)
    visible, matched, close, behind, matched_colors, compared = (int(count) for count in total[SUMS:])
    geometry, color = total[:COLOR], total[COLOR:BRIGHTNESS]
    return NormalEquations(
        A=geometry[MATRIX_SUMS] + color[MATRIX_SUMS],
        b=geometry[ROW - 1 : ENERGY : ROW] + color[ROW - 1 : ENERGY : ROW],
        visible=visible,
        matched=matched if weights.depth_weight > 0 else matched_colors,
        close=close,
        behind=behind,
        A_color=color[MATRIX_SUMS],
        energy=float(geometry[ENERGY]),
        color_energy=float(color[ENERGY]),
        matched_colors=matched_colors,
        brightness=float(total[BRIGHTNESS] / max(compared, 1)),
    )
