"""Tests for ground truth that the user selects, with a labeled wall in front of the camera."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.ground_truth.named_truth import read_named_truth
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.tum_rgbd import TumRgbd
from framework.detection.stored.cache import frame_hash
from framework.errors import ConfigError, DataError, NoPoseError
from framework.evaluation.truth_alignment import in_map_world
from framework.files.ply import read_ply, write_ply
from framework.files.tum_trajectory import read_tum, write_tum
from framework.geometry import exp_se3, inverse, transform
from plugins.detectors.ground_truth import GroundTruthDetector
from tests.support.recordings.recordings import opened

CAMERA = Camera(48, 32, 40.0, 41.0, 23.5, 15.5)
FRAMES = 4
WALL = 2.0  # z of the wall in the world frame, m
CELL = 0.05  # distance between the vertices of the wall, m
CHAIR, UNKNOWN = 7, 70_000  # instance ids at x < -0.3 m and at x > 0.4 m
CLASSES = {str(CHAIR): {"name": "arm chair", "class": "chair"}, str(UNKNOWN): {"name": "thing", "class": None}}
# from the world frame of the recording to that of a tracked run
T_RUN_WORLD = exp_se3(np.array([1.0, -2.0, 0.5, 0.3, -0.8, 0.4]))


def pose(k: int) -> np.ndarray:
    return exp_se3(np.array([0.1 * k, 0.02 * k, 0.0, 0.0, 0.05 * k, 0.0]))


def label_at(x: np.ndarray) -> np.ndarray:
    return np.where(x < -0.3, CHAIR, np.where(x > 0.4, UNKNOWN, 0)).astype(np.int32)


def write_wall(path: Path, T: np.ndarray | None = None, **properties: np.ndarray) -> None:
    """Write the mesh of a wall of 4 x 4 m. `properties` replace the instance labels."""
    side = np.arange(-2.0, 2.0 + CELL / 2, CELL)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x, y, np.full_like(x, WALL)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(len(side) - 1)[:, None] * len(side) + np.arange(len(side) - 1)).ravel()
    below = corner + len(side)
    triangles = np.concatenate([np.stack([corner, corner + 1, below], 1), np.stack([corner + 1, below + 1, below], 1)])
    write_ply(
        path,
        vertices if T is None else transform(T, vertices).astype(np.float32),
        triangles.astype(np.int32),
        properties or {"instance": label_at(vertices[:, 0])},
    )


def seen_labels(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the labels (H, W) of the wall in frame k and a mask (H, W) without the pixels next to label borders."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(CAMERA.shape)], axis=-1)
    T = pose(k)
    direction = rays @ T[:3, :3].T
    x = T[0, 3] + direction[..., 0] * (WALL - T[2, 3]) / direction[..., 2]
    return label_at(x), np.minimum(np.abs(x + 0.3), np.abs(x - 0.4)) > CELL


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a recording that has poses but no annotation."""
    root = tmp_path / "room"
    for name in ("color", "depth"):
        (root / name).mkdir(parents=True)
    camera = {key: getattr(CAMERA, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    (root / "camera.json").write_text(json.dumps(camera | {"depth_scale": 1000}))
    for k in range(FRAMES):
        cv2.imwrite(str(root / f"color/{k:06d}.png"), np.full((*CAMERA.shape, 3), 40 + k, np.uint8))
        cv2.imwrite(str(root / f"depth/{k:06d}.png"), np.full(CAMERA.shape, 2000, np.uint16))
    write_tum(root / "poses.txt", [k / 30 for k in range(FRAMES)], [pose(k) for k in range(FRAMES)])
    return root


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    path = tmp_path / "annotation" / "labeled.ply"
    path.parent.mkdir()
    write_wall(path)
    (path.parent / "instances.json").write_text(json.dumps(CLASSES))
    return path


@pytest.fixture
def tracked_run(tmp_path: Path) -> Path:
    """Return a run of the recording with a separate world frame. UNKNOWN is tentative and not in instances.json."""
    run = tmp_path / "run"
    run.mkdir()
    write_wall(run / "mesh.ply", T_RUN_WORLD)
    (run / "instances.json").write_text(json.dumps([{"id": CHAIR, "class": "chair"}]))
    (run / "metrics.json").write_text(json.dumps({"pose_source": "tracked"}))
    write_tum(run / "trajectory.txt", [k / 30 for k in range(FRAMES)], [T_RUN_WORLD @ pose(k) for k in range(FRAMES)])
    return run


def test_named_truth_renders_masks_from_mesh(folder: Path, mesh: Path) -> None:
    video = RgbdFolder(folder, ground_truth=mesh)
    for k in range(FRAMES):
        truth = video[k].truth
        assert truth is not None
        expected, clear = seen_labels(k)
        assert set(expected[clear].tolist()) == {0, CHAIR, UNKNOWN}
        np.testing.assert_array_equal(truth.instance_ids[clear], expected[clear])
    detections = GroundTruthDetector().detect(video[1])
    assert [detections.classes[c] for c in detections.class_probabilities.argmax(axis=1)] == ["chair"]


def test_named_truth_scene_is_mesh_in_world_frame_of_poses(folder: Path, mesh: Path) -> None:
    video = RgbdFolder(folder, ground_truth=mesh, stop=1)
    truth = video.scene_truth()
    assert truth is not None
    np.testing.assert_array_equal(truth.points_world, read_ply(mesh).vertices)
    assert truth.class_names == {CHAIR: "chair", UNKNOWN: None}
    assert video.annotation == "annotation/labeled.ply"
    assert in_map_world(truth, np.array([0.0, 1 / 30]), np.array([pose(0), pose(3)])) is truth


def test_named_truth_replaces_annotation_of_recording(folder: Path, mesh: Path) -> None:
    (folder / "instance").mkdir()
    for k in range(FRAMES):
        cv2.imwrite(str(folder / f"instance/{k:06d}.png"), np.full(CAMERA.shape, 3, np.uint16))
    (folder / "instances.json").write_text('{"3": {"name": "own", "class": "cup"}}')
    own, named = RgbdFolder(folder), RgbdFolder(folder, ground_truth=mesh)
    assert set(own.scene_truth().class_names) == {3}
    assert set(named.scene_truth().class_names) == {CHAIR, UNKNOWN}
    assert 3 not in named[0].truth.instance_ids
    (folder / "instances.json").write_text("damaged")
    assert RgbdFolder(folder, ground_truth=mesh).scene_truth() is not None


def test_named_truth_finds_instances_json_in_parent_folder(folder: Path, mesh: Path) -> None:
    (mesh.parent / "instances.json").rename(mesh.parents[1] / "instances.json")
    assert read_named_truth(mesh).mesh.class_names == {CHAIR: "chair", UNKNOWN: None}


def test_named_truth_selects_annotated_mesh_of_directory(mesh: Path) -> None:
    mesh.rename(mesh.parent / "mesh.ply")
    named = read_named_truth(mesh.parent)
    assert (named.name, named.trajectory) == ("annotation/mesh.ply", None)


def test_named_truth_of_frame_without_pose_is_not_rendered(folder: Path, tracked_run: Path) -> None:
    times, poses = read_tum(tracked_run / "trajectory.txt")
    write_tum(tracked_run / "trajectory.txt", times[:2], poses[:2])
    frame = RgbdFolder(folder, ground_truth=tracked_run)[2]
    with pytest.raises(NoPoseError, match="frame 2: expected a pose to render ground-truth instances"):
        GroundTruthDetector().detect(frame)
    assert frame_hash(frame, ("color", "truth")), "expected a hash without rendering, as stored detections need it"


def test_named_truth_mesh_without_given_poses_raises(folder: Path, mesh: Path) -> None:
    (folder / "poses.txt").unlink()
    with pytest.raises(ConfigError, match=r"dataset\.ground_truth: expected given poses.*to a run directory"):
        RgbdFolder(folder, ground_truth=mesh)


def test_named_truth_run_without_common_time_raises(folder: Path, tracked_run: Path) -> None:
    _, poses = read_tum(tracked_run / "trajectory.txt")
    write_tum(tracked_run / "trajectory.txt", [10.0 + k for k in range(FRAMES)], poses)
    with pytest.raises(ConfigError, match=r"dataset\.ground_truth: expected a run of this recording"):
        RgbdFolder(folder, ground_truth=tracked_run)


@pytest.mark.parametrize("given_poses", [True, False])
def test_named_truth_tracked_run_is_aligned_to_map(folder: Path, tracked_run: Path, given_poses: bool) -> None:
    if not given_poses:
        (folder / "poses.txt").unlink()
    video = RgbdFolder(folder, ground_truth=tracked_run)
    expected, clear = seen_labels(3)
    np.testing.assert_array_equal(
        video[3].truth.instance_ids[clear],
        np.where(expected == CHAIR, CHAIR, 0)[clear],
        "expected masks at the poses of the run",
    )
    truth = video.scene_truth()
    np.testing.assert_array_equal(np.unique(truth.instance_ids), [0, CHAIR])
    T_map_world = inverse(pose(1))  # the map begins with frame 1
    map_poses = np.array([T_map_world @ pose(k) for k in (1, 2, 3)])
    aligned = in_map_world(truth, np.array([1, 2, 3]) / 30, map_poses)
    wall = transform(T_map_world @ inverse(T_RUN_WORLD), read_ply(tracked_run / "mesh.ply").vertices)
    np.testing.assert_allclose(aligned.points_world, wall, atol=1e-5)
    np.testing.assert_array_equal(aligned.instance_ids, truth.instance_ids)


def test_named_truth_run_with_given_poses_is_not_aligned(folder: Path, tracked_run: Path) -> None:
    """The map begins at the given pose. Its drift is part of the error."""
    (tracked_run / "metrics.json").write_text('{"pose_source": "ground_truth"}')
    times, poses = read_tum(tracked_run / "trajectory.txt")
    truth = RgbdFolder(folder, ground_truth=tracked_run).scene_truth()
    drifted = poses.copy()
    drifted[1:, 0, 3] += 0.1
    assert in_map_world(truth, times, drifted) is truth
    (tracked_run / "metrics.json").write_text('{"pose_source": "tracked"}')
    truth = RgbdFolder(folder, ground_truth=tracked_run).scene_truth()
    moved = in_map_world(truth, times, drifted).points_world - truth.points_world
    assert 0.03 < moved[:, 0].mean() < 0.1


@pytest.mark.parametrize(
    ("spoil", "kind", "message"),
    [
        (
            lambda mesh: mesh.unlink(),
            ConfigError,
            r"^dataset\.ground_truth: expected a labeled mesh .*, got the nonexistent path .*\.ply$",
        ),
        (
            lambda mesh: write_wall(mesh, label=np.ones(6561, np.int32)),
            DataError,
            "'instance', got only .* x, y, z, label;",
        ),
        (lambda mesh: write_wall(mesh, instance=np.ones(6561, np.float32)), DataError, "'instance', got float32;"),
        (lambda mesh: write_wall(mesh, instance=np.zeros(6561, np.int32)), DataError, "got only instance 0"),
        (lambda mesh: write_wall(mesh, instance=np.full(6561, -1, np.int32)), DataError, "instance: expected values"),
        (lambda mesh: write_wall(mesh, instance=np.full(6561, 9, np.int32)), DataError, "got none for instance 9"),
        (lambda mesh: (mesh.parent / "instances.json").unlink(), DataError, "with the class of each instance.*none$"),
        (lambda mesh: (mesh.parent / "instances.json").write_text('{"7": {}}'), DataError, "instance 7: expected"),
        (lambda mesh: (mesh.parent / "instances.json").write_text("7"), DataError, "expected a JSON object"),
        (
            lambda mesh: (mesh.parent / "instances.json").write_text('[{"id": "a"}]'),
            DataError,
            "entry 1: expected a JSON object with an id",
        ),
        (lambda mesh: (mesh.parent / "instances.json").write_text("[]"), DataError, "got only instance 0"),
        (
            lambda mesh: (mesh.parent / "instances.json").write_text('[{"id": 7, "class": "chair"}]'),
            DataError,
            r"trajectory\.txt: expected a trajectory in TUM format, got no such file",
        ),
    ],
)
def test_named_truth_unusable_file_raises_one_line_error(
    spoil, kind: type[Exception], message: str, folder: Path, mesh: Path
) -> None:
    spoil(mesh)
    with pytest.raises(kind, match=message) as caught:
        RgbdFolder(folder, ground_truth=mesh)
    assert "\n" not in str(caught.value)


def test_named_truth_rejects_points_without_faces(folder: Path, mesh: Path) -> None:
    ply = read_ply(mesh)
    write_ply(mesh, ply.vertices, ply.triangles[:0], ply.properties)
    with pytest.raises(DataError, match="expected faces to render masks from"):
        RgbdFolder(folder, ground_truth=mesh)


def test_named_truth_rejects_directory_without_mesh(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"dataset\.ground_truth: expected mesh\.ply in the directory"):
        RgbdFolder(folder, ground_truth=tmp_path)


@pytest.mark.parametrize("name", ["redkitchen", "freiburg1_rpy"])
def test_named_truth_masks_agree_with_annotated_images(shared_data: Path, name: str) -> None:
    """With wrong axes, an inverted pose or wrong ids, less than half of the annotated pixels would agree."""
    kitchen, desk = shared_data / "redkitchen", shared_data / "tum_fr1_rpy_a"
    images: list[Path] = sorted(((kitchen if name == "redkitchen" else desk / "annotation") / "instance").iterdir())
    video: Recording = RgbdFolder(kitchen, ground_truth=kitchen / "annotation" / "mesh.ply")
    if name == "freiburg1_rpy":
        video = TumRgbd(desk, "rgbd_dataset_freiburg1_rpy", ground_truth=desk / "annotation")
    for k in (60, 240):
        truth = video[k].truth
        assert truth is not None
        image = next(path for path in images if path.stem == Path(video.contents.frames[k].images.color_name).stem)
        annotated = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        labeled = annotated > 0
        assert (truth.instance_ids == annotated)[labeled].mean() > 0.85


@pytest.mark.parametrize(
    ("option", "root", "scene"),
    [
        ("replica_nice_slam", "originals/replica_nice_slam", "office0"),
        ("rgbd_folder", "redkitchen", ""),
        ("scannet", "scannet_scene0000", "scene0000_00"),
        ("seven_scenes", "originals/seven_scenes/redkitchen", "seq-01"),
        ("tum_rgbd", "tum_fr1_rpy_a", "rgbd_dataset_freiburg1_rpy"),
    ],
)
def test_named_truth_applies_to_every_dataset(
    shared_data: Path, mesh: Path, option: str, root: str, scene: str
) -> None:
    """The mesh is a wall in front of the first frame with a pose."""
    place = (f"dataset.root={shared_data / root}", f"dataset.scene={scene}")
    first = next(frame for frame in opened(option, *place) if frame.T_world_camera is not None)
    write_wall(mesh, first.T_world_camera)
    named = opened(option, *place, f"dataset.ground_truth={mesh}", f"dataset.start={first.index}")
    scene_truth, truth = named.scene_truth(), named[0].truth
    assert scene_truth is not None
    assert scene_truth.class_names == {CHAIR: "chair", UNKNOWN: None}
    np.testing.assert_array_equal(scene_truth.points_world, read_ply(mesh).vertices)
    camera = named.camera
    x = (np.arange(camera.width) - camera.cx) / camera.fx * WALL
    clear = (np.minimum(np.abs(x + 0.3), np.abs(x - 0.4)) > CELL) & (np.abs(x) < 1.9)
    assert truth is not None
    assert set(label_at(x[clear]).tolist()) == {0, CHAIR, UNKNOWN}
    middle = truth.instance_ids[camera.height // 2]
    np.testing.assert_array_equal(middle[clear], label_at(x[clear]))
