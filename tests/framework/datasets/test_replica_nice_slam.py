"""Tests for Replica in the layout of NICE-SLAM."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Camera
from framework.datasets.replica_nice_slam import ReplicaNiceSlam
from framework.errors import DataError
from framework.sensors.noise_models import SensorKind
from tests.support.recordings.recordings import fault_of, mapped, opened, write_color, write_depth

CAMERA = {"w": 24, "h": 16, "fx": 12.0, "fy": 12.0, "cx": 11.5, "cy": 7.5, "scale": 6553.5}
SHAPE = (16, 24)
FRAMES = 3


def write_camera(root: Path, **changes: Any) -> None:
    (root / "cam_params.json").write_text(json.dumps({"camera": CAMERA | changes}, indent=4))


def pose_at(k: int) -> np.ndarray:
    """Return T_world_camera of frame k. The camera is not at the origin and is rotated about its y axis."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_rotvec([0, 0.3 * k, 0]).as_matrix()
    T_world_camera[:3, 3] = 1, 2, 0.1 * k
    return T_world_camera


def write_poses(scene: Path, poses: list[np.ndarray]) -> None:
    (scene / "traj.txt").write_text("".join(" ".join(f"{x:.18e}" for x in pose.ravel()) + "\n" for pose in poses))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "Replica"
    for k in range(FRAMES):
        write_color(root / f"room0/results/frame{k:06d}.jpg", (40 * k, 100, 200), SHAPE)
        write_depth(root / f"room0/results/depth{k:06d}.png", 13107, SHAPE)  # 2 m
    write_camera(root)
    write_poses(root / "room0", [pose_at(k) for k in range(FRAMES)])
    return root


def test_replica_frame_sensor_is_exact(root: Path) -> None:
    assert ReplicaNiceSlam(root, "room0")[0].sensor is SensorKind.EXACT


def test_replica_frame_matches_files(root: Path) -> None:
    sequence = ReplicaNiceSlam(root, scene="room0")
    assert (len(sequence), sequence.name) == (FRAMES, "room0")
    assert sequence.camera == Camera(24, 16, 12.0, 12.0, 11.5, 7.5)
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, pytest.approx(2 / 30))
    assert np.abs(frame.color.astype(int) - (80, 100, 200)).max() <= 2  # JPEG compression
    np.testing.assert_allclose(frame.depth, 2, rtol=1e-6)
    np.testing.assert_allclose(frame.T_world_camera, pose_at(2), atol=1e-12)
    assert sequence.scene_truth() is None


def test_replica_recording_is_mapped(root: Path) -> None:
    result, points_world = mapped(opened("replica_nice_slam", f"dataset.root={root}", "dataset.scene=room0"))
    assert (result.frames, result.frames_skipped) == (FRAMES, 0)
    for k, points in enumerate(np.split(points_world, FRAMES)):
        R, center = pose_at(k)[:3, :3], pose_at(k)[:3, 3]
        np.testing.assert_allclose((points - center) @ R[:, 2], 2, atol=1e-5)  # all are 2 m in front of the camera
        assert (points[0] - center) @ R[:, 1] < 0 < (points[-1] - center) @ R[:, 1]  # the y axis points down the image


def test_replica_partial_recording_keeps_matching_poses(root: Path) -> None:
    for name in ("frame000000.jpg", "depth000000.png"):
        (root / "room0/results" / name).unlink()
    np.testing.assert_allclose(ReplicaNiceSlam(root / "room0")[0].T_world_camera, pose_at(1), atol=1e-12)


def test_replica_invalid_pose_raises_for_its_frame(root: Path) -> None:
    stretched = pose_at(1)
    stretched[0] *= 1.1
    write_poses(root / "room0", [pose_at(0), stretched, pose_at(2)])
    assert "traj.txt, line 2: pose: expected a rigid transform, got |R R^T - I| =" in fault_of(
        ReplicaNiceSlam(root, scene="room0"), 1
    )
    write_poses(root / "room0", [pose_at(0), np.full((4, 4), np.nan), pose_at(2)])
    assert "traj.txt, line 2: pose: expected finite values" in fault_of(ReplicaNiceSlam(root, scene="room0"), 1)
    text = (root / "room0/traj.txt").read_text()
    (root / "room0/traj.txt").write_text(text.replace("nan", "-nan(ind)"))
    assert "traj.txt, line 2: pose: expected finite values" in fault_of(ReplicaNiceSlam(root, scene="room0"), 1)


@pytest.mark.parametrize("name", ["frame000001.jpg", "depth000001.png"])
def test_replica_missing_image_raises_for_its_frame(root: Path, name: str) -> None:
    (root / "room0/results" / name).unlink()
    assert f"{name}: expected a readable file" in fault_of(ReplicaNiceSlam(root, scene="room0"), 1)


@pytest.mark.parametrize("name", ["results", "traj.txt"])
def test_replica_missing_results_or_trajectory_raises(root: Path, name: str) -> None:
    (root / "room0" / name).rename(root / "elsewhere")
    with pytest.raises(DataError, match=name):
        ReplicaNiceSlam(root, scene="room0")


def test_replica_missing_scene_parameter_error_has_fix(root: Path) -> None:
    with pytest.raises(DataError, match=r"cam_params\.json: expected camera parameters .*, such as room0"):
        ReplicaNiceSlam(root)


def test_replica_frames_without_pose_are_counted(root: Path) -> None:
    write_poses(root / "room0", [pose_at(0), pose_at(1)])
    sequence = ReplicaNiceSlam(root, scene="room0")
    assert "frame000002.jpg: expected pose 2 in traj.txt, got only 2 poses" in fault_of(sequence, 2)
    result, _ = mapped(sequence)
    assert (result.frames, result.frames_skipped) == (FRAMES, 1)


def test_replica_poses_without_frame_are_ignored(root: Path) -> None:
    write_poses(root / "room0", [pose_at(k) for k in range(FRAMES + 2)])
    assert len(list(ReplicaNiceSlam(root, scene="room0"))) == FRAMES


def test_replica_scene_in_working_directory_is_read(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root / "room0")
    assert ReplicaNiceSlam(Path()).camera == Camera(24, 16, 12.0, 12.0, 11.5, 7.5)


def test_replica_scene_symbolic_link_is_read(root: Path, tmp_path: Path) -> None:
    (root / "room0").rename(tmp_path / "elsewhere")
    (root / "room0").symlink_to(tmp_path / "elsewhere")
    assert len(ReplicaNiceSlam(root, scene="room0")) == FRAMES


def test_replica_invalid_pose_line_error_gives_line_number(root: Path) -> None:
    write_poses(root / "room0", [pose_at(0), pose_at(1)[:3], pose_at(2)])
    with pytest.raises(DataError, match=r"traj\.txt, line 2: expected 16 numbers, got 12"):
        ReplicaNiceSlam(root, scene="room0")


@pytest.mark.parametrize(
    "changes", [{"w": "wide"}, {"h": 16.5}, {"fx": -1.0}, {"cy": float("nan")}, {"scale": 0}, {"fy": 10**18}]
)
def test_replica_invalid_camera_value_raises(root: Path, changes: dict[str, Any]) -> None:
    write_camera(root, **changes)
    with pytest.raises(DataError, match=rf"cam_params\.json: .*{next(iter(changes))}"):
        ReplicaNiceSlam(root, scene="room0")


@pytest.mark.parametrize("text", ["", "[]", '{"camera": 3}', "{}", "[" * 100_000, '{"camera": {"w": 24}}'])
def test_replica_invalid_camera_file_raises(root: Path, text: str) -> None:
    (root / "cam_params.json").write_text(text)
    with pytest.raises(DataError, match=r"cam_params\.json"):
        ReplicaNiceSlam(root, scene="room0")


def test_replica_image_size_mismatch_raises(root: Path) -> None:
    write_depth(root / "room0/results/depth000002.png", 1, (8, 12))
    assert ", got 12x8 px" in fault_of(ReplicaNiceSlam(root, scene="room0"), 2)
    write_camera(root, w=120, h=68)
    with pytest.raises(DataError, match=r"frame000000\.jpg: expected 120x68 px as in .*cam_params\.json, got 24x16 px"):
        ReplicaNiceSlam(root, scene="room0")
