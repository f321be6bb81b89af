"""Tests for the voxels of map files, compared with a voxel-by-voxel reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from framework.errors import DataError
from framework.mapping.voxels.packed_voxels import PackedVoxels, checked_voxels, pack_voxels, unpack_voxels
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import UNSEEN

pytestmark = pytest.mark.integration

COORDS = np.array([[0, 0, 0], [1, 0, 0], [-3, 7, 2], [4, 4, 4]], np.int32)


@pytest.fixture
def voxels() -> VoxelGrid:
    """Return an unobserved, a fully observed and two partly observed blocks. Some observed voxels have no color."""
    rng, grid = np.random.default_rng(0), empty()
    seen = rng.random((4, 512)) < np.array([0, 1, 0.5, 0.02])[:, None]
    colored = seen & (rng.random((4, 512)) < 0.6)
    grid.grid.tsdf[:4][seen] = rng.integers(-100, 100, seen.sum())
    grid.grid.weight[:4][seen] = rng.integers(1, 2**16, seen.sum())
    grid.grid.color[:4][colored] = rng.integers(1, 2**32, colored.sum(), np.uint32)
    grid.grid.tsdf[1, 5] = UNSEEN  # has a weight
    return grid


def empty() -> VoxelGrid:
    grid = VoxelGrid(0.01, 0.05, 10)
    grid.allocate(COORDS)
    return grid


def test_packed_voxels_round_trip_is_exact(voxels: VoxelGrid) -> None:
    packed, found = pack_voxels(voxels), empty()
    unpack_voxels(checked_voxels(arrays_of(packed)), found)
    for name in ("tsdf", "weight", "color"):
        np.testing.assert_array_equal(getattr(found.grid, name)[:4], getattr(voxels.grid, name)[:4], err_msg=name)


def test_packed_voxels_contain_observed_voxels_in_order(voxels: VoxelGrid) -> None:
    packed, tsdf, weight, color = (
        pack_voxels(voxels),
        voxels.grid.tsdf[:4],
        voxels.grid.weight[:4],
        voxels.grid.color[:4],
    )
    seen = (tsdf != UNSEEN) | (weight != 0)
    np.testing.assert_array_equal(packed.tsdf, tsdf[seen])
    np.testing.assert_array_equal(packed.weight, weight[seen])
    np.testing.assert_array_equal(packed.color, color[color != 0])
    for words, expected in ((packed.observed, seen), (packed.colored, color != 0)):
        bits = np.unpackbits(words.astype("<u8").view(np.uint8), bitorder="little").reshape(4, 512)
        np.testing.assert_array_equal(bits, expected)


@pytest.mark.parametrize("name", PackedVoxels._fields)
def test_packed_voxels_of_wrong_length_raise(voxels: VoxelGrid, name: str) -> None:
    arrays = arrays_of(pack_voxels(voxels))
    with pytest.raises(DataError, match=f"^{name}: expected shape"):
        checked_voxels(arrays | {name: arrays[name][:-1]})


def arrays_of(packed: PackedVoxels) -> dict[str, Any]:
    return {"block_coords": COORDS, **packed._asdict()}
