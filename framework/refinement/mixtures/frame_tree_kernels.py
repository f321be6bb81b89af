"""Kernels of frame_tree.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Int32
from framework.refinement.mixtures.gaussian import ABSENT, log_densities
from framework.refinement.mixtures.mixture_kernels import BLOCK
from framework.refinement.mixtures.mixture_tree_kernels import take_better


@njit(cache=True, nogil=True)
def keep_best_cluster(pixels: Int32, cluster: Int32, rank: Int32, owner: Int32, kept: Bool) -> None:
    """Keep a point only if its cluster has the lowest rank of all clusters at its pixel.

    Args:
        pixels: The pixels (P, 2), u and v, of the points.
        cluster: The cluster (P,) of each point, -1 = none.
        rank: The rank (N,) of each cluster.
        owner: The output (H, W), the cluster with the lowest rank at each pixel; initially -1.
        kept: The output (P,), True for points to keep.
    """
    for i in range(len(cluster)):
        k, u, v = cluster[i], pixels[i, 0], pixels[i, 1]
        if k >= 0 and (owner[v, u] < 0 or rank[k] < rank[owner[v, u]]):
            owner[v, u] = k
    for i in range(len(cluster)):
        kept[i] = cluster[i] >= 0 and owner[pixels[i, 1], pixels[i, 0]] == cluster[i]


@njit(cache=True, nogil=True, parallel=True)
def find_most_probable(points: Float32, rows: Float32, best: Int32) -> None:
    """Find the Gaussian with the largest weighted density at each point.

    Args:
        points: The points (S, 3), m.
        rows: The coefficients (M, 10) of the Gaussians, from coefficients().
        best: The output (S,), -1 = none. Ties go to the first Gaussian.
    """
    for block in prange((len(points) + BLOCK - 1) // BLOCK):
        begin = block * BLOCK
        n = min(BLOCK, len(points) - begin)
        xyz, densities = np.empty((3, n), np.float32), np.empty(n, np.float32)
        for i in range(n):
            for a in range(3):
                xyz[a, i] = points[begin + i, a]
        largest, own = np.full(n, ABSENT), np.full(n, -1, np.int32)
        for j in range(len(rows)):
            log_densities(xyz[0], xyz[1], xyz[2], rows[j], densities)
            take_better(densities, np.int32(j), largest, own)
        best[begin : begin + n] = own
