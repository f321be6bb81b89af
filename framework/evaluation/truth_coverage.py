"""Overlap of a map with the surface of the ground truth, to detect different world frames.

A map in the world frame of the ground truth covers much of the annotated surface, or lies on it. A partial map has few
points near a complete ground truth, and the map of a partial annotation has many points elsewhere. Only if both
fractions are small, the two surfaces have different world frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from framework.data import Float32
from framework.evaluation.instances import MAX_DISTANCE

SAMPLES = 20_000  # maximum number of points of each surface whose nearest neighbor is searched
# minimum of the larger fraction; real maps of 3 to 25 frames have at least 0.97, shifts by 15 cm 0.7, and other wrong
# world frames 0.1 (median)
MIN_OVERLAP = 0.75


@dataclass(frozen=True)
class TruthCoverage:
    """Fractions of points within MAX_DISTANCE of the other surface. They are 0 without points."""

    ground_truth: float  # of the ground-truth points, near the map
    map: float  # of the map vertices, near the ground truth

    @classmethod
    def of(cls, map_points: Float32, truth_points: Float32) -> TruthCoverage:
        """Return the coverage of the points of a map (V, 3) and of a ground truth (G, 3) in one world frame, m."""
        return cls(_near(truth_points, map_points), _near(map_points, truth_points))

    @property
    def plausible(self) -> bool:
        """True if the two surfaces can have the same world frame."""
        return max(self.ground_truth, self.map) >= MIN_OVERLAP

    def __str__(self) -> str:
        near = f"within {100 * MAX_DISTANCE:g} cm of"
        return f"{self.ground_truth:.0%} of the ground truth {near} the map, and {self.map:.0%} of the map {near} it"


def _near(points: Float32, surface: Float32) -> float:
    """Return the fraction of evenly chosen points (P, 3) within MAX_DISTANCE of a surface (S, 3)."""
    if not len(points) or not len(surface):
        return 0.0
    chosen = points[:: -(-len(points) // SAMPLES)]
    tree = cKDTree(surface, balanced_tree=False)
    distance, _ = tree.query(chosen, distance_upper_bound=MAX_DISTANCE, workers=numba.get_num_threads())
    return float(np.isfinite(distance).mean())
