"""Tests for trajectories in TUM format."""

from __future__ import annotations

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.tum_trajectory import read_tum, read_tum_lines, write_tum
from framework.geometry import exp_se3

GOOD = "0.0 1 2 3 0 0 0 1\n"


def test_tum_trajectory_round_trip_preserves_poses(tmp_path):
    rng = np.random.default_rng(0)
    poses = [exp_se3(rng.normal(0, 2, 6)) for _ in range(20)]
    timestamps = 1.7e9 + np.arange(20) / 30
    write_tum(tmp_path / "trajectory.txt", timestamps, poses)
    read_timestamps, read_poses = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(read_timestamps, timestamps, atol=1e-6)
    np.testing.assert_allclose(read_poses, poses, atol=1e-9)
    assert [path.name for path in tmp_path.iterdir()] == ["trajectory.txt"]


def test_tum_trajectory_line_gives_known_pose(tmp_path):
    """The rotation is a quarter turn about z, which maps x to y."""
    path = tmp_path / "t.txt"
    path.write_text(f"# {'timestamp tx ty tz qx qy qz qw'}\n\n 0.5 1 2 3 0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}\r\n")
    timestamps, poses = read_tum(path)
    assert timestamps.tolist() == [0.5]
    np.testing.assert_allclose(poses[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)


def test_tum_trajectory_comments_after_pose_are_ignored(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("#\n0.5 1 2 3 0 0 0 1# found # by ICP\n#0.6 1\n0.7 1 2 3 0 0 0 1.#IND # lost\n")
    first, second = read_tum_lines(path)
    np.testing.assert_array_equal(first.pose()[:3, 3], [1, 2, 3])
    with pytest.raises(DataError, match="line 4: expected a finite pose, got 1 2 3 0 0 0 nan"):
        second.pose()


def test_tum_trajectory_empty_round_trip_is_exact(tmp_path):
    write_tum(tmp_path / "t.txt", [], [])
    timestamps, poses = read_tum(tmp_path / "t.txt")
    assert (timestamps.shape, poses.shape) == ((0,), (0, 4, 4))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("1.0 1 2 3 0 0 0\n", "line 3: expected 8 numbers .* got 7"),
        ("1.0 1 2 3 0 0 0 one\n", "line 3: expected 8 numbers .*'one'"),
        ("1.0 1 nan 3 0 0 0 1\n", "line 3: expected a finite pose, got 1 nan 3 0 0 0 1"),
        ("1.0 1 2 3 0 0 0 0\n", "line 3: expected a quaternion qx qy qz qw of length 1, got 0"),
        ("inf 1 2 3 0 0 0 1\n", "line 3: expected a finite timestamp, got 'inf'"),
        ("0.0 1 2 3 0 0 0 1\n", "line 3: expected a timestamp > 0 s, got 0 s"),
        ("1.0 1 2 3 0 0 0 1\n0.5 1 2 3 0 0 0 1\n", "line 4: expected a timestamp > 1 s, got 0.5 s"),
    ],
)
def test_tum_trajectory_invalid_line_error_gives_file_and_line(tmp_path, bad, message):
    path = tmp_path / "t.txt"
    path.write_text("# comment\n" + GOOD + bad)
    with pytest.raises(DataError, match=f"t.txt, {message}"):
        read_tum(path)


def test_tum_trajectory_missing_or_binary_file_raises(tmp_path):
    with pytest.raises(DataError, match="expected a trajectory in TUM format, got no such file"):
        read_tum(tmp_path / "missing.txt")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="expected UTF-8 text"):
        read_tum(tmp_path / "binary.txt")


def test_tum_trajectory_failed_write_leaves_no_file(tmp_path):
    with pytest.raises(DataError, match="pose 1"):
        write_tum(tmp_path / "t.txt", [0.0, 1.0], [np.eye(4), 2 * np.eye(4)])
    with pytest.raises(DataError, match="expected a timestamp for each pose, got 1 for 2 poses"):
        write_tum(tmp_path / "t.txt", [0.0], [np.eye(4), np.eye(4)])
    assert list(tmp_path.iterdir()) == []
