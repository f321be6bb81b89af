"""Tests for SceneNN folders, including folders with missing or invalid files."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.scenenn.scene_files import write_intrinsics, write_timestamps, write_trajectory_log
from framework.datasets.scenenn.scenenn import SceneNN, SceneNNIntrinsics
from framework.datasets.scenenn.scenenn_annotation import Annotated, write_annotation
from framework.errors import DataError, FrameError
from framework.files.ply import write_ply
from framework.sensors.noise_models import SensorKind

CAMERA = Camera(32, 24, 30.0, 30.0, 15.0, 11.0)
FRAMES = 4
CHAIR, NAMELESS, CABINET, UNLISTED, SOFA = 934338, 12, 7, 55, 3
WALL = 2.0  # distance of the mesh from the first camera, m


def labels() -> list[Annotated]:
    """Return the labels, which are not sorted, like in the dataset."""
    named = ((CHAIR, "chair1", "chair"), (NAMELESS, "thing", ""), (CABINET, "cabinet", "cabinet"), (SOFA, "s", "Sofa"))
    return [Annotated(i, text, nyu, (10, 20, 30), None, None) for i, text, nyu in named]


def striped_wall() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices (V, 3), m, triangles (T, 3) and labels (V,) of a wall with vertical stripes.

    The wall extends from x = -1 to 1 m and has a vertex every 5 cm. Each stripe is 0.25 m wide and has one label.
    """
    x, y = np.meshgrid(np.arange(-20, 21) * 0.05, np.arange(-20, 21) * 0.05)
    vertices = np.stack([x, y, np.full_like(x, WALL)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    triangles = np.concatenate(
        [np.stack([corner, corner + 1, corner + 41], 1), np.stack([corner + 1, corner + 42, corner + 41], 1)]
    )
    stripes = np.array([0, CHAIR, 0, NAMELESS, CABINET, UNLISTED, SOFA, CHAIR])
    index = np.clip(((vertices[:, 0] + 1) / 0.25).astype(int), 0, 7)
    return vertices, triangles.astype(np.int32), stripes[index].astype(np.int32)


def color(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 255, (*CAMERA.shape, 3)).astype(np.uint8)


def pose(k: int) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = 0.1 * k
    return T_world_camera


@pytest.fixture
def root(tmp_path: Path) -> Path:
    scene = tmp_path / "016"
    for name in ("image", "depth"):
        (scene / name).mkdir(parents=True)
    (tmp_path / "intrinsic").mkdir()
    for k in range(FRAMES):
        cv2.imwrite(str(scene / f"image/image{k + 1:05d}.png"), color(k)[..., ::-1])
        cv2.imwrite(str(scene / f"depth/depth{k + 1:05d}.png"), np.full(CAMERA.shape, 2000 + k, np.uint16))
    write_intrinsics(tmp_path / "intrinsic" / "asus.ini", CAMERA)
    write_trajectory_log(scene / "trajectory.log", {k: pose(k) for k in range(FRAMES)})
    write_timestamps(scene / "timestamp.txt", {k + 1: k / 10 for k in range(FRAMES)})
    vertices, triangles, vertex_labels = striped_wall()
    write_ply(scene / "016.ply", vertices, triangles, {"label": vertex_labels})
    write_annotation(scene / "016.xml", labels())
    (tmp_path / "release.txt").write_text("of a test\n")
    return tmp_path


def test_scenenn_frame_matches_files(root: Path) -> None:
    sequence = SceneNN(root, "016")
    assert (len(sequence), sequence.name, sequence.camera) == (FRAMES, "016", CAMERA)
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, 0.2)
    np.testing.assert_array_equal(frame.color, color(2))
    assert (frame.depth == np.float32(2.002)).all()
    assert frame.T_world_camera is not None
    np.testing.assert_allclose(frame.T_world_camera, pose(2), atol=1e-9)
    assert frame.truth is None, (
        "expected no ground-truth masks by default: rendering is slow and few detectors need them"
    )


def test_scenenn_labels_map_to_instances_of_nine_classes(root: Path) -> None:
    truth = SceneNN(root, "016").scene_truth()
    assert truth is not None
    _, _, vertex_labels = striped_wall()
    assert truth.class_names == {CHAIR: "chair", SOFA: "couch", NAMELESS: None, UNLISTED: None}
    expected = np.where(vertex_labels == CABINET, 0, vertex_labels)
    np.testing.assert_array_equal(truth.instance_ids, expected)


def test_scenenn_truth_classes_are_the_nine_classes(root: Path) -> None:
    truth = SceneNN(root, "016").scene_truth()
    assert truth is not None
    assert len(truth.classes or ()) == 9
    assert "toilet" in (truth.classes or ())


def test_scenenn_labels_missing_from_annotation_are_counted(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    SceneNN(root, "016")
    warning = "016.ply: expected an entry in 016.xml for each label, got none for 1 labels, such as 55"
    assert caplog.text.count(warning) == 1
    write_annotation(root / "016" / "016.xml", [*labels(), Annotated(UNLISTED, "x", "chair")])
    caplog.clear()
    SceneNN(root, "016")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_scenenn_empty_annotation_raises(root: Path) -> None:
    (root / "016" / "016.xml").write_text("<annotation/>")
    with pytest.raises(DataError, match=r"016\.xml: expected <label> elements"):
        SceneNN(root, "016")


def test_scenenn_label_without_known_class_has_no_class(root: Path) -> None:
    changed = [
        Annotated(CHAIR, "", "chair", (0, 0, 0), None, None),
        Annotated(SOFA, "sofa", "unknown", (0, 0, 0), None, None),
    ]
    write_annotation(root / "016" / "016.xml", changed)
    truth = SceneNN(root, "016").scene_truth()
    assert truth is not None
    assert set(truth.class_names.values()) == {None}


def test_scenenn_true_masks_match_mesh_at_true_pose(root: Path) -> None:
    frame = SceneNN(root, "016", frame_ground_truth=True)[1]
    assert frame.truth is not None
    u = np.arange(CAMERA.width)
    x = (u - CAMERA.cx) / CAMERA.fx * WALL + 0.1  # m, x of the points on the wall in the world frame
    nearest = np.round(x / 0.05).astype(int) + 20  # index of the nearest vertex column
    _, _, vertex_labels = striped_wall()
    row = vertex_labels.reshape(41, 41)[0]
    expected = np.where(np.abs(x) <= 1, row[np.clip(nearest, 0, 40)], 0)
    expected[expected == CABINET] = 0
    # midway between two vertices, the label depends on rounding
    sure = np.abs(x / 0.05 - np.floor(x / 0.05) - 0.5) > 0.01
    np.testing.assert_array_equal(frame.truth.instance_ids[11, sure], expected[sure])


def test_scenenn_frame_without_usable_pose_raises_on_read(root: Path) -> None:
    path = root / "016" / "trajectory.log"
    write_trajectory_log(path, {k: pose(k) for k in range(FRAMES - 1)})
    text = path.read_text().replace("0.1", "nan", 1)
    path.write_text(text)
    sequence = SceneNN(root, "016")
    assert sequence[0].index == 0
    assert sequence[2].index == 2
    with pytest.raises(FrameError, match=r"frame 1: .*image00002\.png: .*finite"):
        sequence[1]
    with pytest.raises(FrameError, match=r"image00004\.png: expected a pose in trajectory\.log, got none"):
        sequence[3]


def test_scenenn_missing_trajectory_gives_no_pose(root: Path) -> None:
    (root / "016" / "trajectory.log").unlink()
    assert SceneNN(root, "016")[1].T_world_camera is None


@pytest.mark.parametrize("name", ["image/image00003.png", "depth/depth00003.png"])
def test_scenenn_missing_image_raises_for_its_frame(root: Path, name: str) -> None:
    (root / "016" / name).unlink()
    sequence = SceneNN(root, "016")
    assert len(sequence) == FRAMES
    assert sequence[3].index == 3
    with pytest.raises(FrameError, match="00003"):
        sequence[2]


def test_scenenn_missing_timestamps_default_to_30_hz(root: Path) -> None:
    (root / "016" / "timestamp.txt").unlink()
    assert SceneNN(root, "016")[3].timestamp == pytest.approx(0.1)


def test_scenenn_nonincreasing_timestamps_default_to_30_hz(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_timestamps(root / "016" / "timestamp.txt", dict.fromkeys(range(1, FRAMES + 1), 0))
    assert [frame.timestamp for frame in SceneNN(root, "016")] == [k / 30 for k in range(FRAMES)]
    assert caplog.text.count("expected increasing timestamps") == 1


def test_scenenn_incomplete_timestamps_are_ignored(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_timestamps(root / "016" / "timestamp.txt", {k: 7 + k / 10 for k in (1, 2, 4)})
    assert [frame.timestamp for frame in SceneNN(root, "016")] == [k / 30 for k in range(FRAMES)]
    assert caplog.text.count("timestamp.txt: expected timestamps of all images, got none for 1 of 4 images") == 1


@pytest.mark.parametrize("line", ["2 x 5", "2 5", "1 0 0", "2 0 nan"])
def test_scenenn_invalid_timestamp_error_gives_line_number(root: Path, line: str) -> None:
    (root / "016" / "timestamp.txt").write_text(f"1 0 0\n{line}\n")
    with pytest.raises(DataError, match=r"timestamp\.txt, line 2"):
        SceneNN(root, "016")


def test_scenenn_missing_annotation_gives_no_truth(root: Path) -> None:
    (root / "016" / "016.xml").unlink()
    sequence = SceneNN(root, "016")
    assert sequence.scene_truth() is None
    assert sequence.annotation == ""
    with pytest.raises(DataError, match=r"frame_ground_truth: .*016\.xml"):
        SceneNN(root, "016", frame_ground_truth=True)


def test_scenenn_mesh_without_labels_raises(root: Path) -> None:
    vertices, triangles, _ = striped_wall()
    write_ply(root / "016" / "016.ply", vertices, triangles, {"red": np.zeros(len(vertices), np.uint8)})
    with pytest.raises(DataError, match=r"016\.ply: expected an integer vertex property 'label', got"):
        SceneNN(root, "016")


def test_scenenn_annotation_release_is_reported(root: Path) -> None:
    assert SceneNN(root, "016").annotation == "of a test"
    assert SceneNN(root, "016", release="2016").annotation == "2016"
    (root / "release.txt").unlink()
    assert SceneNN(root, "016").annotation == "not named"


def test_scenenn_intrinsics_parameter_selects_file_and_sensor(root: Path) -> None:
    assert SceneNN(root, "016")[0].sensor is SensorKind.KINECT_V1
    with pytest.raises(DataError, match=r"kinect2\.ini"):
        SceneNN(root, "016", intrinsics=SceneNNIntrinsics.KINECT2)
    write_intrinsics(root / "intrinsic" / "kinect2.ini", Camera(32, 24, 29.0, 28.0, 16.0, 12.0))
    sequence = SceneNN(root, "016", intrinsics=SceneNNIntrinsics.KINECT2)
    assert sequence.camera.fx == 29.0
    assert sequence[0].sensor is SensorKind.TIME_OF_FLIGHT


def test_scenenn_timestamp_file_gives_times_of_both_images(root: Path) -> None:
    times = {k: 7 + k / 10 for k in range(1, FRAMES + 1)}
    write_timestamps(root / "016" / "timestamp.txt", times, {k: time - 0.01 for k, time in times.items()})
    frame = SceneNN(root, "016")[0]
    assert (frame.timestamp, frame.depth_time) == (7.1, 7.1)
    assert frame.color_time == pytest.approx(7.09)
