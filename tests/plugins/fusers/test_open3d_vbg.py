"""Tests for fuser=open3d_vbg, which uses the voxel block grid of Open3D."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from framework.baselines.open3d_grid import BlockGridSettings
from framework.baselines.open3d_map import Open3DMap
from framework.data import Camera, Frame
from framework.errors import ConfigError, DataError, MapFullError
from framework.mapping.instance_map import FORMAT
from framework.mapping.instances.instance_list import Confirmation
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.fusers.open3d_vbg import Open3DVoxelBlockGrid
from tests.support.scenes.analytic_scene import CAMERA, Scene, pose, room, walk
from tests.support.true_masks import CLASSES, fuse_masks, masks_of

SETTINGS = BlockGridSettings(
    voxel_size=0.02,
    block_resolution=8,
    truncation=4.0,
    min_depth=0.2,
    max_depth=4.0,
    max_blocks=10_000,
    min_weight=3.0,
)
CONFIRMATION = Confirmation(min_observations=3, min_confidence=0.05, min_area=0.003)


def new_fuser(**parameters: float) -> Open3DVoxelBlockGrid:
    return assemble(Open3DVoxelBlockGrid, voxel_size=0.02, max_depth=4.0, **parameters)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(6))]


@pytest.fixture(scope="module")
def mapped(frames: list[Frame]) -> Open3DMap:
    """Map the room with its three spheres from six frames."""
    fuser = new_fuser()
    for frame in frames:
        fuse_masks(fuser, frame, masks_of(frame), [0.9, 0.8, 0.7])
    return fuser.scene


def one_view(**changes: float) -> tuple[Open3DMap, Frame]:
    """Map a wall from one frame."""
    frame = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)]).frame(np.eye(4))
    scene = Open3DMap(dataclasses.replace(SETTINGS, **changes), CONFIRMATION)
    scene.integrate(frame, np.eye(4))
    return scene, frame


# Votes


def majority(votes: list[int]) -> tuple[int, int]:
    """Return the candidate and the counter of the majority vote by Boyer and Moore."""
    candidate = count = 0
    for vote in votes:
        if vote == candidate:
            count += 1
        elif count == 0:
            candidate, count = vote, 1
        else:
            count -= 1
    return candidate, count


@pytest.mark.parametrize("votes", [[1], [1, 2], [1, 2, 2], [1, 2, 3, 3], [2, 2, 1, 1, 1], [3, 3, 3, 1, 2]])
def test_open3d_vbg_voxel_votes_match_boyer_moore(votes: list[int]) -> None:
    scene, frame = one_view()
    for vote in votes:
        scene.vote(frame, np.eye(4), np.full(frame.depth.shape, vote, np.int32), band=2.0)
    counted = scene.grid.flat("instance") > 0
    candidate, count = majority(votes)
    assert counted.sum() > 1000
    assert set(scene.grid.flat("instance")[counted]) == {candidate}
    assert set(scene.grid.flat("votes")[counted]) == {count}


def voxel_centers(scene: Open3DMap) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (N,) and positions (N, 3), m, of all voxels."""
    r, size = scene.grid.settings.block_resolution, scene.grid.settings.voxel_size
    hashmap = scene.grid.blocks.hashmap()
    z, y, x = np.mgrid[:r, :r, :r].reshape(3, -1)
    numbers, places = [], []
    for block in hashmap.active_buf_indices().numpy():
        corner = hashmap.key_tensor().numpy()[block] * r
        numbers.append(block.astype(np.int64) * r**3 + np.arange(r**3))
        places.append((corner + np.stack([x, y, z], 1)) * size)
    return np.concatenate(numbers), np.concatenate(places)


def test_open3d_vbg_only_voxels_in_band_under_mask_vote(frames: list[Frame]) -> None:
    frame = frames[3]
    T = frame.T_world_camera
    scene = Open3DMap(SETTINGS, CONFIRMATION)
    scene.integrate(frame, T)
    mask = masks_of(frame)[0]
    scene.vote(frame, T, np.where(mask, 7, 0).astype(np.int32), band=2.0)
    numbers, places = voxel_centers(scene)
    x, y, z = ((places - T[:3, 3]) @ T[:3, :3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (np.rint(CAMERA.fx * x / z + CAMERA.cx), np.rint(CAMERA.fy * y / z + CAMERA.cy))
        inside = (z > 0.2) & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
    expected = np.zeros(len(numbers), bool)
    at = (v[inside].astype(int), u[inside].astype(int))
    expected[inside] = mask[at] & (np.abs(frame.depth[at] - z[inside]) <= 2.0 * 0.02)
    found = scene.grid.flat("instance")[numbers] == 7
    assert expected.sum() > 500
    assert (found != expected).mean() < 1e-4, "expected equal votes except for rounding"
    assert (scene.grid.flat("instance") == 7).sum() == found.sum(), "expected no votes in voxels without a block"


@pytest.mark.parametrize(("scores", "winner"), [([0.9, 0.6], 1), ([0.6, 0.9], 2)])
def test_open3d_vbg_shared_pixels_vote_for_higher_score(frames: list[Frame], scores: list[float], winner: int) -> None:
    first, second, _ = masks_of(frames[0])
    v = np.arange(CAMERA.height)[:, None]
    shared = first & (v > np.quantile(np.nonzero(first)[0], 0.7))
    fuser = new_fuser()
    fuse_masks(fuser, frames[0], [first, second | shared], scores)
    ids = fuser.scene.render(CAMERA, frames[0].T_world_camera).instance_ids
    assert (ids[shared] == winner).mean() > 0.8
    assert (ids[first & ~shared] == 1).mean() > 0.8


# Surfaces


@pytest.mark.parametrize("rotvec", [(0.0, 0.0, 0.0), (0.1, 0.5, 0.0), (-0.2, -0.4, 0.3)])
def test_open3d_vbg_rendered_surface_is_accurate(rotvec: tuple[float, float, float]) -> None:
    """The rays of Open3D end 12 mm too far, and depth is read with an offset of half a pixel.

    Both must be corrected.
    """
    scene, T = Open3DMap(SETTINGS, CONFIRMATION), pose(rotvec=rotvec)
    walls = Scene(planes=[(np.array([-0.3, 0.1, -1.0]) / np.sqrt(1.1), -1.777)], spheres=room().spheres)
    for _ in range(3):
        scene.integrate(walls.frame(T), T)
    elsewhere = T @ pose(0.05, 0.03, 0.02, (0.03, -0.08, 0.05))
    depth, color, surface = walls.render(CAMERA, elsewhere)
    view = scene.render(CAMERA, elsewhere)
    wall = (view.depth > 0) & (surface == 1)
    assert wall.mean() > 0.3
    error = (view.depth - depth)[wall]
    assert abs(np.median(error)) < 0.001
    assert np.median(np.abs(error)) < 0.002
    assert np.median(np.abs(view.color[wall].astype(int) - color[wall])) <= 3
    normal = view.normals_world[wall] @ walls.planes[0][0]
    assert np.median(normal) > 0.95  # with one view and nearest-neighbor depth, the field has steps
    assert np.quantile(normal, 0.1) > 0.8
    near = scene.render_near(CAMERA, elsewhere, depth)
    assert np.array_equal(near.depth, view.depth)


def test_open3d_vbg_mesh_is_accurate_and_repeatable(mapped: Open3DMap, frames: list[Frame]) -> None:
    mesh = mapped.mesh()
    distance = room().distance(mesh.vertices.astype(np.float64))
    assert np.median(distance) < 0.1 * 0.02
    assert np.quantile(distance, 0.95) < 0.5 * 0.02
    a, b, c = (mesh.vertices[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    towards = np.einsum("ij,ij->i", np.cross(b - a, c - a), -a)  # the camera is near the origin
    assert (towards > 0).mean() > 0.98
    again = Open3DMap(mapped.grid.settings, CONFIRMATION)
    for frame in frames:
        again.integrate(frame, frame.T_world_camera)
    twin = again.mesh()
    for name in ("vertices", "triangles", "colors"):
        assert np.array_equal(getattr(mesh, name), getattr(twin, name)), name


def test_open3d_vbg_min_weight_applies_after_first_frames() -> None:
    scene, frame = one_view()
    view, mesh = scene.render(CAMERA, np.eye(4)), scene.mesh()
    assert (view.depth > 0).mean() > 0.9
    assert len(mesh.vertices) > 100
    half = np.where(np.arange(CAMERA.width) < CAMERA.width // 2, frame.depth, np.float32(0))
    for _ in range(2):
        scene.integrate(dataclasses.replace(frame, depth=half), np.eye(4))
    seen = scene.render(CAMERA, np.eye(4)).depth > 0
    assert seen[:, : CAMERA.width // 2 - 4].mean() > 0.9
    assert not seen[:, CAMERA.width // 2 + 4 :].any(), (
        "expected no surface in the right half: it was observed once, and min_weight is 3"
    )
    assert scene.mesh().vertices[:, 0].max() < 0.1


def test_open3d_vbg_low_resolution_image_leaves_no_holes() -> None:
    """Open3D allocates blocks only at every 4th pixel. Here, 4 pixels are 12 cm, but blocks are 8 cm wide."""
    coarse = Camera(48, 36, 40.0, 40.0, 23.5, 17.5)
    scene = Open3DMap(dataclasses.replace(SETTINGS, voxel_size=0.01), CONFIRMATION)
    wall = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.2)])
    for _ in range(3):
        scene.integrate(wall.frame(np.eye(4), camera=coarse), np.eye(4))
    assert (scene.render(coarse, np.eye(4)).depth > 0)[2:-2, 2:-2].all()


def test_open3d_vbg_close_view_is_complete_without_output(mapped: Open3DMap, capfd: pytest.CaptureFixture[str]) -> None:
    """Open3D allocates its range map for the first view. In a larger view, it prints a warning and leaves holes."""
    scene = Open3DMap(mapped.grid.settings, CONFIRMATION)
    for T in walk(3):
        scene.integrate(room().frame(T), T)
    small = Camera(8, 6, 6.5, 6.5, 3.5, 2.5)
    scene.render(small, np.eye(4))
    close = pose(0.0, 0.0, 1.0)
    view = scene.render(CAMERA, close)
    assert (view.depth > 0).mean() > 0.9
    output = capfd.readouterr()
    assert (output.out, output.err) == ("", "")


# Instances


def test_open3d_vbg_instance_ids_match_bayesian_tsdf(frames: list[Frame]) -> None:
    ours, theirs = new_fuser(), assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0)
    for k, frame in enumerate(frames):
        order = np.roll(np.arange(3), k)
        for fuser in (ours, theirs):
            fuse_masks(fuser, frame, [masks_of(frame)[i] for i in order], [0.9] * 3)
    histories = [
        {
            k: (r.observations, r.visible, r.detections, r.class_evidence.tolist())
            for k, r in f.scene.table.records.items()
        }
        for f in (ours, theirs)
    ]
    assert len(histories[0]) == 3
    assert histories[0] == histories[1]
    T = frames[3].T_world_camera
    a, b = (fuser.scene.render(CAMERA, T).instance_ids for fuser in (ours, theirs))
    assert (a == b).mean() > 0.97


def test_open3d_vbg_each_sphere_is_one_instance_on_its_surface(mapped: Open3DMap) -> None:
    mesh, instances = mapped.mesh(), mapped.instances()
    assert sorted(instances) == [1, 2, 3]
    for (center, radius), instance in zip(room().spheres, instances.values(), strict=True):
        points = mesh.vertices[instance.vertices].astype(np.float64)
        distance = np.abs(np.linalg.norm(points - center, axis=1) - radius)
        assert np.quantile(distance, 0.95) < 2 * 0.02
        assert instance.class_probabilities.argmax() == 0
        assert instance.observations == 6
        assert (mesh.class_ids[instance.vertices] == 0).all()


def test_open3d_vbg_merge_relabels_all_voxels(frames: list[Frame]) -> None:
    fuser = new_fuser(merge_overlap=0.5, merge_frames=1)
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    left = whole & (np.arange(CAMERA.width) < (u[0] + u[-1]) // 2)
    fuse_masks(fuser, frames[0], [left, whole & ~left], [0.9, 0.8])
    assert set(np.unique(fuser.scene.grid.flat("instance"))) == {0, 1, 2}
    for k in (1, 2):
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.1])
    assert set(fuser.scene.table.records) == {1}
    assert set(np.unique(fuser.scene.grid.flat("instance"))) == {0, 1}


def test_open3d_vbg_instance_below_min_area_is_excluded(frames: list[Frame]) -> None:
    fuser = new_fuser(min_area=40.0)
    for frame in frames[:3]:
        fuse_masks(fuser, frame, masks_of(frame)[:1], [0.9])
    assert not fuser.scene.instances()
    assert (fuser.scene.mesh().class_ids == -1).all()
    assert fuser.scene.render(CAMERA, frames[0].T_world_camera).instance_ids.any(), (
        "expected a tentative instance in the view"
    )


# Storage


def test_open3d_vbg_grid_growth_keeps_content(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    maps = []
    for first in (16, 5000):
        monkeypatch.setattr("framework.baselines.open3d_grid.FIRST_BLOCKS", first)
        fuser = new_fuser()
        for frame in frames[:3]:
            fuse_masks(fuser, frame, masks_of(frame), [0.9, 0.8, 0.7])
        maps.append(fuser.scene)
    small, large = maps
    assert small.grid.block_count == large.grid.block_count > 16
    for name in ("vertices", "colors", "instance_ids"):
        assert np.array_equal(getattr(small.mesh(), name), getattr(large.mesh(), name))


def test_open3d_vbg_full_map_error_keeps_content(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.baselines.open3d_grid.FIRST_BLOCKS", 16)
    first = new_fuser()
    fuse_masks(first, frames[0], [], [])
    budget = first.scene.grid.block_count
    fuser = new_fuser(max_blocks=budget)
    fuse_masks(fuser, frames[0], [], [])
    before = fuser.scene.mesh()
    with pytest.raises(MapFullError, match=f"{budget} blocks of 8"):
        fuse_masks(fuser, dataclasses.replace(frames[0], T_world_camera=pose(0.3)), [], [])
    assert fuser.scene.statistics.voxels == budget * 512
    assert fuser.scene.grid.blocks.hashmap().capacity() <= budget
    assert np.array_equal(fuser.scene.mesh().vertices, before.vertices)
    fuse_masks(fuser, frames[0], [], [])  # frames in existing blocks can still be fused


def test_open3d_vbg_statistics_count_blocks_in_use(mapped: Open3DMap) -> None:
    assert mapped.statistics.bytes == mapped.statistics.voxels * 4 * (1 + 1 + 3 + 1 + 1)
    assert mapped.statistics.voxels == mapped.grid.block_count * 512


def test_open3d_vbg_map_file_round_trip_is_exact(mapped: Open3DMap, tmp_path: Path) -> None:
    mapped.save(tmp_path / "map.npz")
    loaded = Open3DMap.load(tmp_path / "map.npz")
    assert (loaded.grid.settings, loaded.classes, loaded.grid.frames) == (mapped.grid.settings, CLASSES, 6)
    assert loaded.confirmation == mapped.confirmation
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids"):
        assert np.array_equal(getattr(mapped.mesh(), name), getattr(loaded.mesh(), name)), name
    assert {k: vars(r).keys() for k, r in loaded.table.records.items()} == {
        k: vars(r).keys() for k, r in mapped.table.records.items()
    }
    assert loaded.instances()[2].confidence == mapped.instances()[2].confidence
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    with np.load(tmp_path / "map.npz") as file:
        coords = file["block_coords"].tolist()
    assert coords == sorted(coords, key=lambda xyz: xyz[::-1]), (
        "expected sorted blocks: Open3D's order differs between runs"
    )


def test_open3d_vbg_damaged_or_foreign_file_raises(mapped: Open3DMap, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    mapped.save(path)
    whole = path.read_bytes()
    for place in np.random.default_rng(0).integers(200, len(whole) // 2, 5):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"map\.npz"):
            Open3DMap.load(path)
    BayesianTsdf().scene.save(path)
    with pytest.raises(DataError, match=f"expected map format open3d_vbg 7, got {FORMAT}"):
        Open3DMap.load(path)
    with pytest.raises(DataError, match=r"none\.npz"):
        Open3DMap.load(tmp_path / "none.npz")


# Unusual input


def test_open3d_vbg_empty_map_round_trip_is_exact(tmp_path: Path) -> None:
    fuser = new_fuser()
    fuse_masks(fuser, Scene().frame(np.eye(4)), [np.ones(CAMERA.shape, np.bool_)], [0.9])
    assert (fuser.scene.statistics.voxels, len(fuser.scene.table.records)) == (0, 0)
    fuser.scene.save(tmp_path / "map.npz")
    assert Open3DMap.load(tmp_path / "map.npz").statistics.voxels == 0


def test_open3d_vbg_single_depth_reading_is_mapped(frames: list[Frame]) -> None:
    """Open3D samples only some pixels, and raises an error if none of them has depth."""
    depth = np.zeros_like(frames[0].depth)
    depth[61, 83] = 1.5
    fuser = new_fuser()
    fuse_masks(fuser, dataclasses.replace(frames[0], depth=depth), [np.ones(CAMERA.shape, np.bool_)], [0.9])
    assert fuser.scene.statistics.voxels > 0


def test_open3d_vbg_invalid_parameter_raises() -> None:
    for wrong in ({"block_resolution": 1}, {"class_floor": 1.0}, {"min_weight": float("nan")}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            assemble(Open3DVoxelBlockGrid, **wrong)
