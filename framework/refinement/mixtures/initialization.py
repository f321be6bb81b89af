"""Where expectation maximization and k-means start: from mask and ring, each cut into groups by place."""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Float64, Int32
from framework.refinement.mixtures.initialization_kernels import start_all
from framework.refinement.mixtures.lloyd_iterations import depth_groups
from framework.refinement.neighborhood import Neighborhoods


def start_labels(around: Neighborhoods, log_odds: Float32, object_components: int, background_components: int) -> Int32:
    """(S,) the component that each point starts in: the object's come first, then the background's.

    Points of the mask whose `log_odds` (S,) do not speak against the object start in the nearest of the object's
    groups, points of the ring in the nearest of the background's. The border of the mask, as far in as it is expected
    to bleed, starts in the nearest group of the ring.
    """
    labels = np.empty(len(around.points_camera), np.int32)
    start_all(
        around.points_camera,
        log_odds,
        around.starts,
        around.mask_counts,
        object_components,
        background_components,
        labels,
    )
    return labels


def start_centers(around: Neighborhoods, object_centers: int, background_centers: int) -> Float64:
    """(N, object_centers + background_centers, 3) the means of mask and ring, each cut into equal parts by depth."""
    of_ring = around.of_ring
    mask_starts = np.concatenate([[0], np.cumsum(around.mask_counts)])
    ring_starts = np.concatenate([[0], np.cumsum(around.ring_counts)])
    objects = depth_groups(around.points_camera[~of_ring], mask_starts, object_centers)
    background = depth_groups(around.points_camera[of_ring], ring_starts, background_centers)
    return np.concatenate([objects, background], axis=1)
