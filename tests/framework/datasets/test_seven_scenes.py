"""Tests for 7-Scenes in the published format."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Camera
from framework.datasets.seven_scenes import BASELINE, COLOR_CAMERA, DEPTH_CAMERA, SevenScenes, register
from framework.errors import DataError
from framework.geometry import back_project, inverse, project, transform
from tests.support.recordings.recordings import fault_of, mapped, opened, write_color, write_depth

FRAMES = 3


def pose_at(k: int) -> np.ndarray:
    """Return the pose T_world_depthcamera of frame k."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0.1 * k, 0.05]).as_matrix()
    T[:3, 3] = 0.1 * k, -1, 2
    return T


def write_pose(folder: Path, k: int, T: np.ndarray) -> None:
    """Write a pose with tabs and eight digits, like the published files."""
    rows = "".join("\t ".join(f"{x:.7e}" for x in row) + "\t \n" for row in T)
    (folder / f"frame-{k:06d}.pose.txt").write_text(rows)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "chess" / "seq-01"
    for k in range(FRAMES):
        write_color(folder / f"frame-{k:06d}.color.png", (40 * k, 100, 200))
        write_depth(folder / f"frame-{k:06d}.depth.png", 2000)
        write_pose(folder, k, pose_at(k))
    (folder / "Thumbs.db").write_bytes(b"\xd0\xcf")
    return folder


def all_points(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return the points (P, 3), m, of all pixels with depth, in the camera frame."""
    v, u = np.nonzero(depth)
    return back_project(camera, np.stack([u, v], 1).astype(np.int32), depth[v, u])


def test_seven_scenes_frame_matches_files(folder: Path) -> None:
    sequence = SevenScenes(folder.parents[1], scene="chess/seq-01")
    assert (len(sequence), sequence.name, sequence.camera) == (FRAMES, "chess-seq-01", COLOR_CAMERA)
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, pytest.approx(2 / 30))
    assert (frame.color == (80, 100, 200)).all()
    assert set(np.unique(frame.depth)) == {0, 2}  # the border is outside the view of the depth camera
    assert (frame.depth > 0).mean() == pytest.approx((529 / 585) ** 2, abs=0.02)
    T_depthcamera_camera = inverse(pose_at(2)) @ frame.T_world_camera
    np.testing.assert_allclose(T_depthcamera_camera[:3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(T_depthcamera_camera[:3, 3], [BASELINE, 0, 0], atol=1e-6)


def test_seven_scenes_recording_is_mapped(folder: Path) -> None:
    """A wall is 2 m in front of each depth camera."""
    root = folder.parents[1]
    result, points_world = mapped(
        opened("seven_scenes", f"dataset.root={root}", "dataset.scene=chess/seq-01", "dataset.stop=2")
    )
    assert (result.frames, result.frames_skipped) == (2, 0)
    for k, points in enumerate(np.split(points_world, 2)):
        z = transform(inverse(pose_at(k)), points.astype(np.float64))[:, 2]
        seen = np.abs(z) > 1e-5  # this fuser maps pixels without depth to the camera position
        assert seen.mean() > 0.7
        np.testing.assert_allclose(z[seen], 2, atol=1e-5)


def test_seven_scenes_registered_depth_matches_projection() -> None:
    """The pixel of each registered point is within half a pixel of its exact projection."""
    raw = np.zeros(DEPTH_CAMERA.shape, np.uint16)
    raw[20::40, 20::40] = 800 + 10 * np.arange(12 * 16).reshape(12, 16)  # pixels far apart, each with a different depth
    registered = register(raw)
    points = all_points(DEPTH_CAMERA, raw.astype(np.float32) / 1000) - np.float32([BASELINE, 0, 0])
    seen = project(COLOR_CAMERA, points)
    inside = (np.abs(seen - [319.5, 239.5]) < [319, 239]).all(axis=1)
    assert inside.sum() > 150
    for (u, v), z in zip(seen[inside], points[inside, 2], strict=True):
        rows, columns = np.nonzero(registered == round(1000 * z))
        assert len(rows) == 1
        assert abs(columns[0] - u) <= 0.501
        assert abs(rows[0] - v) <= 0.501


def test_seven_scenes_register_keeps_nearest_depth_and_holes() -> None:
    raw = np.full(DEPTH_CAMERA.shape, 4000, np.uint16)
    raw[:, 300:340] = 1000
    raw[:100] = 65535
    raw[400:] = 0
    registered = register(raw)
    assert set(np.unique(registered)) == {0, 1000, 4000}
    assert not registered[:110].any()
    assert not registered[390:].any()
    row = registered[240]
    near = np.flatnonzero(row == 1000)
    # x = (u - 320) / 585 m at 1 m, seen from 25 mm to the right
    np.testing.assert_allclose(near[[0, -1]], 320 + 529 * ((np.array([300, 339]) - 320) / 585 - 0.025), atol=0.51)
    # the parallax moves the near strip to the left, over the far wall, and leaves a gap on the right
    assert row[near[0] - 1] == 4000
    gap = np.flatnonzero(row[near[-1] + 1 :] == 4000)[0]
    assert gap == pytest.approx(529 * 0.025 * (1 / 1 - 1 / 4), abs=1.5)


def test_seven_scenes_rounded_rotation_is_made_rigid(folder: Path) -> None:
    rounded = np.round(pose_at(1), 3)
    write_pose(folder, 1, rounded)
    T = SevenScenes(folder)[1].T_world_camera
    assert T is not None
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(T[:3, :3], pose_at(1)[:3, :3], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "pose.txt: expected a text file, got no such file"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "pose.txt: expected 4 lines of 4 numbers, got 3 lines"),
        ("1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n", "pose.txt, line 2: expected 4 numbers, got 3"),
        ("1 0 0 0\n0 one 0 0\n0 0 1 0\n0 0 0 1\n", "pose.txt, line 2: expected 4 numbers, got 'one'"),
        ("1 0 0 0\n0 1 0 0\n0 0 nan 0\n0 0 0 1\n", "pose.txt: pose: expected finite values"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "pose.txt: pose: expected a rigid transform, got |R R^T - I| ="),
        ("1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", "pose.txt: pose: expected a rigid transform, got |R R^T - I| ="),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", "pose.txt: pose: expected the last row 0 0 0 1"),
    ],
)
def test_seven_scenes_invalid_pose_raises_for_its_frame(folder: Path, text: str | None, message: str) -> None:
    path = folder / "frame-000001.pose.txt"
    path.unlink() if text is None else path.write_text(text)
    assert re.search(rf"frame-000001\.{message}", fault_of(SevenScenes(folder), 1))


@pytest.mark.parametrize("name", ["color", "depth"])
def test_seven_scenes_missing_image_raises_for_its_frame(folder: Path, name: str) -> None:
    (folder / f"frame-000002.{name}.png").unlink()
    assert f"frame-000002.{name}.png: expected a readable file" in fault_of(SevenScenes(folder), 2)


def test_seven_scenes_empty_folder_error_gives_scene_example(folder: Path) -> None:
    with pytest.raises(
        DataError, match=r"expected images such as frame-000000\.color\.png, .*; set dataset\.scene .* chess/seq-01"
    ):
        SevenScenes(folder.parents[1], scene="chess")


def test_seven_scenes_image_size_mismatch_raises(folder: Path) -> None:
    write_color(folder / "frame-000001.color.png", (1, 2, 3), (240, 320))
    assert "expected 640x480 px as in the camera of 7-Scenes, got 320x240 px" in fault_of(SevenScenes(folder), 1)
    write_depth(folder / "frame-000000.depth.png", 1, (240, 320))
    with pytest.raises(DataError, match=r"frame-000000\.depth\.png: expected 640x480 px .*, got 320x240 px"):
        SevenScenes(folder)


# Other recordings in the same layout


def own_recording(folder: Path, suffix: str = "png", digits: int = 6) -> Path:
    """Write a sequence of another camera, with depth of 2 m and poses of the color camera."""
    for k in range(FRAMES):
        stem = f"frame-{k:0{digits}d}"
        write_color(folder / f"{stem}.color.{suffix}", (40 * k, 100, 200), (240, 320))
        write_depth(folder / f"{stem}.depth.png", 2000, (240, 320))
        (folder / f"{stem}.pose.txt").write_text("\n".join(" ".join(map(str, row)) for row in pose_at(k)))
    return folder


CAMERA_JSON = '{"width": 320, "height": 240, "fx": 300, "fy": 301, "cx": 158, "cy": 121, "depth_scale": 500}'
K = "300 0 158\n0 301 121\n0 0 1\n"


@pytest.mark.parametrize(("suffix", "digits"), [("png", 6), ("jpg", 6), ("jpeg", 4), ("png", 1), ("jpg", 8)])
@pytest.mark.parametrize(
    ("file", "content", "depth"),
    [
        ("camera.json", CAMERA_JSON, 4),
        ("../camera.json", CAMERA_JSON, 4),
        ("camera-intrinsics.txt", K, 2),
        ("../camera-intrinsics.txt", K.replace(" ", ", "), 2),
        ("intrinsic.txt", "300 0 158 0\n0 301 121 0\n0 0 1 0\n0 0 0 1\n", 2),
    ],
)
def test_seven_scenes_own_camera_overrides_published(
    tmp_path: Path, suffix: str, digits: int, file: str, content: str, depth: float, caplog: pytest.LogCaptureFixture
) -> None:
    folder = own_recording(tmp_path / "room" / "seq-01", suffix, digits)
    (folder / file).write_text(content)
    with caplog.at_level("INFO"):
        sequence = SevenScenes(tmp_path, scene="room/seq-01")
    assert sequence.camera == Camera(320, 240, 300, 301, 158, 121)
    assert (len(sequence), "camera from" in caplog.text) == (FRAMES, True)
    assert (sequence[1].depth == depth).all()
    assert sequence[1].T_world_camera == pytest.approx(pose_at(1))


def test_seven_scenes_published_camera_is_logged(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        SevenScenes(folder)
    assert "published camera of 7-Scenes" in caplog.text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("300 158 301 121", r"expected a 3x3 intrinsic matrix, .* got 4 numbers, 300 158 301 121"),
        ("300 9 158\n0 301 121\n0 0 1", r"expected intrinsics fx 0 cx / 0 fy cy / 0 0 1, got 300 9 158"),
        ("fx 0 158\n0 301 121\n0 0 1", r"expected a 3x3 intrinsic matrix, .* got 'fx 0 158 0 301 121 0 0 1'"),
    ],
)
def test_seven_scenes_invalid_intrinsics_raise(tmp_path: Path, content: str, message: str) -> None:
    folder = own_recording(tmp_path / "room")
    (folder / "camera-intrinsics.txt").write_text(content)
    with pytest.raises(DataError, match=message):
        SevenScenes(folder)


def test_seven_scenes_two_images_of_frame_raise(folder: Path) -> None:
    write_color(folder / "frame-000001.color.jpg", (1, 2, 3))
    with pytest.raises(DataError, match=r"expected one color image of the frame, got also frame-000001\.color\.jpg"):
        SevenScenes(folder)
    (folder / "frame-000001.color.jpg").rename(folder / "frame-1.color.jpg")
    with pytest.raises(DataError, match=r"expected one name for frame 1, got frame-000001 and frame-1"):
        SevenScenes(folder)
