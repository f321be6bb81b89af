"""Tests for the voxel grid."""

import resource

import numpy as np
import pytest
from numba import njit

from framework.errors import MapFullError
from framework.mapping.voxels import voxel_grid
from framework.mapping.voxels.voxel_grid import FIRST_RESERVED, VoxelGrid, reserved
from framework.mapping.voxels.voxel_grid_kernels import UNSEEN, find_block


@njit
def look_up(grid, coords):
    found = np.empty(len(coords), np.int32)
    key, region = np.int64(-2), np.int32(-1)
    for i in range(len(coords)):
        found[i], key, region = find_block(grid, coords[i, 0], coords[i, 1], coords[i, 2], key, region)
    return found


def test_find_block_returns_only_allocated_blocks() -> None:
    rng = np.random.default_rng(0)
    coords = rng.integers(-3000, 3000, (5000, 3)).astype(np.int32)
    voxels = VoxelGrid(0.01, 0.05, 100_000)
    voxels.allocate(coords)
    unique, first = np.unique(coords, axis=0, return_index=True)
    assert voxels.block_count == len(unique)
    found = look_up(voxels.grid, coords)
    assert (voxels.grid.block_coords[found] == coords).all()
    in_order = coords[np.sort(first)]
    assert (voxels.grid.block_coords[: voxels.block_count] == in_order).all(), (
        "expected block numbers in the order of first occurrence"
    )
    absent = coords + np.int32(10_000)
    assert (look_up(voxels.grid, absent) == -1).all()


@pytest.mark.parametrize("promised", [64, 100_000])
def test_voxel_grid_growth_keeps_content(promised: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is copied if the system reserves memory for all blocks. Some systems reserve less."""
    monkeypatch.setattr(voxel_grid, "reserved", lambda most, make: make(min(most, promised)))
    voxels = VoxelGrid(0.01, 0.05, 100_000)
    voxels.allocate(np.zeros((1, 3), np.int32))
    voxels.grid.tsdf[0, 7] = 123
    voxels.allocate(np.stack(np.meshgrid(*[np.arange(20)] * 3), axis=-1).reshape(-1, 3).astype(np.int32))
    assert voxels.block_count == 8000
    assert voxels.grid.tsdf[0, 7] == 123
    assert (voxels.grid.tsdf[1:8000] == UNSEEN).all()


def test_voxel_grid_reserves_less_memory_under_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(length: int) -> int:
        if length > 3000:
            raise MemoryError
        return length

    assert reserved(2000, make) == 2000
    assert reserved(10_000, make) == FIRST_RESERVED
    assert reserved(10, make) == 10
    with monkeypatch.context() as limited:
        limited.setattr(resource, "getrlimit", lambda _: (2**33, 2**33))
        assert reserved(2000, make) == FIRST_RESERVED
    monkeypatch.setattr(voxel_grid, "resource", None)
    assert reserved(2000, make) == FIRST_RESERVED


def test_voxel_grid_over_budget_raises() -> None:
    voxels = VoxelGrid(0.01, 0.05, 10)
    with pytest.raises(MapFullError, match=r"fuser\.max_blocks"):
        voxels.allocate(np.arange(33, dtype=np.int32).reshape(11, 3))
    assert voxels.block_count == 10
    voxels.allocate(np.arange(3, dtype=np.int32).reshape(1, 3))  # existing blocks must still be found
