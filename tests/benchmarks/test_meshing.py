"""Mesh extraction of a real kitchen at 1 cm.

The full extraction, the update after one more frame, and Open3D on the same voxels are measured. Run with `python -m
pytest tests/benchmarks/test_meshing.py -s`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from framework.data import Frame, Pose
from framework.datasets.rgbd_folder import RgbdFolder
from framework.mapping.instance_map import InstanceMap
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, UNSEEN
from framework.refinement.lifting import lift
from framework.registry import assemble
from plugins.detectors.none import NoDetections
from plugins.fusers.bayesian_tsdf import BayesianTsdf

KITCHEN = Path(__file__).resolve().parents[3] / "shared" / "data" / "redkitchen"
FRAMES = 300
UPDATES = 20  # last frames, added one by one
medians_ms: dict[str, float] = {}


def fuse(fuser: BayesianTsdf, frame: Frame) -> None:
    assert frame.T_world_camera is not None
    pose = Pose(frame.T_world_camera)
    fuser.fuse(frame, pose, lift(NoDetections().detect(frame), frame, pose))


@pytest.fixture(scope="module")
def kitchen() -> tuple[BayesianTsdf, Iterator[Frame]]:
    """Return the map of all frames except the last UPDATES frames, and an iterator over these frames."""
    if not KITCHEN.is_dir():
        pytest.skip(f"{KITCHEN} does not exist")
    frames = iter(RgbdFolder(root=KITCHEN, stop=FRAMES))
    fuser = assemble(BayesianTsdf, voxel_size=0.01)
    for _ in range(FRAMES - UPDATES):
        fuse(fuser, next(frames))
    return fuser, frames


def test_slam_mesh_update_speed(benchmark, kitchen: tuple[BayesianTsdf, Iterator[Frame]]) -> None:
    fuser, frames = kitchen
    fuser.scene.mesh()
    benchmark.pedantic(fuser.scene.mesh, setup=lambda: fuse(fuser, next(frames)), rounds=UPDATES)
    note(benchmark, "update after one frame", len(fuser.scene.mesh().triangles))


def test_slam_mesh_full_speed(benchmark, kitchen: tuple[BayesianTsdf, Iterator[Frame]]) -> None:
    scene = kitchen[0].scene
    benchmark.pedantic(scene.mesh, setup=scene.volume.changed, rounds=20, warmup_rounds=1)
    note(benchmark, "full", len(scene.mesh().triangles))


def test_slam_mesh_open3d_speed(benchmark, kitchen: tuple[BayesianTsdf, Iterator[Frame]]) -> None:
    """Open3D extracts the mesh from the same distances, with colors and without labels."""
    volume = open3d_volume(kitchen[0].scene)
    mesh = benchmark.pedantic(volume.extract_triangle_mesh, (0.5,), rounds=5, warmup_rounds=1)
    note(benchmark, "Open3D", len(mesh.triangle.indices))
    report = ", ".join(f"{name} {ms:.1f} ms" for name, ms in medians_ms.items())
    print(f"\nmesh of the kitchen: {report}")
    if "full" in medians_ms:
        ratio = medians_ms["Open3D"] / medians_ms["full"]
        print(f"full mesh {ratio:.1f} times faster than Open3D's")
        assert ratio > 5


def note(benchmark, name: str, triangles: int) -> None:
    benchmark.extra_info["triangles"] = triangles
    medians_ms[name] = 1e3 * benchmark.stats.stats.median


def open3d_volume(scene: InstanceMap) -> o3d.t.geometry.VoxelBlockGrid:
    """Copy the voxels of the map to a voxel block grid of Open3D."""
    grid, count = scene.volume.voxels.grid, scene.volume.voxels.block_count
    seen = grid.tsdf[:count] != UNSEEN
    values = {
        "tsdf": np.where(seen, grid.tsdf[:count] * grid.tsdf_unit, 0)[..., None],
        "weight": seen[..., None],
        "color": grid.color[:count],
    }
    volume = o3d.t.geometry.VoxelBlockGrid(
        tuple(values),
        (o3d.core.float32,) * 3,
        ((1,), (1,), (3,)),
        voxel_size=scene.volume.voxel_size,
        block_resolution=BLOCK_SIDE,
        block_count=count,
    )
    slots, inserted = volume.hashmap().activate(o3d.core.Tensor(grid.block_coords[:count].copy()))
    assert inserted.numpy().all()
    for name, value in values.items():
        array = volume.attribute(name).numpy()  # shares the memory
        array[slots.numpy()] = value.reshape(count, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, -1)
    return volume
