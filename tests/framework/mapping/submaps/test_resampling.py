"""Tests for the rigid motion of a layer, compared with a slow reference and exact geometry."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Float64
from framework.mapping.labels.vertex_labels_kernels import REACH
from framework.mapping.submaps.layer import Layer
from framework.mapping.submaps.resampling import resampled
from framework.mapping.voxels.meshing import MAX_JUMP, SurfaceNets
from framework.mapping.voxels.voxel_grid_kernels import UNSEEN
from tests.support import registered
from tests.support.scenes.analytic_scene import room, walk
from tests.support.true_masks import fuse_masks, masks_of

VOXEL = 0.08  # m


@pytest.fixture(scope="module")
def layer() -> Layer:
    """A map of the analytic room with labels."""
    fuser = registered.built("fuser", "bayesian_tsdf", f"fuser.voxel_size={VOXEL}")
    for k, T in enumerate(walk(4)):
        frame = room().frame(T, k)
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3)
    return fuser.scene.submaps.visible


def motion(shift: tuple[float, float, float], rotvec: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Float64:
    """Return a motion with a shift in voxels and a rotation vector in rad."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = np.array(shift) * VOXEL
    return T


class Voxel(NamedTuple):
    """An observed voxel."""

    distance: int  # stored units
    weight: int
    color: int
    best: int  # most likely instance, 0 = none
    ids: tuple[int, ...]  # instance slots


def voxels(layer: Layer) -> dict[tuple[int, int, int], Voxel]:
    """Return the observed voxels by their coordinates."""
    grid, found = layer.voxels.grid, {}
    evidence = layer.labels.evidence
    for block in range(layer.voxels.block_count):
        for n in np.flatnonzero(grid.tsdf[block] != UNSEEN):
            corner = 8 * grid.block_coords[block]
            place = tuple((corner + np.array([n & 7, (n >> 3) & 7, n >> 6])).tolist())
            row = grid.label_row[block]
            voxel = evidence.labeled[row, n] if row >= 0 else -1
            ids = tuple(evidence.instance_ids[voxel].tolist()) if voxel >= 0 else ()
            best = ids[0] if voxel >= 0 and evidence.instance_value[voxel, 0] > 0 else 0
            stored = (int(array[block, n]) for array in (grid.tsdf, grid.weight, grid.color))
            found[place] = Voxel(*stored, best, ids)
    return found


@pytest.mark.parametrize("shift", [(0, 0, 0), (3, -11, 8), (-1, 0, 64)])
def test_resampled_whole_voxels_copies_voxels(layer: Layer, shift: tuple[int, int, int]) -> None:
    before, after = voxels(layer), voxels(resampled(layer, motion(shift)))
    assert after == {tuple(np.add(place, shift).tolist()): values for place, values in before.items()}


@pytest.mark.parametrize("rotvec", [(0.02, -0.05, 0.03), (0.5, -0.7, 0.4), (0.0, 0.0, 2.5)])
def test_resampled_equals_slow_reference(layer: Layer, rotvec: tuple[float, float, float]) -> None:
    T = motion((0.3, -2.6, 5.1), rotvec)
    before, after = voxels(layer), voxels(resampled(layer, T))
    most_jump = MAX_JUMP * VOXEL / float(layer.voxels.grid.tsdf_unit)
    T_old_new = np.linalg.inv(T)
    rng = np.random.default_rng(0)
    for index in rng.choice(len(after), 400, replace=False):
        place = list(after)[index]
        point = T_old_new[:3, :3] @ place + T_old_new[:3, 3] / VOXEL
        corner, rest = np.floor(point).astype(int), point - np.floor(point)
        corners = []
        for c in np.ndindex(2, 2, 2):
            portion = float(np.prod(np.where(c, rest, 1 - rest)))
            if (voxel := before.get(tuple((corner + c).tolist()))) is not None:
                corners.append((portion, voxel))
        total = sum(portion for portion, _ in corners)
        assert total >= 0.5
        distances = [voxel.distance for _, voxel in corners]
        if max(distances) - min(distances) > most_jump:
            corners, total = [(1.0, max(corners)[1])], 1.0
        new = after[place]
        distance = sum(p * voxel.distance for p, voxel in corners) / total
        assert new.distance == pytest.approx(distance, abs=0.501)
        assert new.weight == pytest.approx(sum(p * voxel.weight for p, voxel in corners) / total, abs=0.501)
        assert new.ids == elected(corners, distance, int(REACH * VOXEL / float(layer.voxels.grid.tsdf_unit))).ids


def elected(corners: list[tuple[float, Voxel]], distance: float, reach: float) -> Voxel:
    """Return the voxel whose labels a voxel at a distance from the surface gets, see `resample`."""
    near = [(portion, voxel) for portion, voxel in corners if abs(voxel.distance) <= reach]
    if abs(distance) > reach or not near:
        return max(corners)[1]
    votes: Counter[int] = Counter()
    for portion, voxel in near:
        votes[voxel.best] += portion
    winner = max(votes, key=lambda k: votes[k])
    return max(one for one in near if one[1].best == winner)[1]


def test_resampled_surface_is_moved_surface(layer: Layer) -> None:
    T = motion((0.4, 1.7, -3.2), (0.1, 0.2, -0.05))
    vertices = SurfaceNets(resampled(layer, T).voxels).extract().vertices
    back = (vertices - T[:3, 3]) @ T[:3, :3]
    before = room().distance(SurfaceNets(layer.voxels).extract().vertices)
    assert np.median(room().distance(back)) < np.median(before) + 0.05 * VOXEL
    assert np.quantile(room().distance(back), 0.99) < np.quantile(before, 0.99) + 0.3 * VOXEL


def test_resampled_back_and_forth_keeps_surface(layer: Layer) -> None:
    T = motion((0.5, 0.5, 0.5), (0.03, 0.0, 0.0))
    again = resampled(resampled(layer, T), np.linalg.inv(T))
    before, after = (SurfaceNets(one.voxels).extract().vertices for one in (layer, again))
    assert 0.9 < len(after) / len(before) < 1.05
    assert np.median(room().distance(after)) < np.median(room().distance(before)) + 0.1 * VOXEL
