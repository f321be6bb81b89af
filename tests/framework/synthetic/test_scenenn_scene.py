"""Tests for rendered rooms that are written as SceneNN files."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import check_rigid
from framework.datasets.scenenn.scene_files import read_trajectory_log
from framework.datasets.scenenn.scenenn_annotation import read_annotation
from framework.errors import ConfigError
from framework.files.image_files import read_color, read_uint16
from framework.files.ply import PlyMesh, read_ply
from framework.geometry import inverse
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.synthetic import scenenn_scene
from framework.synthetic.benchmark import SceneSpec
from framework.synthetic.furniture.cluttered_groups import chair_row
from framework.synthetic.furniture.groups import toilet_group
from framework.synthetic.ray_caster import RayCaster, image_rays
from framework.synthetic.scenenn_scene import (
    _NYU_CLASSES,
    ASUS,
    GENERATION,
    T_YUP_ZUP,
    BenchmarkSettings,
    SceneNNScene,
    frame_files,
    trajectory_file,
)
from framework.vocabulary.label_spaces import SCENENN_TO_COCO, SPACES

pytestmark = pytest.mark.integration

SPEC = SceneSpec("bathroom", (toilet_group, lambda rng: chair_row(rng, 2)), {"toilet": 1, "chair": 2})
RECORDING = BenchmarkSettings(seed=3, frames=9, width=160)
SHOWN = (0, 4, 8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneNNScene:
    scene = SceneNNScene(tmp_path_factory.mktemp("rooms") / "007", SPEC, RECORDING)
    for index in SHOWN:
        scene.write_frame(index)
    scene.write_truth()
    scene.write_walk()
    return scene


@pytest.fixture(scope="module")
def mesh(scene: SceneNNScene) -> PlyMesh:
    return read_ply(scene.folder / "007.ply")


def poses(scene: SceneNNScene):
    return read_trajectory_log(trajectory_file(scene.folder)).poses


def test_scenenn_scene_files_have_scenenn_names(scene: SceneNNScene) -> None:
    names = {str(path.relative_to(scene.folder)) for path in scene.folder.rglob("*.*")}
    numbered = {f"{kind}/{kind}{k + 1:05d}.png" for k in SHOWN for kind in ("image", "depth")}
    assert names == numbered | {"007.ply", "007.xml", "timestamp.txt", "trajectory.log"}
    lines = (scene.folder / "timestamp.txt").read_text().splitlines()
    assert lines[:3] == ["1 0 0", "2 100000 100000", "3 200000 200000"]
    assert len(lines) == RECORDING.frames


def test_scenenn_scene_poses_are_rigid_in_y_up_world(scene: SceneNNScene) -> None:
    found = poses(scene)
    assert list(found) == list(range(RECORDING.frames))
    for index, T_world_camera in found.items():
        check_rigid(f"pose {index}", T_world_camera)
        np.testing.assert_allclose(inverse(T_YUP_ZUP) @ T_world_camera, scene.path.pose(index), atol=1e-6)
        assert 1.2 < T_world_camera[1, 3] < 1.8, "expected a camera height of 1.2 to 1.8 m"
        assert T_world_camera[1, 1] < -0.8, "expected a camera y axis that points down"
    assert np.linalg.det(T_YUP_ZUP) == 1.0


def test_scenenn_scene_floor_is_at_zero_without_instance(mesh: PlyMesh) -> None:
    floor = np.abs(mesh.vertices[:, 1]) < 1e-4
    assert floor.sum() > 1000
    assert (mesh.properties["label"][floor] == 0).mean() > 0.95
    assert mesh.vertices[:, 1].min() > -2e-3
    assert mesh.vertices[:, 1].max() < 2.6


def test_scenenn_scene_annotation_labels_match_mesh(scene: SceneNNScene, mesh: PlyMesh) -> None:
    annotated = read_annotation(scene.folder / "007.xml")
    labels = mesh.properties["label"]
    assert sorted(one.id for one in annotated) == sorted(set(labels.tolist()) - {0})
    assert max(one.id for one in annotated) > 1000, "expected ids that are not consecutive"
    names = [one.nyu_class for one in annotated if one.nyu_class in SCENENN_TO_COCO]
    assert sorted(set(names) - {"books"}) == ["chair", "toilet"]
    assert names.count("chair") == 2
    for one in annotated:
        assert one.text
        points = mesh.vertices[labels == one.id]
        np.testing.assert_allclose(one.aabb, [points.min(axis=0), points.max(axis=0)], atol=1e-6)
    of_pieces = [scene.room.surfaces.class_names[k] for k in np.argsort(scene.labels)[1:]]
    assert of_pieces != sorted(of_pieces, key=str), "expected ids in random order"


def test_clutter_names_exclude_evaluated_classes() -> None:
    assert set(_NYU_CLASSES.values()) <= {*SPACES["nyu40"]} - set(SCENENN_TO_COCO)


@pytest.mark.parametrize("index", SHOWN)
def test_scenenn_scene_mesh_matches_rendered_depth_and_labels(scene: SceneNNScene, mesh: PlyMesh, index: int) -> None:
    picture = scene.renderer.render(scene.camera, scene.path.pose(index))
    depth, instance_ids = picture.depth, picture.instance_ids
    hits = RayCaster(mesh.vertices, mesh.triangles).cast(image_rays(scene.camera, poses(scene)[index]))
    met = hits.triangle != NO_TRIANGLE
    assert met[picture.unread < 1].mean() > 0.97, "expected holes only at occlusion borders"
    same = met & (np.abs(hits.distance - depth) < 1e-3)
    assert same.sum() > 0.985 * met.sum()
    labels = mesh.properties["label"][mesh.triangles[hits.triangle, 0]]
    assert (labels[same] == scene.labels[instance_ids][same]).mean() > 0.9995


@pytest.mark.parametrize("index", SHOWN)
def test_scenenn_scene_depth_in_millimeters_matches_mesh(scene: SceneNNScene, mesh: PlyMesh, index: int) -> None:
    color_file, depth_file = frame_files(scene.folder, index)
    depth_mm = read_uint16(depth_file).astype(np.float64)
    assert depth_mm.max() <= 6000
    hits = RayCaster(mesh.vertices, mesh.triangles).cast(image_rays(scene.camera, poses(scene)[index]))
    read = (depth_mm > 0) & (hits.triangle != NO_TRIANGLE)
    error = np.abs(depth_mm[read] - 1000 * hits.distance[read])
    assert read.mean() > 0.6
    assert np.median(error / (hits.distance[read] ** 2)) < 3.0, "expected noise below 3 mm per squared meter of depth"
    color = read_color(color_file)
    assert color.shape == (*scene.camera.shape, 3)
    assert color.std() > 10


def test_benchmark_camera_matches_scenenn() -> None:
    assert BenchmarkSettings().camera == ASUS
    assert RECORDING.camera.shape == (120, 160)
    assert RECORDING.camera.fx == pytest.approx(544.47329 / 4)
    assert RECORDING.release == f"synthetic {GENERATION}, seed 3, 9 frames"


@pytest.mark.parametrize(
    "wrong", [{"seed": -1}, {"frames": 0}, {"width": 8}, {"width": 162}, {"camera_speed": 0.0}, {"rate": 31.0}]
)
def test_benchmark_settings_out_of_range_raise(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong)).replace("_", "-")):
        BenchmarkSettings(**wrong)


def test_scenenn_scene_half_rate_equals_every_second_frame(
    scene: SceneNNScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenenn_scene, "NOISE", 0.0)  # color noise differs between frames
    (tmp_path / "image").mkdir()
    (tmp_path / "depth").mkdir()
    half = replace(RECORDING, rate=RECORDING.rate / 2)
    assert half.stride == 2 * RECORDING.stride
    colors = []
    for recording, index in ((RECORDING, 2), (half, 1), (replace(RECORDING, rate=20.0), 2)):
        other = copy(scene)
        other.folder, other.recording = tmp_path, recording
        other.path = replace(scene.path, phase_speed=scene.path.phase_speed * recording.stride / RECORDING.stride)
        other.write_frame(index)
        colors.append(read_color(frame_files(tmp_path, index)[0]))
    np.testing.assert_array_equal(colors[0], colors[1])
    assert (colors[0] != colors[2]).any(), "expected other images: at twice the rate, the camera moves half as far"
