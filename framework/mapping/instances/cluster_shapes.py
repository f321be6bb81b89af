"""Centers and extents of the point clusters of a frame, from a sample of their points."""

from __future__ import annotations

import numpy as np

from framework.data import Float64, Int32, PointClusters

SAMPLED_POINTS = 20_000  # approximate number of points of a frame that are used


def cluster_centers(clusters: PointClusters) -> Float64:
    """Return the mean (N, 3) of a sample of the points of each cluster, m. It is NaN for clusters without points."""
    return _centers(*_sample(clusters), len(clusters))


def cluster_shapes(clusters: PointClusters) -> tuple[Float64, Float64]:
    """Return the centers (N, 3) and the root mean squared distances (N,) of the points of each cluster to them, m.

    Both are NaN for clusters without points.
    """
    points, cluster = _sample(clusters)
    centers = _centers(points, cluster, len(clusters))
    squares = np.bincount(cluster, np.square(points - centers[cluster]).sum(axis=1), len(clusters))
    return centers, np.sqrt(squares / _counts(cluster, len(clusters)))


def _sample(clusters: PointClusters) -> tuple[Float64, Int32]:
    """Return evenly selected points (P, 3) of clusters, m, and the cluster (P,) of each."""
    step = max(1, len(clusters.points_world) // SAMPLED_POINTS)
    points, cluster = clusters.points_world[::step].astype(np.float64), clusters.cluster[::step]
    return points[cluster >= 0], cluster[cluster >= 0]


def _counts(cluster: Int32, count: int) -> Float64:
    """Return the number of points (count,) of each cluster, NaN = none."""
    counts = np.bincount(cluster, minlength=count)
    return np.where(counts, counts, np.nan)


def _centers(points: Float64, cluster: Int32, count: int) -> Float64:
    sums = np.stack([np.bincount(cluster, points[:, axis], count) for axis in range(3)], axis=1)
    return np.asarray(sums / _counts(cluster, count)[:, None])
