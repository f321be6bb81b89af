"""Ground-truth instances that a map contains more than once.

If the pose of the camera has drifted when it returns to an object, the map contains the object twice, apart from each
other. A comparison with the true surface misses this, because the copies may be far from it. Therefore, the instance
images of the frames define the true instance of each map vertex, from the poses with which the frames were mapped.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from framework.data import Float32, Int32, Int64
from framework.datasets.ground_truth.scene_truth import LabeledDepth
from framework.geometry import inverse, project, transform

MIN_FRACTION = 0.25  # minimum fraction of the vertices of a true instance that each of its copies covers
MIN_VERTICES = 20  # minimum number of observed vertices of a true instance
TOLERANCE, TOLERANCE_PER_DEPTH = 0.03, 0.02  # m and m per m, maximum distance of a vertex from the depth reading
UNOBSERVED = -1
LARGEST_ID = 2**20  # upper bound of the true ids, for keys of pairs


def observed_labels(vertices: Float32, views: Iterable[LabeledDepth]) -> Int32:
    """Return the true instance (V,) of each vertex, seen most often in the views; 0 = none, UNOBSERVED = not seen.

    Args:
        vertices: The vertices (V, 3) of the map, m.
        views: Depth and instance images, with the poses in the world frame of the map.
    """
    keys, votes = np.zeros(0, np.int64), np.zeros(0, np.int64)
    for view in views:
        seen = _seen(vertices, view)
        keys, inverse_of = np.unique(np.concatenate([keys, seen]), return_inverse=True)
        votes = np.bincount(inverse_of, np.concatenate([votes, np.ones(len(seen), np.int64)])).astype(np.int64)
    order = np.lexsort((-keys, votes, keys // LARGEST_ID))  # the last entry of a vertex has most votes and the least id
    vertex = keys[order] // LARGEST_ID
    is_last = np.append(vertex[1:] != vertex[:-1], True) if len(vertex) else np.zeros(0, np.bool_)
    labels = np.full(len(vertices), UNOBSERVED, np.int32)
    labels[vertex[is_last]] = keys[order][is_last] % LARGEST_ID
    return labels


def doubled_instances(true_ids: Int32, instance_ids: Int32, likely: Collection[int]) -> list[int]:
    """Return the true instances of which at least two likely instances each cover MIN_FRACTION of the vertices.

    Args:
        true_ids: The true instance (V,) of each vertex, from `observed_labels`.
        instance_ids: The instance (V,) of the map at each vertex, 0 = none.
        likely: The instances of the map that are counted.
    """
    pairs, counts = np.unique(np.stack([true_ids, instance_ids]), axis=1, return_counts=True)
    sizes = dict(zip(*np.unique(true_ids, return_counts=True), strict=True))
    copies: dict[int, int] = {}
    for (true_id, instance_id), count in zip(pairs.T.tolist(), counts.tolist(), strict=True):
        if true_id > 0 and instance_id in likely and sizes[true_id] >= MIN_VERTICES:
            copies[true_id] = copies.get(true_id, 0) + (count >= MIN_FRACTION * sizes[true_id])
    return sorted(true_id for true_id, number in copies.items() if number > 1)


def _seen(vertices: Float32, view: LabeledDepth) -> Int64:
    """Return LARGEST_ID times the index of each vertex in the view, plus the true instance at its pixel."""
    points = transform(inverse(view.T_world_camera), vertices)
    ahead = np.flatnonzero(points[:, 2] > 0)
    pixels = np.rint(project(view.camera, points[ahead])).astype(np.int64)
    height, width = view.depth.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    ahead, (u, v) = ahead[inside], pixels[inside].T
    z, reading = points[ahead, 2], view.depth[v, u]
    is_seen = (reading > 0) & (np.abs(z - reading) < TOLERANCE + TOLERANCE_PER_DEPTH * reading)
    return np.asarray(ahead[is_seen] * LARGEST_ID + view.instance_ids[v, u][is_seen], np.int64)
