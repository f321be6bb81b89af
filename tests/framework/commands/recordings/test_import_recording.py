"""Tests for the command `import`."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from framework.api import begin, run
from framework.checking.recording_check import check
from framework.commands.recordings import import_recording
from framework.config.composition import composed
from framework.data import Array
from framework.datasets.rgbd_folder import RgbdFolder
from framework.files.tum_trajectory import read_tum, write_tum
from framework.geometry import inverse
from framework.importing import folder_writer
from framework.interfaces import RGBDSequence
from framework.registry import build
from tests.support.forked_commands import ForkedCommand, completed
from tests.support.recordings.phone_exports import room_frames, seen_by_phone, write_stray_scanner
from tests.support.scenes.corner_room import look, pose_at

pytestmark = pytest.mark.integration


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["import", *map(str, arguments)])
    import_recording.main()


def test_import_prints_written_frames_and_next_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_stray_scanner(tmp_path / "export", room_frames())
    command(monkeypatch, tmp_path / "export", tmp_path / "out", "--width", "160", "--stride", "2")
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"{tmp_path}/out: from Stray Scanner, 2 frames",
        "the images are not upright, which reduces detection accuracy; import into another folder with --rotate 180",
        f"check it: instancemap check dataset=rgbd_folder dataset.root={tmp_path}/out",
        f"map it: instancemap dataset=rgbd_folder dataset.root={tmp_path}/out",
    ]
    assert err == ""
    assert RgbdFolder(tmp_path / "out").camera.width == 160


def test_import_odometry_is_used_by_printed_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags")
    from tests.support.recordings.ros_bags import COUNT, BagWriter, add_camera_of_ros, time_of

    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT + 1):
        bag.add_pose(time_of(k), "/odometry", pose_at(k))
    command(monkeypatch, bag.write(tmp_path / "bag"), tmp_path / "out", "--odometry", "/odometry", "--rotate", "90")
    overrides = capsys.readouterr().out.splitlines()[-1].partition("instancemap ")[2].split()
    assert overrides[-1] == f"dataset.odometry={tmp_path}/out/odometry.txt"
    sequence = build(RGBDSequence, composed(*overrides).dataset)
    first, last = (sequence[k].T_odom_camera for k in (0, COUNT - 1))
    assert first is not None
    assert last is not None
    R_turned_camera = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = pose_at(COUNT - 1)[:3, 3] - pose_at(0)[:3, 3]
    np.testing.assert_allclose((inverse(first) @ last)[:3, 3], R_turned_camera @ moved, atol=1e-3)


def test_import_poses_none_keeps_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_stray_scanner(tmp_path / "export", room_frames())
    command(monkeypatch, tmp_path / "export", tmp_path / "out", "--poses", "none")
    assert not (tmp_path / "out/poses.txt").exists()
    found = [frame.timestamp for frame in RgbdFolder(tmp_path / "out")]
    assert found == pytest.approx([frame.timestamp for frame in room_frames()], abs=1e-6)


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (("--max-difference", "2"), "--max-difference: expected a value in [0, 1] s, got 2.0"),
        (("--depth-unit", "1000"), "--depth-unit: expected a value in [1e-6, 1] m, got 1000.0"),
        (("--camera-pose", "0 0 0"), "--camera-pose: expected 7 numbers (tx ty tz qx qy qz qw), got 3"),
        (("--camera-pose", "0 0 0 1 1 1 1"), "--camera-pose: expected a quaternion qx qy qz qw of length 1, got 2"),
        (("--depth-registered",), "--depth-registered: expected a ROS bag, got "),
    ],
)
def test_import_invalid_bag_option_raises(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    option: tuple[str, ...],
    expected: str,
) -> None:
    write_stray_scanner(tmp_path / "export", room_frames()[:1])
    with pytest.raises(SystemExit):
        command(monkeypatch, tmp_path / "export", tmp_path / "out", *option)
    assert capsys.readouterr().err.startswith(f"error: {expected}")


def test_import_bag_without_poses_maps_with_trajectory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The trajectory of another SLAM system has the header times of the bag."""
    pytest.importorskip("rosbags")
    from tests.support.recordings.ros_bags import COUNT, BagWriter, add_camera_of_ros, time_of

    bag = BagWriter()
    add_camera_of_ros(bag)
    command(monkeypatch, bag.write(tmp_path / "bag"), tmp_path / "out")
    write_tum(tmp_path / "slam.txt", [time_of(k) for k in range(COUNT)], [pose_at(k) for k in range(COUNT)])
    run(
        tmp_path / "run",
        f"dataset.root={tmp_path}/out",
        "tracker=trajectory_file",
        f"tracker.path={tmp_path}/slam.txt",
        "detector=none",
        dataset="rgbd_folder",
    )
    timestamps, poses = read_tum(tmp_path / "run/trajectory.txt")
    assert timestamps == pytest.approx([time_of(k) for k in range(COUNT)], abs=1e-6)
    np.testing.assert_allclose(poses, [pose_at(k) for k in range(COUNT)], atol=1e-6)


def test_import_rotated_images_have_rotated_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The y axis points down in the room and up in ARKit, so the images of the phone are upside down."""
    frames = room_frames()
    write_stray_scanner(tmp_path / "export", frames)
    command(monkeypatch, tmp_path / "export", tmp_path / "out", "--rotate", "180", "--confidence", "0")
    assert "--rotate" not in capsys.readouterr().out
    for frame, seen in zip(frames, RgbdFolder(tmp_path / "out"), strict=True):
        assert seen.T_world_camera is not None
        depth, _, color, ids = look(seen.camera, seen.T_world_camera)
        assert np.abs(seen.color.astype(int) - color).mean() < 12
        assert np.median(np.abs(seen.depth - depth)[(ids == 0) & (seen.depth > 0)]) < 1e-3
        np.testing.assert_allclose(seen.T_world_camera[:3, 1], -frame.T_world_camera[:3, 1], atol=1e-6)
        np.testing.assert_allclose(seen.T_world_camera[:3, :3] @ seen.up, [0, 1, 0], atol=1e-6)


def test_import_existing_output_raises_before_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/camera.json").touch()
    with pytest.raises(SystemExit) as ended:
        command(monkeypatch, tmp_path / "nothing", tmp_path / "out")
    assert ended.value.code == 1
    expected = "expected a new or empty folder, got a file or non-empty folder"
    assert capsys.readouterr().err == f"error: {tmp_path}/out: {expected}; remove it or set another folder\n"


@pytest.mark.acceptance
def test_import_phone_recording_is_mappable(shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The export of a real kitchen has 256x192 depth images, a video and ARKit poses. No frame may be lost."""
    kitchen = RgbdFolder(shared_data / "redkitchen", stride=3, stop=180)
    write_stray_scanner(tmp_path / "export", list(seen_by_phone(list(kitchen))))
    command(monkeypatch, tmp_path / "export", tmp_path / "out")
    config = composed("dataset=rgbd_folder", f"dataset.root={tmp_path / 'out'}", "detector=none")
    sequence = build(RGBDSequence, config.dataset)
    found = check(sequence, 5.0)
    assert not found.errors, found.errors
    result = begin(config).run(sequence)
    assert not any(tracked.pose.lost for tracked in result.tracked)
    assert len(result.tracked) == 60
    seen = result.scene.render(kitchen.camera, result.tracked[30].pose.T_world_camera).depth
    truth = kitchen[30].depth
    both = (seen > 0) & (truth > 0)
    assert both.sum() > 0.85 * (truth > 0).sum()
    assert np.median(np.abs(seen - truth)[both]) < 0.01


def write_slowly() -> None:
    """Make the command take 0.2 s for each image."""
    write = folder_writer.write_image

    def slow(path: Path, image: Array, *parameters: int) -> None:
        write(path, image, *parameters)
        time.sleep(0.2)

    folder_writer.write_image = slow


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGXCPU])
def test_import_ended_by_signal_is_started_again(tmp_path: Path, number: signal.Signals) -> None:
    write_stray_scanner(tmp_path / "export", room_frames())
    words = ("import", str(tmp_path / "export"), str(tmp_path / "out"))
    process = ForkedCommand(tmp_path, *words, before=write_slowly)
    deadline = time.monotonic() + 60
    while not (tmp_path / "out/color/000000.jpg").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    in_use = completed(tmp_path, *words)
    assert (in_use.returncode, len(in_use.stderr.splitlines())) == (1, 1)
    assert f"got a directory in use by process {process.pid} on" in in_use.stderr
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert process.returncode == 128 + number
        how = "interrupted by Ctrl-C" if number == signal.SIGINT else f"ended by {number.name}"
        assert stderr.splitlines()[-1:] == [how]
        assert "Traceback" not in stderr
    again = completed(tmp_path, *words)
    assert (again.returncode, again.stderr) == (0, "")
    assert not [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]
    assert len(RgbdFolder(tmp_path / "out")) == len(room_frames())
