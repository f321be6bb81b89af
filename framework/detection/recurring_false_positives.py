"""Places of a room where a detector sees something that is not there: the same ones in all frames that show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float64, Frame, Int64
from framework.geometry import transform

CELL = 0.5  # m, the side of a place
STEP = 8  # px between the readings that are looked at
LEAST_READINGS = 4  # of a place in sight
KEYS = 2**30  # number of keys: positive, and negated an id that no instance has


@dataclass(frozen=True)
class GhostPlace:
    """A cell of the world that the frame shows, and the middle of its readings."""

    key: int  # in [1, KEYS], of the cell: the smaller, the more it looks like something
    u: float  # px
    v: float  # px
    z: float  # m


def ghost_places(frame: Frame, seed: int, count: int) -> list[GhostPlace]:
    """At most `count` places that `frame` shows on nothing that is an object of a known class, most striking first.

    Empty where the frame's pose is not known.
    """
    if count == 0 or frame.T_world_camera is None or frame.truth is None:
        return []
    v, u = (
        grid.ravel() for grid in np.mgrid[STEP // 2 : frame.camera.height : STEP, STEP // 2 : frame.camera.width : STEP]
    )
    z = frame.depth[v, u].astype(np.float64)
    objects = [i for i, name in frame.truth.class_names.items() if name is not None]
    usable = (z > 0) & ~np.isin(frame.truth.instance_ids[v, u], objects)
    u, v, z = u[usable], v[usable], z[usable]
    camera = frame.camera
    points_camera = np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], axis=1)
    cells = np.floor(transform(frame.T_world_camera, points_camera) / CELL).astype(np.int64)
    keys, cell, readings = np.unique(_keys(cells, seed), return_inverse=True, return_counts=True)
    middles = _means(np.stack([u, v, z], axis=1), cell, readings)
    places = [
        GhostPlace(int(key), *map(float, middle))
        for key, middle, n in zip(keys, middles, readings, strict=True)
        if n >= LEAST_READINGS
    ]
    return places[:count]


def _keys(cells: Int64, seed: int) -> Int64:
    """(N,) in [1, KEYS], of cells (N, 3): as good as random, by the finaliser of SplitMix64 (Steele et al. 2014)."""
    mixed = np.zeros(len(cells), np.uint64)
    for number in (np.full(len(cells), seed), *cells.T):
        mixed += number.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return np.asarray(mixed % np.uint64(KEYS) + np.uint64(1), np.int64)


def _means(values: Float64, group: Int64, counts: Int64) -> Float64:
    """The mean row (G, M) of each group of rows (N, M)."""
    sums = np.stack([np.bincount(group, column, len(counts)) for column in values.T], axis=1)
    return np.asarray(sums / counts[:, None], np.float64)
