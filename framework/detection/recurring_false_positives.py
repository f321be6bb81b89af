"""Simulation of false positives that recur at the same locations of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Frame, Int64
from framework.geometry import transform

CELL = 0.5  # side of a cell, m
STEP = 8  # distance between the sampled depth readings, px
MIN_READINGS = 4  # minimum number of readings in a visible cell
KEYS = 2**30  # number of keys; negated keys serve as instance ids, which are otherwise positive


@dataclass(frozen=True)
class FalsePositiveCell:
    """A visible grid cell in the world, with the mean position of its depth readings in the image."""

    key: int  # hash of the cell, in [1, KEYS]; cells are sorted by key
    u: float  # px, mean column of the readings
    v: float  # px, mean row of the readings
    z: float  # m, mean depth of the readings


def false_positive_cells(frame: Frame, seed: int, count: int) -> list[FalsePositiveCell]:
    """Return the visible grid cells at which false positives are simulated.

    Readings on objects of known class are ignored. The result is empty if the frame has no pose or no ground truth.

    Args:
        frame: The frame.
        seed: The seed of the random order in which cells are selected.
        count: The maximum number of cells.
    """
    if count == 0 or frame.T_world_camera is None or frame.truth is None:
        return []
    camera = frame.camera
    v, u = (grid.ravel() for grid in np.mgrid[STEP // 2 : camera.height : STEP, STEP // 2 : camera.width : STEP])
    z = frame.depth[v, u].astype(np.float64)
    objects = [i for i, name in frame.truth.class_names.items() if name is not None]
    usable = (z > 0) & ~np.isin(frame.truth.instance_ids[v, u], objects)
    u, v, z = u[usable], v[usable], z[usable]
    points_camera = np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], axis=1)
    cells = np.floor(transform(frame.T_world_camera, points_camera) / CELL).astype(np.int64)
    keys, cell, readings = np.unique(_keys(cells, seed), return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(cell, values, len(keys)) / readings for values in (u, v, z)], axis=1)
    often = readings >= MIN_READINGS
    found = zip(keys[often].tolist(), means[often].tolist(), strict=True)
    return [FalsePositiveCell(key, *mean) for key, mean in found][:count]


def _keys(cells: Int64, seed: int) -> Int64:
    """Hash grid cells (N, 3) to keys (N,) in [1, KEYS]."""
    mixed = np.zeros(len(cells), np.uint64)  # finalizer of SplitMix64 (Steele et al. 2014)
    for number in (np.full(len(cells), seed), *cells.T):
        mixed += number.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return np.asarray(mixed % np.uint64(KEYS) + np.uint64(1), np.int64)
