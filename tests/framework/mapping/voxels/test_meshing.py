"""Tests for surface nets and their incremental updates, compared with a slow reference and exact surfaces."""

import itertools

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import KDTree

from framework.data import Detections, Frame, InstanceMesh, Pose
from framework.mapping.instance_map import InstanceMap
from framework.mapping.voxels.meshing import MAX_JUMP, SurfaceNets, UnlabeledMesh
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import UNSEEN
from framework.refinement.lifting import lift
from framework.registry import assemble
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from plugins.detectors.none import NoDetections
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support.rendered_frames import rendered_frames
from tests.support.scenes.analytic_scene import room, walk
from tests.support.thread_counts import by_one_thread_and_two

pytestmark = pytest.mark.integration

VOXEL = 0.05  # m
BAND = 0.5  # m
MESH_ARRAYS = ("vertices", "triangles", "colors", "instance_ids", "class_ids")


def block_of(distance: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return the voxels (512,) of a block of a dense (X, Y, Z) array. x varies fastest."""
    x, y, z = 8 * block
    return distance[x : x + 8, y : y + 8, z : z + 8].transpose(2, 1, 0).ravel()


def grid_of(distance: np.ndarray, blocks: np.ndarray, origin: tuple[int, int, int]) -> VoxelGrid:
    """Return a grid with the given blocks (N, 3) of a dense array of distances, shifted by `origin` blocks."""
    voxels = VoxelGrid(VOXEL, BAND, 1000)
    voxels.allocate((blocks + origin).astype(np.int32))
    for number, block in enumerate(blocks):
        voxels.grid.tsdf[number] = block_of(distance, block)
    return voxels


def slow_surface_nets(stored: np.ndarray, most_jump: float) -> tuple[dict, set]:
    """Return the vertex of each cell, in voxels, and the quads as tuples of cells."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    vertices = {}
    for cell in itertools.product(*(range(n - 1) for n in stored.shape)):
        at = {tuple(c): stored[tuple(c + cell)] for c in corners}
        values = np.array(list(at.values()), np.float64)
        if (values == UNSEEN).any() or np.ptp(values) > most_jump or (values < 0).all() or (values >= 0).all():
            continue
        crossings = []
        for low in at:
            for axis in range(3):
                high = tuple(np.add(low, np.eye(3, dtype=int)[axis]))
                if high in at and (at[low] < 0) != (at[high] < 0):
                    a, b = float(at[low]), float(at[high])
                    crossings.append(np.add(low, a / (a - b) * np.eye(3)[axis]))
        vertices[cell] = np.mean(crossings, axis=0) + cell
    quads = set()
    for low in itertools.product(*(range(n - 1) for n in stored.shape)):
        for axis in range(3):
            step, b, c = (np.eye(3, dtype=int)[(axis + k) % 3] for k in range(3))
            if (stored[low] < 0) == (stored[tuple(low + step)] < 0):
                continue
            ring = [tuple(np.subtract(low, back).tolist()) for back in (0 * b, b, b + c, c)]
            if all(cell in vertices for cell in ring):
                quads.add(tuple(ring) if stored[low] < 0 else (ring[0], *ring[:0:-1]))
    return vertices, quads


def test_surface_nets_match_reference() -> None:
    """The field has random steps, unseen voxels and missing blocks, and some coordinates are negative."""
    rng = np.random.default_rng(5)
    side, origin = 24, (-1, -2, 7)
    i, j, k = np.mgrid[:side, :side, :side] * 0.35
    field = 2.5 * (np.sin(i + 0.3 * k) + np.sin(1.1 * j - 0.2 * i) + np.cos(0.9 * k + 0.4 * j)) + 0.1
    field += np.where(rng.random(field.shape) < 0.03, rng.normal(0, 6, field.shape), 0)
    stored = np.clip(field * VOXEL / BAND * 32767, -32767, 32767).astype(np.int16)
    stored[rng.random(field.shape) < 0.01] = UNSEEN
    blocks = rng.permutation(np.array(list(itertools.product(range(3), repeat=3))))
    for absent in blocks[24:]:
        x, y, z = 8 * absent
        stored[x : x + 8, y : y + 8, z : z + 8] = UNSEEN
    blocks = blocks[:24]
    surface = SurfaceNets(grid_of(stored, blocks, origin)).extract()
    expected, quads = slow_surface_nets(stored, MAX_JUMP * VOXEL / BAND * 32767)
    cells = list(expected)
    assert len(cells) > 1000
    places = (np.array(list(expected.values())) + 8 * np.array(origin)) * VOXEL
    error, match = KDTree(places).query(surface.vertices)
    assert error.max() < 1e-5
    assert np.array_equal(np.sort(match), np.arange(len(cells))), "expected exactly one vertex per cell"
    first, second = match[surface.triangles[::2]], match[surface.triangles[1::2]]
    assert np.array_equal(first[:, [0, 2]], second[:, :2]), "expected pairs of triangles with a common diagonal"
    found = [tuple(cells[v] for v in (*t, u)) for t, u in zip(first, second[:, 2], strict=True)]
    assert len(found) == len(quads) > 500
    assert set(found) == quads
    block, n = np.divmod(surface.voxels, 512)
    nearest = 8 * (blocks + origin)[block] + np.stack([n % 8, n // 8 % 8, n // 64], axis=1)
    assert np.abs(nearest - surface.vertices / VOXEL).max() < 0.5 + 1e-4


@pytest.fixture(scope="module")
def sphere() -> VoxelGrid:
    """Return a grid with exact distances from a sphere."""
    blocks = np.array(list(itertools.product(range(5), repeat=3)))
    points = np.stack(np.mgrid[:40, :40, :40], axis=-1) * VOXEL
    distance = np.linalg.norm(points - (0.9, 0.85, 0.8), axis=-1) - 0.6
    stored = np.round(np.clip(distance / BAND, -1, 1) * 32767).astype(np.int16)
    return grid_of(stored, blocks, (0, 0, 0))


def test_surface_nets_sphere_is_closed_and_faces_outward(sphere: VoxelGrid) -> None:
    vertices, triangles, _ = SurfaceNets(sphere).extract()
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges), "expected each directed edge only once"
    assert {tuple(e) for e in edges} == {tuple(e) for e in edges[:, ::-1]}, (
        "expected a triangle on both sides of each edge"
    )
    assert len(vertices) - len(edges) // 2 + len(triangles) == 2, "expected V - E + F = 2 (Euler's formula)"
    a, b, c = (vertices[triangles[:, i]].astype(np.float64) for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.01)
    error = np.abs(np.linalg.norm(vertices - (0.9, 0.85, 0.8), axis=1) - 0.6)
    assert np.median(error) < 0.03 * VOXEL, (
        "expected vertices inside the sphere by about the sagitta of a cell, 1/96 voxel"
    )
    assert error.max() < 0.06 * VOXEL


def copied(surface: UnlabeledMesh) -> UnlabeledMesh:
    return UnlabeledMesh(*(array.copy() for array in surface))


def test_surface_nets_reread_only_changed_blocks(sphere: VoxelGrid) -> None:
    """The surface of a changed block is updated only after the block has been reported as changed."""
    nets = SurfaceNets(sphere)
    before = copied(nets.extract())
    block = int(np.bincount(before.voxels // 512).argmax())
    kept = sphere.grid.tsdf[block].copy()
    try:
        sphere.grid.tsdf[block] += 2000
        assert nets.extract() is nets.extract()
        nets.changed(np.array([(block + 60) % 125], np.int32))
        assert all(map(np.array_equal, nets.extract(), before))
        nets.changed(np.array([block], np.int32))
        after = nets.extract()
        assert not np.array_equal(after.vertices, before.vertices)
        assert all(map(np.array_equal, after, SurfaceNets(sphere).extract()))
    finally:
        sphere.grid.tsdf[block] = kept
    assert np.array_equal(before.vertices, SurfaceNets(sphere).extract().vertices), (
        "expected unchanged arrays of the earlier result"
    )


def test_surface_nets_are_independent_of_thread_count(sphere: VoxelGrid) -> None:
    for one, two in zip(*by_one_thread_and_two(lambda: SurfaceNets(sphere).extract()), strict=True):
        np.testing.assert_array_equal(one, two)


def detections(frame: Frame) -> Detections:
    """Return exact masks of the spheres. Each sphere is split into two instances."""
    assert frame.truth is not None
    ids = frame.truth.instance_ids
    u = np.arange(frame.camera.width)[None]
    masks = np.array([(ids == i) & (u % 2 == half) for i in frame.truth.class_names for half in (0, 1)])
    masks = masks[masks.any(axis=(1, 2))]
    n = len(masks)
    probabilities = np.tile(np.array([0.7, 0.3], np.float32), (n, 1))
    return Detections(masks, np.zeros((n, 4), np.float32), np.full(n, 0.9, np.float32), probabilities, ("a", "b"))


def fuse(fuser: BayesianTsdf, T_world_camera: np.ndarray, k: int) -> None:
    frame = room().frame(T_world_camera, k)
    fuser.fuse(frame, Pose(T_world_camera), lift(detections(frame), frame, Pose(T_world_camera)))


def same_mesh(ours: InstanceMap) -> bool:
    """Return True if the mesh of the map equals a full extraction."""
    mesh = ours.mesh()
    ours.volume.changed()
    return equal(mesh, ours.mesh())


def equal(ours: InstanceMesh, theirs: InstanceMesh) -> bool:
    return all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in MESH_ARRAYS)


def test_mesh_updates_match_full_extraction() -> None:
    """The meshes must be identical after every frame and merge, while instances are confirmed and the grid grows."""
    updated, asked_late = (assemble(BayesianTsdf, voxel_size=0.019, max_depth=4.0) for _ in range(2))
    sizes, named = [], []
    for k, T in enumerate(walk(40)[::4]):
        fuse(updated, T, k)
        fuse(asked_late, T, k)
        mesh = updated.scene.mesh()
        assert asked_late.scene.volume._nets is None, "expected no extraction before the first request"
        reference = SurfaceNets(updated.scene.volume.voxels).extract()
        assert np.array_equal(mesh.vertices, reference.vertices)
        assert np.array_equal(mesh.triangles, reference.triangles)
        sizes.append(updated.scene.volume.voxels.block_count)
        named.append(len(np.unique(mesh.instance_ids)))
    assert sizes[0] < 1024 < sizes[-1], "expected growth of the grid's arrays"
    assert named[0] == 1, "expected no confirmed instance in the first mesh"
    assert named[-1] > 2
    ours = updated.scene.mesh()
    assert equal(ours, asked_late.scene.mesh())
    kept, dropped = np.unique(ours.instance_ids)[1:3].tolist()
    updated.scene.merge(kept, dropped)
    merged = updated.scene.mesh()
    assert merged.vertices is ours.vertices, "expected a merge to change labels, not vertices"
    assert dropped not in merged.instance_ids
    assert same_mesh(updated.scene)


def test_mesh_of_furnished_room_lies_on_surface() -> None:
    """Poses and depth are exact."""
    sequence = Synthetic(kind=RoomKind.LIVING_ROOM, frames=240, stride=12, noise=0.0)
    fuser = assemble(BayesianTsdf, voxel_size=0.01)
    nothing = NoDetections()
    for frame in rendered_frames(sequence):
        assert frame.T_world_camera is not None
        pose = Pose(frame.T_world_camera)
        fuser.fuse(frame, pose, lift(nothing.detect(frame), frame, pose))
    mesh = fuser.scene.mesh()
    surfaces = sequence.room.surfaces
    error = distance_to(surfaces.vertices, surfaces.triangles, mesh.vertices)
    assert np.median(error) < 0.1 * 0.01
    assert np.quantile(error, 0.95) < 0.5 * 0.01
    v, u = np.nonzero(
        (frame.depth > fuser.voxels.hashing.tsdf.min_depth) & (frame.depth < fuser.voxels.hashing.tsdf.max_depth)
    )
    d = frame.depth[v, u]
    seen = np.stack(
        [(u - frame.camera.cx) / frame.camera.fx * d, (v - frame.camera.cy) / frame.camera.fy * d, d], axis=1
    )
    seen = seen @ pose.T_world_camera[:3, :3].T + pose.T_world_camera[:3, 3]
    missing = distance_to(mesh.vertices, mesh.triangles, seen.astype(np.float32)) > 0.01
    assert missing.mean() < 0.03


def distance_to(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances (N,), m, of points (N, 3) from a mesh."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles.astype(np.uint32)))
    return np.asarray(scene.compute_distance(o3d.core.Tensor(points)).numpy())
