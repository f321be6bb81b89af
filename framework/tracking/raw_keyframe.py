"""Raw keyframes: a recent frame as a second model of the alignment.

The map smooths structure below its voxel size, which biases each alignment. Because the map is updated at the biased
poses, the estimated pose of a stationary camera drifts. A raw keyframe has no such bias. Its normal equations are added
to those of the map. The adjoint Ad of T_key_view converts them to a left twist of T_view_camera:

    A <- A + w Ad^T A_key Ad,    b <- b + w Ad^T b_key

The keyframe is compared at half the finest resolution, which is less noisy and faster. At the finest level, w = 4
compensates for the smaller number of points. The coarsest level uses the map alone. The weight decreases with the
distance from the keyframe and reaches 0 at USED_DISTANCE. Beyond it, frames are aligned to the map alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from framework.data import Float32, Float64
from framework.geometry import adjoint, inverse
from framework.tracking.alignment import LinearWeights, ModelView, NormalEquations, Weights, linearize, smoothed
from framework.tracking.depth_scale import DepthScale
from framework.tracking.pyramid import PyramidLevel, intrinsics

NEW_DISTANCE = 0.1  # distance at which a frame replaces the keyframe, m and rad
USED_DISTANCE = 0.15  # distance at which the weight of the keyframe reaches 0, m and rad
COMPARED = 1  # level at which frames and the keyframe are compared: halvings of the finest resolution


@dataclass(frozen=True)
class RawKeyframe:
    """A frame at its estimated pose, used as a model for the alignment of later frames."""

    T_world_camera: Float64  # (4, 4)
    model: ModelView  # at level COMPARED
    intensity: Float32  # (h, w) at level COMPARED, -1 = no depth

    @classmethod
    def of(cls, levels: Sequence[PyramidLevel], T_world_camera: Float64, scattered: bool = False) -> RawKeyframe:
        """Return the raw keyframe for a frame.

        Args:
            levels: The image pyramid of the frame, finest level first.
            T_world_camera: The camera pose (4, 4).
            scattered: True to smooth the normals, because many isolated pixels have no depth.
        """
        level = levels[COMPARED]
        model = smoothed(ModelView(level.depth, level.normals, *intrinsics(level.camera)), int(scattered))
        return cls(T_world_camera, model, np.where(level.depth > 0, level.intensity, np.float32(-1)))


class KeyframeTerm(NamedTuple):
    """The term of a raw keyframe in the normal equations."""

    keyframe: RawKeyframe
    T_key_view: Float64  # (4, 4)
    Ad: Float64  # (6, 6) adjoint of T_key_view
    weight: float  # in [0, 1]

    @classmethod
    def at(cls, keyframe: RawKeyframe | None, T_world_view: Float64, scale: DepthScale) -> KeyframeTerm | None:
        """Return the term for aligning a frame to a view of the map.

        Return None without a keyframe, or if the keyframe is too far away.
        """
        if keyframe is None:
            return None
        distance = scale.distance(keyframe.T_world_camera, T_world_view)
        if distance >= USED_DISTANCE:
            return None
        T_key_view = inverse(keyframe.T_world_camera) @ T_world_view
        weight = min((USED_DISTANCE - distance) / (USED_DISTANCE - NEW_DISTANCE), 1.0)
        return cls(keyframe, T_key_view, adjoint(T_key_view), weight)

    def linearized(
        self, levels: Sequence[PyramidLevel], level: int, T_view_camera: Float64, weights: Weights, brightness: float,
        linear: LinearWeights | None,
    ) -> NormalEquations:  # fmt: skip
        """Return the weighted normal equations of the keyframe for a left twist of T_view_camera.

        Args:
            levels: The image pyramid of the frame, finest level first.
            level: The level of the alignment, at most COMPARED.
            T_view_camera: The current pose (4, 4) of the frame in the view.
            weights: The weights and limits.
            brightness: The mean of frame minus model intensity.
            linear: The limits of the linear weights, or None for Tukey's weights.
        """
        own = linearize(
            levels[COMPARED], self.keyframe.model, self.keyframe.intensity, self.T_key_view @ T_view_camera, weights,
            brightness, linear,
        )  # fmt: skip
        weight = self.weight * 4 ** (COMPARED - level)
        return own._replace(
            A=weight * self.Ad.T @ own.A @ self.Ad,
            b=weight * self.Ad.T @ own.b,
            A_color=weight * self.Ad.T @ own.A_color @ self.Ad,
            energy=weight * own.energy,
            color_energy=weight * own.color_energy,
        )
