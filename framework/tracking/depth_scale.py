"""Typical depth of a frame, which scales limits for translations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64
from framework.geometry import inverse, rotation_angle
from framework.tracking.alignment_kernels import RANGE


@dataclass(frozen=True)
class DepthScale:
    """The typical depth of a frame.

    Translations and rotations are compared by the angle by which they move points at this depth. Limits in m are valid
    up to the depth RANGE. Beyond it, they are proportional to depth, as errors of readings are.
    """

    depth: float = 1.0  # typical depth, m, > 0

    @classmethod
    def of(cls, depth: Float32) -> DepthScale:
        """Return the scale of a depth image (H, W), m, 0 = no reading."""
        readings = depth[depth > 0]
        return cls(float(np.median(readings))) if readings.size else cls()

    @property
    def growth(self) -> float:
        """Factor for limits in m, >= 1."""
        return max(1.0, self.depth / RANGE)

    @property
    def units(self) -> Float64:
        """The units (6,) of a twist without units: the typical depth, m, for translations, and 1 rad for rotations."""
        return np.array([self.depth] * 3 + [1.0] * 3)

    def length(self, xi: Float64) -> float:
        """Return the largest absolute entry of a twist (6,), m and rad, with translations divided by `growth`."""
        return float(max(np.abs(xi[:3]).max() / self.growth, np.abs(xi[3:]).max()))

    def distance(self, T_world_a: Float64, T_world_b: Float64) -> float:
        """Return the larger of the translation, m, and the rotation, rad, between two poses.

        The translation is divided by `growth`.
        """
        T_a_b = inverse(T_world_a) @ T_world_b
        return max(float(np.linalg.norm(T_a_b[:3, 3])) / self.growth, rotation_angle(T_a_b[:3, :3]))

    def near(self, T_world_a: Float64, T_world_b: Float64, limit: float) -> bool:
        """Return True if the distance between two poses is below `limit`, m and rad."""
        return self.distance(T_world_a, T_world_b) < limit

    def without_units(self, A: Float64) -> Float64:
        """Return the information matrix (6, 6) with translations in units of the typical depth."""
        return A * np.outer(self.units, self.units)
