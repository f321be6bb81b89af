"""Tests for trajectory.log, including lost frames, truncated files and files with errors."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import check_rigid
from framework.datasets.scenenn.scene_files import read_trajectory_log, write_trajectory_log
from framework.errors import DataError
from framework.geometry import exp_se3

PUBLISHED = """0 0 1
1.0 0.0 0.0 0.0
0.0 1.0 0.0 0.0
0.0 0.0 1.0 0.0
0.000000 0.000000 0.000000 1.000000
6 6 7
-0.999735 -0.0221085 -0.00642794 -1.60032
0.0228115 -0.913277 -0.406701 0.995107
0.00312105 -0.406739 0.913539 -0.243516
0.000000 0.000000 0.000000 1.000000
"""  # frame 6 of a SceneNN sequence, from github.com/hkust-vgd/scenenn, issue 3
LOST = """1259 1259 1260
0 0 0 0.032024
0 0 0 3.15572
0 0 0 -1.4815
0.000000 0.000000 0.000000 1.000000
"""  # lost frame of sequence 092, from issue 4


def printed(rows):
    return np.array([[float(word) for word in row.split()] for row in rows])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "trajectory.log"


def test_trajectory_log_round_trip_is_exact(path):
    rng = np.random.default_rng(0)
    poses = {frame: exp_se3(rng.normal(0, 2, 6)) for frame in (7, 0, 3, 2**31 - 2)}
    write_trajectory_log(path, poses)
    log = read_trajectory_log(path)
    assert list(log.poses) == [0, 3, 7, 2**31 - 2]
    assert log.unusable == {}
    for frame, T in poses.items():
        np.testing.assert_array_equal(log.poses[frame], T)


def test_trajectory_log_published_file_is_read_and_rewritten(path):
    path.write_text(PUBLISHED)
    log = read_trajectory_log(path)
    T = printed(PUBLISHED.splitlines()[6:10])
    np.testing.assert_array_equal(log.poses[0], np.eye(4))
    np.testing.assert_allclose(log.poses[6], T, atol=2e-6)
    np.testing.assert_array_equal(log.poses[6][:3, 3], T[:3, 3])
    write_trajectory_log(path, {6: T, 0: np.eye(4)})
    assert path.read_text() == PUBLISHED


def test_trajectory_log_published_rotation_becomes_rigid(path):
    path.write_text(PUBLISHED)
    R = read_trajectory_log(path).poses[6][:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    check_rigid("pose 6", read_trajectory_log(path).poses[6])


def test_trajectory_log_whitespace_variants_are_read(path):
    path.write_bytes(("\n" + PUBLISHED.replace(" ", "\t ").replace("\n", " \r\n") + "\r\n").encode())
    assert list(read_trajectory_log(path).poses) == [0, 6]


def test_trajectory_log_lost_frame_is_unusable(path):
    path.write_text(LOST + PUBLISHED)
    log = read_trajectory_log(path)
    assert list(log.poses) == [0, 6]
    assert log.unusable == {1259: "pose: expected a rigid transform, got |R R^T - I| = 1, det R = 0"}


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("-1.60032", "nan", "expected finite values"),
        ("-1.60032", "-inf", "expected finite values"),
        ("-1.60032", "-1.#IND", "expected finite values"),
        ("-1.60032", "1.#QNAN0", "expected finite values"),
        ("-1.60032", "-nan(ind)", "expected finite values"),
        ("0.0228115", "1e300", "expected a rigid transform"),
        ("0.0228115", "0.0428115", "expected a rigid transform"),
        ("-0.999735 -0.0221085 -0.00642794", "0.999735 0.0221085 0.00642794", "det R = -1"),  # a reflection
        ("0.000000 1.000000\n", "0.000000 2.000000\n", "last row"),
    ],
)
def test_trajectory_log_invalid_pose_is_unusable(path, old, new, why):
    first, second = PUBLISHED[: PUBLISHED.index("6 6 7")], PUBLISHED[PUBLISHED.index("6 6 7") :]
    path.write_text(first + second.replace(old, new))
    log = read_trajectory_log(path)
    assert list(log.poses) == [0]
    assert list(log.unusable) == [6]
    assert why in log.unusable[6]


def test_trajectory_log_truncated_file_loses_only_last_frame(path):
    second = PUBLISHED.index("6 6 7")
    for length in range(second, len(PUBLISHED)):
        path.write_text(PUBLISHED[:length])
        log = read_trajectory_log(path)
        np.testing.assert_array_equal(log.poses[0], np.eye(4))
        known = length >= second + len("6 6")
        whole = length >= len(PUBLISHED) - len(".000000\n")
        assert list(log.poses) == ([0, 6] if whole else [0])
        assert log.unusable == ({6: "expected a full pose, got the end of the file"} if known and not whole else {})


def test_trajectory_log_duplicate_frame_requires_equal_poses(path):
    path.write_text(PUBLISHED + PUBLISHED.replace("1.0 0.0", "1 0"))
    log = read_trajectory_log(path)
    assert (list(log.poses), log.unusable) == ([0, 6], {})
    path.write_text(PUBLISHED + PUBLISHED.replace("-1.60032", "-1.7"))
    log = read_trajectory_log(path)
    assert (list(log.poses), log.unusable) == ([0], {6: "expected one pose, got different poses on lines 6 and 16"})
    path.write_text(PUBLISHED + PUBLISHED.replace("-1.60032", "-1.7") + PUBLISHED[:-20])
    log = read_trajectory_log(path)
    assert (list(log.poses), log.unusable) == ([0], {6: "expected one pose, got different poses on lines 6 and 26"})
    path.write_text(LOST + LOST.replace("3.15572", "nan") + PUBLISHED)
    assert list(read_trajectory_log(path).unusable) == [1259]


def test_trajectory_log_empty_file_has_no_poses(path):
    path.write_text("\n")
    log = read_trajectory_log(path)
    assert (log.poses, log.unusable) == ({}, {})


@pytest.mark.parametrize(
    ("line", "new", "message"),
    [
        (1, "0 0", "line 1: expected a frame header `frame frame frame.1`, got '0 0'"),
        (1, "0 0 1 2", "line 1: expected a frame header"),
        (1, "-1 -1 0", "line 1: expected a frame header"),
        (6, "6.5 6 7", "line 6: expected a frame header"),
        (6, "4294967296 6 7", "line 6: expected a frame header"),
        (2, "1 0 0", r"line 2: expected row 1 of a 4x4 matrix \(four numbers\), got '1 0 0'"),
        (3, "1", "line 3: expected row 2"),
        (4, "0 0 one 0", "line 4: expected row 3 .* got '0 0 one 0'"),
        (4, "", "line 6: expected row 4 .* got '6 6 7'"),
        (8, "0 0 0 0 0", "line 8: expected row 2"),
        (10, "0 0 0 1 0", "line 10: expected row 4"),
    ],
)
def test_trajectory_log_malformed_error_gives_file_and_line(path, line, new, message):
    lines = PUBLISHED.splitlines()
    lines[line - 1] = new
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=f"trajectory.log, {message}"):
        read_trajectory_log(path)


def test_trajectory_log_missing_file_raises(path):
    with pytest.raises(DataError, match=r"trajectory.log: expected a readable file, got an error \(No such file"):
        read_trajectory_log(path)


@pytest.mark.parametrize(
    ("poses", "message"),
    [({0: 2 * np.eye(4)}, "frame 0: pose: expected a rigid transform"), ({-1: np.eye(4)}, "got -1")],
)
def test_trajectory_log_writing_invalid_pose_leaves_no_file(path, poses, message):
    with pytest.raises(DataError, match=message):
        write_trajectory_log(path, poses)
    assert list(path.parent.iterdir()) == []
