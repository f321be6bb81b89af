"""Tests for TUM RGB-D in the published format, including missing and invalid files."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from framework.data import Camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.tum_rgbd import PUBLISHED, Intrinsics, TumRgbd, associate
from framework.errors import ConfigError, DataError
from framework.sensors.noise_models import SensorKind
from tests.support.recordings.recordings import fault_of, mapped, opened, write_color, write_depth

START = 1305031102.175304  # s
DEPTH_DELAY = 0.0151  # time from each color image to its depth image, s
FRAMES = 3
HEADER = "# {}\n# file: 'rgbd_dataset_freiburg1_xyz.bag'\n# timestamp {}\n"


def color_time(k: int) -> float:
    return round(START + k / 30, 6)


def write_lists(folder: Path, color: list[float], depth: list[float]) -> None:
    for name, title, times in (("rgb", "color images", color), ("depth", "depth maps", depth)):
        lines = [f"{time:.6f} {name}/{time:.6f}.png\n" for time in times]
        (folder / f"{name}.txt").write_text(HEADER.format(title, "filename") + "".join(lines))


def write_poses(folder: Path, lines: list[str]) -> None:
    text = HEADER.format("ground truth trajectory", "tx ty tz qx qy qz qw") + "\n".join(lines) + "\n"
    (folder / "groundtruth.txt").write_text(text)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a recording of a wall at z = 2 m. The camera moves at 1 m/s along x, and poses are stored at 100 Hz."""
    folder = tmp_path / "rgbd_dataset_freiburg1_xyz"
    color = [color_time(k) for k in range(FRAMES)]
    depth = [time + DEPTH_DELAY for time in color]
    for k, (of_color, of_depth) in enumerate(zip(color, depth, strict=True)):
        write_color(folder / f"rgb/{of_color:.6f}.png", (10 * k, 20, 30))
        write_depth(folder / f"depth/{of_depth:.6f}.png", 10_000)
    write_lists(folder, color, depth)
    write_poses(folder, [f"{START + k / 100:.4f} {k / 100:.4f} 0 0 0 0 0 1" for k in range(-3, 20)])
    return folder


def test_tum_rgbd_frame_matches_files(folder: Path) -> None:
    sequence = TumRgbd(folder)
    assert (len(sequence), sequence.name) == (FRAMES, "rgbd_dataset_freiburg1_xyz")
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, color_time(2))
    inside = np.s_[40:440, 40:600]  # region in which the undistorted image is complete
    assert (frame.color[inside] == (20, 20, 30)).all()
    assert (frame.depth[inside] == 2).all()  # 5000 units per meter
    assert frame.T_world_camera is not None
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], [2 / 30, 0, 0], atol=1e-4)  # pose times have four decimals
    assert frame.camera == PUBLISHED[Intrinsics.FREIBURG1].camera


def test_tum_rgbd_recording_is_mapped(folder: Path) -> None:
    places = f"dataset.root={folder.parent}", f"dataset.scene={folder.name}"
    result, points_world = mapped(opened("tum_rgbd", *places, "dataset.stop=2", "dataset.undistort=false"))
    assert (result.frames, result.frames_skipped, result.frames_lost) == (2, 0, 0)
    np.testing.assert_allclose(points_world[:, 2], 2, atol=1e-6)
    # the first pixel of each frame is left of the camera, which moves along x
    lefts = points_world[:: 640 * 480, 0]
    np.testing.assert_allclose(lefts, (0 - 318.6) / 517.3 * 2 + np.arange(2) / 30, atol=1e-4)


def test_tum_rgbd_published_distortion_is_removed(folder: Path) -> None:
    board = np.kron(np.indices((15, 20)).sum(axis=0) % 2, np.full((32, 32), 200)).astype(np.uint8)
    path = next((folder / "rgb").glob("*.png"))
    cv2.imwrite(str(path), np.stack([board] * 3, axis=-1))
    K, lens = PUBLISHED[Intrinsics.FREIBURG1].camera.K, np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    k = [color_time(k) for k in range(FRAMES)].index(float(path.stem))
    expected = cv2.undistort(np.stack([board] * 3, axis=-1), K, lens)
    found = TumRgbd(folder)[k].color.astype(int)
    assert np.abs(found - expected).mean() < 0.2
    assert np.abs(board[..., None] - expected.astype(int)).mean() > 10
    assert (TumRgbd(folder, undistort=False)[k].color == board[..., None]).all()


@pytest.mark.parametrize("number", [1, 2, 3])
def test_tum_rgbd_folder_name_selects_camera(folder: Path, number: int) -> None:
    renamed = folder.rename(folder.parent / f"rgbd_dataset_freiburg{number}_long_office")
    assert TumRgbd(renamed).camera == PUBLISHED[Intrinsics[f"FREIBURG{number}"]].camera
    assert TumRgbd(renamed, intrinsics=Intrinsics.ROS_DEFAULT).camera == PUBLISHED[Intrinsics.ROS_DEFAULT].camera


def test_tum_rgbd_unknown_folder_name_requires_intrinsics(folder: Path) -> None:
    mine = folder.rename(folder.parent / "my_desk")
    with pytest.raises(
        ConfigError, match=r"dataset\.intrinsics: expected freiburg1.* in the folder's name, got my_desk"
    ):
        TumRgbd(mine)
    sequence = opened("tum_rgbd", f"dataset.root={mine}", "dataset.intrinsics=FREIBURG3")
    assert sequence.camera == PUBLISHED[Intrinsics.FREIBURG3].camera


OWN = {"width": 640, "height": 480, "fx": 600.0, "fy": 601.0, "cx": 310.0, "cy": 250.0, "depth_scale": 1000.0}


def test_tum_rgbd_custom_recording_uses_camera_json(folder: Path) -> None:
    assert TumRgbd(folder)[0].sensor is SensorKind.KINECT_V1
    mine = folder.rename(folder.parent / "my_desk")
    (mine / "camera.json").write_text(json.dumps(OWN | {"sensor": "REALSENSE_D435"}))
    sequence = TumRgbd(mine)
    assert sequence[0].sensor is SensorKind.REALSENSE_D435
    assert sequence.camera == Camera(640, 480, 600.0, 601.0, 310.0, 250.0)
    assert sequence.calibration.lens is None
    assert (sequence[0].depth == 10).all()  # 10,000 units of 1 mm
    with pytest.raises(ConfigError, match=r"or write .*/nobodys/camera\.json with width, height, fx"):
        TumRgbd(shutil.copytree(mine, folder.parent / "nobodys", ignore=shutil.ignore_patterns("camera.json")))


def test_tum_rgbd_camera_json_lens_is_applied_or_raises(folder: Path) -> None:
    mine = folder.rename(folder.parent / "my_desk")
    (mine / "camera.json").write_text(json.dumps(OWN | {"distortion": [0.1, 0, 0, 0, 0]}))
    assert TumRgbd(mine).contents.distortion == Distortion(k1=0.1)
    assert TumRgbd(mine, undistort=False).calibration.lens is None
    (mine / "camera.json").write_text(json.dumps(OWN | {"fx": "wide"}))
    with pytest.raises(DataError, match=r"camera\.json: fx: expected a number"):
        TumRgbd(mine)


@pytest.mark.parametrize(
    "name", ["my_freiburg1_room", "rgbd_dataset_freiburg1_xyz", "freiburg2", "freiburg3_x", "desk"]
)
@pytest.mark.parametrize("file", ["camera.json", "camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsics.txt"])
def test_tum_rgbd_own_camera_overrides_published(
    folder: Path, name: str, file: str, caplog: pytest.LogCaptureFixture
) -> None:
    mine = folder.rename(folder.parent / name)
    K = "600 0 310\n0 601 250\n0 0 1\n"
    (mine / file).write_text(json.dumps(OWN) if file.endswith("json") else K)
    with caplog.at_level(logging.INFO):
        sequence = TumRgbd(mine)
    assert sequence.camera == Camera(640, 480, 600.0, 601.0, 310.0, 250.0)
    assert sequence.contents.distortion is None
    assert f"camera from {mine / file}" in caplog.text
    assert sequence.contents.depth_scale == (1000 if file.endswith("json") else 5000)


def test_tum_rgbd_parameter_overrides_own_camera(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    (folder / "camera.json").write_text("no JSON")
    with caplog.at_level(logging.INFO):
        assert TumRgbd(folder, intrinsics=Intrinsics.FREIBURG3).camera == PUBLISHED[Intrinsics.FREIBURG3].camera
    assert "published camera FREIBURG3" in caplog.text


# Association


def test_tum_rgbd_association_is_closest_first_and_one_to_one() -> None:
    """At first, the depth image at 0.015 s is nearest to both color images. The closer color image gets it."""
    assert associate([0.0, 0.02], [0.015, 0.19], 0.02) == [(1, 0)]
    assert associate([0.0, 0.02], [0.015, 0.035], 0.02) == [(1, 0)]
    assert associate([0.0, 0.02], [0.015, -0.01], 0.02) == [(0, 1), (1, 0)]


def test_tum_rgbd_associated_pairs_are_sorted_by_time() -> None:
    assert associate([0.2, 0.0, 0.1], [0.11, 0.21, 0.01], 0.02) == [(1, 2), (2, 0), (0, 1)]


def test_tum_rgbd_association_matches_brute_force() -> None:
    rng = np.random.default_rng(0)
    first, second = np.sort(rng.uniform(0, 1, 40)), rng.uniform(0, 1, 50)
    free = np.abs(first[:, None] - second)
    expected = []
    while free.min() <= 0.02:
        i, j = np.unravel_index(free.argmin(), free.shape)
        expected.append((int(i), int(j)))
        free[i], free[:, j] = np.inf, np.inf
    assert associate(first.tolist(), second.tolist(), 0.02) == sorted(expected)
    assert len(expected) > 20


def test_tum_rgbd_color_without_depth_is_dropped_and_counted(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    color = [color_time(k) for k in range(FRAMES)]
    write_lists(folder, color, [color[0] + DEPTH_DELAY, color[2] + DEPTH_DELAY])
    with caplog.at_level(logging.INFO):
        sequence = TumRgbd(folder)
    assert [frame.timestamp for frame in sequence] == [color[0], color[2]]
    assert "1 of 3 color images have no depth image" in caplog.text


def test_tum_rgbd_duplicate_image_timestamps_keep_first(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("rgb", "depth"):
        path = folder / f"{name}.txt"
        path.write_text(path.read_text() + path.read_text().replace(".png", "_again.png") * 1000)
    sequence = TumRgbd(folder)  # 3 million pairs are within max_time_difference
    assert [frame.timestamp for frame in sequence] == [color_time(k) for k in range(FRAMES)]
    assert caplog.text.count("rgb.txt: expected unique timestamps, got repeated ones; skipped 3000 images") == 1
    assert caplog.text.count("depth.txt: expected unique timestamps, got repeated ones; skipped 3000 images") == 1


def test_tum_rgbd_recording_without_image_pairs_raises(folder: Path) -> None:
    with pytest.raises(DataError, match=r"within dataset\.max_time_difference \(0\.01 s\) of each other, got none"):
        TumRgbd(folder, max_time_difference=0.01)


# Poses


def test_tum_rgbd_poses_are_interpolated(folder: Path) -> None:
    q_0, q_1 = Rotation.from_rotvec([0.1, 0.2, 0.3]), Rotation.from_rotvec([-0.2, 0.1, 0.5])
    times = [color_time(1) - 0.003, color_time(1) + 0.006]
    lines = [
        f"{time:.7f} {x} 2 3 " + " ".join(map(str, q.as_quat()))
        for time, x, q in zip(times, (0.9, 1.2), (q_0, q_1), strict=True)
    ]
    write_poses(folder, lines)
    T_world_camera = TumRgbd(folder)[1].T_world_camera
    assert T_world_camera is not None
    np.testing.assert_allclose(T_world_camera[:3, 3], [1.0, 2, 3], atol=1e-4)
    slerp = Slerp([0, 1], Rotation.concatenate([q_0, q_1]))(1 / 3)
    np.testing.assert_allclose(T_world_camera[:3, :3], slerp.as_matrix(), atol=1e-4)


def test_tum_rgbd_pose_beyond_time_tolerance_is_unknown(folder: Path) -> None:
    write_poses(folder, [f"{color_time(0) + 0.019:.6f} 5 0 0 0 0 0 1", f"{color_time(2) - 0.021:.6f} 6 0 0 0 0 0 1"])
    sequence = TumRgbd(folder)
    first = sequence[0].T_world_camera
    assert first is not None
    np.testing.assert_array_equal(first[:3, 3], [5, 0, 0])  # before the first pose, the nearest pose is used
    assert sequence[2].T_world_camera is None


def test_tum_rgbd_missing_ground_truth_gives_no_pose(folder: Path) -> None:
    (folder / "groundtruth.txt").unlink()
    assert TumRgbd(folder)[0].T_world_camera is None


def test_tum_rgbd_unreadable_ground_truth_raises(folder: Path) -> None:
    (folder / "groundtruth.txt").unlink()
    (folder / "groundtruth.txt").symlink_to("nowhere")
    with pytest.raises(DataError, match=r"groundtruth\.txt"):
        TumRgbd(folder)


def test_tum_rgbd_duplicate_pose_timestamps_keep_first(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    times = [f"{color_time(k):.6f}" for k in range(FRAMES)]
    write_poses(folder, [f"{time} {x} 0 0 0 0 0 1" for time in times for x in (1, 9)])
    pose = TumRgbd(folder)[1].T_world_camera
    assert pose is not None
    assert pose[0, 3] == 1
    assert f"groundtruth.txt: expected unique timestamps, got repeated ones; skipped {FRAMES} poses" in caplog.text


def test_tum_rgbd_invalid_pose_raises_for_its_frame(folder: Path) -> None:
    lines = [f"{color_time(k):.6f} 0 0 0 0 0 0 1" for k in range(FRAMES)]
    lines[1] = f"{color_time(1):.6f} 1 0 0 0 0 0 0"
    write_poses(folder, lines)
    assert "groundtruth.txt, line 5: expected a quaternion" in fault_of(TumRgbd(folder), 1)


def test_tum_rgbd_zero_pose_counts_as_unknown(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    lines = [f"{color_time(k):.6f} 0 0 0 0 0 0 1" for k in range(FRAMES)]
    lines[1] = f"{color_time(1):.6f} 0 0 0 0 0 0 0"
    write_poses(folder, lines)
    sequence = TumRgbd(folder)
    assert sequence[0].T_world_camera is not None
    assert sequence[1].T_world_camera is None
    assert f"groundtruth.txt: 1 of {FRAMES} poses contain only zeros and count as unknown" in caplog.text


# Errors


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
def test_tum_rgbd_missing_image_list_raises(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(DataError, match=f"{name}: expected"):
        TumRgbd(folder)


@pytest.mark.parametrize(
    "line",
    ["1305031102.2", "yesterday rgb/1.png", "nan rgb/1.png", "1.5 rgb/\0.png", "1.5 r\bgb/1.png", "1.5 " + "1" * 5000],
)
def test_tum_rgbd_invalid_image_list_error_gives_line_number(folder: Path, line: str) -> None:
    text = (folder / "rgb.txt").read_text()
    (folder / "rgb.txt").write_text(text + line + "\n")
    with pytest.raises(DataError, match=r"rgb\.txt, line 7: expected `timestamp filename`") as caught:
        TumRgbd(folder)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def test_tum_rgbd_invalid_pose_line_error_gives_line_number(folder: Path) -> None:
    write_poses(folder, ["1305031102.2 1 2 3"])
    with pytest.raises(DataError, match=r"groundtruth\.txt, line 4: expected 8 numbers"):
        TumRgbd(folder)


@pytest.mark.parametrize("content", [b"", b"# color images\n"])
def test_tum_rgbd_empty_image_list_raises(folder: Path, content: bytes) -> None:
    (folder / "depth.txt").write_bytes(content)
    with pytest.raises(DataError, match=r"depth\.txt: expected a list of images, got none"):
        TumRgbd(folder)


def test_tum_rgbd_binary_image_list_raises(folder: Path) -> None:
    (folder / "rgb.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match=r"rgb\.txt: expected UTF-8 text"):
        TumRgbd(folder)


def test_tum_rgbd_missing_listed_image_raises_for_its_frame(folder: Path) -> None:
    path = folder / f"depth/{color_time(1) + DEPTH_DELAY:.6f}.png"
    path.unlink()
    assert f"{path}: expected a readable file" in fault_of(TumRgbd(folder), 1)


def test_tum_rgbd_image_size_mismatch_raises(folder: Path) -> None:
    write_color(folder / f"rgb/{color_time(1):.6f}.png", (1, 2, 3), (240, 320))
    assert "expected 640x480 px as in dataset.intrinsics=FREIBURG1, got 320x240 px" in fault_of(TumRgbd(folder), 1)
    write_color(folder / f"rgb/{color_time(0):.6f}.png", (1, 2, 3), (240, 320))
    with pytest.raises(DataError, match=", got 320x240 px"):
        TumRgbd(folder)


@pytest.mark.parametrize("value", [0.0, -1.0, 1.5, float("nan")])
def test_tum_rgbd_time_tolerance_out_of_range_raises(folder: Path, value: float) -> None:
    with pytest.raises(ConfigError, match=r"dataset\.max_time_difference: expected a value in \(0, 1\] s"):
        TumRgbd(folder, max_time_difference=value)


def test_tum_rgbd_frame_has_times_of_both_images(folder: Path) -> None:
    frame = TumRgbd(folder)[1]
    assert frame.timestamp == frame.color_time == color_time(1)
    assert frame.depth_time == pytest.approx(color_time(1) + DEPTH_DELAY, abs=1e-6)
