"""Tests for a map with instances: mesh, instances, saving and loading."""

import json
import pickle
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import Detections, Frame, Instance, Pose
from framework.errors import DataError
from framework.mapping.instance_map import FORMAT, InstanceMap
from framework.mapping.instances.instance_list import oriented_box
from framework.mapping.labels.dense_crf import DenseCrf
from framework.refinement.lifting import lift
from framework.registry import assemble
from framework.testing.contracts import same
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support.scenes.analytic_scene import Scene, room, walk

CLASSES = ("chair", "bed")


def true_detections(frame: Frame) -> Detections:
    """Return an exact mask for each visible instance of the analytic scene."""
    assert frame.truth is not None
    ids = [i for i in frame.truth.class_names if (frame.truth.instance_ids == i).any()]
    masks = np.array([frame.truth.instance_ids == i for i in ids]).reshape(len(ids), *frame.depth.shape)
    boxes = np.zeros((len(ids), 4), np.float32)
    probabilities = np.tile(np.array([0.8, 0.2], np.float32), (len(ids), 1))
    return Detections(masks, boxes, np.full(len(ids), 0.9, np.float32), probabilities, CLASSES)


def fused(fuser: BayesianTsdf, scene: Scene, k: int, T: np.ndarray) -> None:
    frame = scene.frame(T, k)
    fuser.fuse(frame, Pose(T), lift(true_detections(frame), frame, Pose(T)))


def mapped(scene: Scene, frames: int = 12) -> BayesianTsdf:
    fuser = assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0)
    for k, T in enumerate(walk(frames)):
        fused(fuser, scene, k, T)
    return fuser


@pytest.fixture(scope="module")
def scene_map() -> InstanceMap:
    return mapped(room()).scene


def test_instance_map_mesh_lies_on_true_surface(scene_map: InstanceMap) -> None:
    mesh = scene_map.mesh()
    distance = room().distance(mesh.vertices.astype(np.float64))
    assert np.median(distance) < 0.1 * scene_map.volume.voxel_size
    assert np.quantile(distance, 0.95) < 0.5 * scene_map.volume.voxel_size


def test_instance_map_with_crf_is_smoothed_also_after_loading(tmp_path: Path) -> None:
    fuser = mapped(room(), frames=4)
    before = fuser.scene.mesh()
    fuser.scene.crf = DenseCrf(crf_weight=5.0)
    fuser.scene.relabel()
    smoothed = fuser.scene.mesh()
    changed = smoothed.instance_ids != before.instance_ids
    assert 0 < changed.mean() < 0.05
    np.testing.assert_array_equal(smoothed.class_ids[~changed], before.class_ids[~changed])
    assert (smoothed.class_ids[changed] == np.where(smoothed.instance_ids[changed] > 0, 0, -1)).all()
    fuser.scene.save(tmp_path / "map.npz")
    assert same(InstanceMap.load(tmp_path / "map.npz").mesh(), smoothed)


def test_instance_map_triangles_face_camera(scene_map: InstanceMap) -> None:
    mesh = scene_map.mesh()
    a, b, c = (mesh.vertices[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    towards = np.einsum("ij,ij->i", normal, -a)  # the camera is near the origin
    assert (towards > 0).mean() > 0.99


def test_instance_map_sphere_is_one_instance_of_correct_size(scene_map: InstanceMap) -> None:
    instances = scene_map.instances()
    mesh = scene_map.mesh()
    assert len(instances) == len(room().spheres)
    for instance in instances.values():
        points = mesh.vertices[instance.vertices].astype(np.float64)
        distance = [np.abs(np.linalg.norm(points - center, axis=1) - radius) for center, radius in room().spheres]
        best = int(np.argmin([np.median(d) for d in distance]))
        assert np.quantile(distance[best], 0.95) < 2 * scene_map.volume.voxel_size
        assert instance.class_probabilities.argmax() == 0
        assert instance.observations == 12
        assert instance.confidence == pytest.approx(0.9, abs=0.01)
        low, high = instance.aabb.center - instance.aabb.extent / 2, instance.aabb.center + instance.aabb.extent / 2
        assert (points >= low - 1e-6).all()
        assert (points <= high + 1e-6).all()
        inside = np.abs((points - instance.obb.center) @ instance.obb.rotation)
        assert (inside <= instance.obb.extent / 2 + 1e-3).all()
    planes = mesh.instance_ids[np.abs(mesh.vertices[:, 2] - 2.5) < 0.01]
    assert (planes > 0).mean() < 0.05


def test_instance_map_views_show_instances(scene_map: InstanceMap) -> None:
    T = walk(12)[6]
    frame = room().frame(T)
    assert frame.truth is not None
    view = scene_map.render(frame.camera, T)
    for i in frame.truth.class_names:
        ids = view.instance_ids[(frame.truth.instance_ids == i) & (view.depth > 0)]
        assert np.bincount(ids).max() > 0.9 * len(ids)


def test_instance_map_save_and_load_round_trip_is_exact(scene_map: InstanceMap, tmp_path: Path) -> None:
    scene_map.save(tmp_path / "map.npz")
    loaded = InstanceMap.load(tmp_path / "map.npz")
    ours, theirs = scene_map.mesh(), loaded.mesh()
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))
    assert loaded.classes == CLASSES
    assert {k: (v.confidence, v.observations) for k, v in scene_map.instances().items()} == {
        k: (v.confidence, v.observations) for k, v in loaded.instances().items()
    }
    T = walk(12)[3]
    camera = room().frame(T).camera
    assert np.array_equal(scene_map.render(camera, T).instance_ids, loaded.render(camera, T).instance_ids)


def test_instance_map_saved_file_is_reproducible(scene_map: InstanceMap, tmp_path: Path) -> None:
    scene_map.save(tmp_path / "map.npz")
    InstanceMap.load(tmp_path / "map.npz").save(tmp_path / "again.npz")
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_instance_map_damaged_file_raises(scene_map: InstanceMap, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    scene_map.save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.integers(200, len(whole) // 2, 20):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"map\.npz"):
            InstanceMap.load(path)
    entry = whole.rindex(b"tsdf.npy") - 46  # entry of the array in the directory of the archive, which has no checksum
    for place, bit in ((entry + 8, 0x01), (entry + 33, 0x08), (entry + 46, 0x08)):  # "encrypted", comment length, name
        damaged = bytearray(whole)
        damaged[place] ^= bit
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"map\.npz"):
            InstanceMap.load(path)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"map\.npz"):
        InstanceMap.load(path)
    with pytest.raises(DataError, match="absent"):
        InstanceMap.load(tmp_path / "absent.npz")


@pytest.mark.parametrize("other", [FORMAT - 1, FORMAT + 1])
def test_instance_map_file_of_other_format_raises(other: int, tmp_path: Path) -> None:
    """The format is checked before the arrays, because the arrays depend on it."""
    path = tmp_path / "map.npz"
    np.savez(path, header=np.frombuffer(json.dumps({"format": other}).encode(), np.uint8))
    expected = re.escape(f"{path}: expected map format {FORMAT}, got {other}; map again")
    with pytest.raises(DataError, match=f"^{expected}$"):
        InstanceMap.load(path)


@pytest.mark.parametrize("threshold", [{"min_observations": 13}, {"min_confidence": 0.95}, {"min_area": 4.0}])
def test_instance_map_excludes_instances_below_threshold(
    scene_map: InstanceMap, tmp_path: Path, threshold: dict[str, float]
) -> None:
    scene_map.save(tmp_path / "map.npz")
    loaded = InstanceMap.load(tmp_path / "map.npz")
    assert len(loaded.instances()) == 3
    loaded.confirmation = replace(loaded.confirmation, **threshold)  # type: ignore[arg-type]
    loaded.volume.changed()
    assert not loaded.instances()
    assert not loaded.mesh().instance_ids.any()
    assert (loaded.mesh().class_ids == -1).all()
    T = walk(12)[3]
    assert loaded.render(room().frame(T).camera, T).instance_ids.any(), (
        "expected unconfirmed instances in the view, because association uses them"
    )


def assert_current(scene: InstanceMap) -> None:
    """Compare the mesh and the instances with those of a copy without derived data."""
    copy: InstanceMap = pickle.loads(pickle.dumps(scene))
    assert same(scene.mesh(), copy.mesh())
    assert_same_instances(scene.instances(), copy.instances())


def assert_same_instances(found: Mapping[int, Instance], expected: Mapping[int, Instance]) -> None:
    assert [*found] == [*expected]
    assert all(same(found[key], expected[key]) for key in expected)


def test_instance_map_after_each_frame_equals_rebuilt_map() -> None:
    """Instances are confirmed in the third frame, and merged later."""
    fuser = mapped(room(), 2)
    assert_current(fuser.scene)
    for k, T in enumerate(walk(12)[2:8], 2):
        fused(fuser, room(), k, T)
        if k == 5:
            first, second, *_ = fuser.scene.instance_ids()
            fuser.scene.merge(first, second)
        assert_current(fuser.scene)
    assert 0 < len(fuser.scene.instances()) < 3


@pytest.mark.parametrize(
    "change", ["frame", "merge", "remove", "merge_and_remove", "relabel", "add_class", "confirmation", "colors"]
)
def test_instance_map_lists_instances_again_after_change(change: str) -> None:
    fuser = mapped(room(), 4)
    scene, T = fuser.scene, walk(12)[5]
    before = scene.instances()
    first, second, *_ = before
    assert scene.instances() is before
    match change:
        case "frame":
            fused(fuser, room(), 4, T)
        case "merge":
            scene.merge(first, second)
        case "remove":
            scene.remove([second])
        case "merge_and_remove":
            scene.merge(first, second)
            scene.remove([first])
        case "relabel":
            evidence = scene.labels.in_use()
            evidence.instance_ids[evidence.instance_ids == second] = first
            scene.relabel()
        case "add_class":
            scene.add_class("table")
        case "confirmation":  # as of a resumed run
            fuser.voxels.confirmation = replace(fuser.voxels.confirmation, min_observations=5)
            fuser.resume(scene)
        case "colors":
            fuser.renew_colors()
            fused(fuser, room(), 4, T)
    assert scene.instances() is not before
    assert_current(scene)


def test_instance_map_list_keeps_state_after_later_frames() -> None:
    fuser = mapped(room(), 4)
    listed, expected = fuser.scene.instances(), pickle.loads(pickle.dumps(fuser.scene)).instances()
    fused(fuser, room(), 4, walk(12)[5])
    fuser.scene.merge(*[*listed][:2])
    assert_same_instances(listed, expected)


@pytest.mark.parametrize("points", [1, 2, 3])
def test_oriented_box_of_few_vertices_is_valid(points: int) -> None:
    corners = np.float32([[0, 0, 1], [2, 0, 1], [0, 0, 1]])[:points]
    box = oriented_box(corners)
    assert np.allclose(np.sort(box.extent), [0, 0, 2 if points > 1 else 0], atol=1e-5)


def test_instance_map_resumed_after_loading_is_identical(tmp_path: Path) -> None:
    whole, resumed = (assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0) for _ in range(2))
    for k, T in enumerate(walk(4)):
        if k == 2:
            resumed.scene.save(tmp_path / "map.npz")
            resumed.scene = InstanceMap.load(tmp_path / "map.npz")
        fused(whole, room(), k, T)
        fused(resumed, room(), k, T)
    ours, theirs = whole.scene.mesh(), resumed.scene.mesh()
    assert len(whole.scene.instances()) == 3
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))


def test_instance_map_without_frames_has_empty_mesh(tmp_path: Path) -> None:
    scene = BayesianTsdf().scene
    assert len(scene.mesh().vertices) == 0
    assert len(scene.instances()) == 0
    scene.save(tmp_path / "map.npz")
    assert InstanceMap.load(tmp_path / "map.npz").statistics.voxels == 0


@pytest.mark.parametrize(("score", "keeps"), [(0.9, True), (0.15, False)])
def test_instance_map_wall_keeps_only_likely_flat_instance(score: float, keeps: bool) -> None:
    fuser = assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0, create_score=0.1)
    for k, T in enumerate(walk(8)):
        frame = room().frame(T, k)
        wall = room().render(frame.camera, T)[2] == 1
        flat = Detections(
            wall[None],
            np.zeros((1, 4), np.float32),
            np.array([score], np.float32),
            np.ones((1, 1), np.float32),
            ("refrigerator",),
        )
        fuser.fuse(frame, Pose(T), lift(flat, frame, Pose(T)))
    mesh = fuser.scene.mesh()
    assert len(fuser.scene.instance_ids()) == 1
    assert (mesh.instance_ids > 0).any() == keeps
