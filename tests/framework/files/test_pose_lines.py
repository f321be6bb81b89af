"""Tests for trajectories in TUM, EuRoC and KITTI format."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.errors import DataError
from framework.files.pose_lines import TrajectoryFormat, read_pose_lines, read_trajectory
from framework.files.tum_trajectory import write_tum
from tests.support.recordings.recorded_frames import desk_frames
from tests.support.recordings.trajectory_files import write_euroc, write_kitti, write_table, write_tum_with_ids

WRITERS = {
    TrajectoryFormat.TUM: write_tum_with_ids,
    TrajectoryFormat.EUROC: write_euroc,
    TrajectoryFormat.KITTI: write_kitti,
}
TIMES = [frame.timestamp for frame in desk_frames()]
POSES = [frame.T_world_camera for frame in desk_frames()]

# first lines of state_groundtruth_estimate0/data.csv of MH_01_easy (EuRoC MAV dataset), with the start of its header
EUROC = """#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x\r
1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.027876\r
1403636580843555328,4.688177,-1.786770,0.787350,0.534640,-0.152990,-0.826976,-0.082863,-0.029272\r
"""
# first line of poses/00.txt of the KITTI odometry benchmark
KITTI = (
    "1.000000e+00 9.043680e-12 2.326809e-11 5.551115e-17 9.043683e-12 1.000000e+00 2.392370e-10 3.330669e-16 "
    "2.326810e-11 2.392370e-10 9.999999e-01 -4.440892e-16\n"
)
# a line of poses.txt as exported by RTAB-Map ("Raw", introlab/rtabmap issue 563)
RTABMAP = (
    "0.188878 -0.700506 0.688198 0.000599 -0.981995 -0.132266 0.134879 -0.018083 "
    "-0.003458 -0.701283 -0.712875 0.011538\n"
)


@pytest.mark.parametrize("kind", WRITERS)
def test_trajectory_desk_round_trip_preserves_poses(tmp_path: Path, kind: TrajectoryFormat, caplog) -> None:
    caplog.set_level(logging.INFO)
    WRITERS[kind](tmp_path / "poses.txt", TIMES, POSES)
    trajectory = read_trajectory(tmp_path / "poses.txt")
    assert trajectory.format is kind
    assert (f"read as camera poses in {kind.value} format" in caplog.text) == (kind is not TrajectoryFormat.TUM)
    np.testing.assert_allclose(trajectory.poses, POSES, atol=2e-6)
    if kind is TrajectoryFormat.KITTI:
        assert trajectory.timestamps is None
    else:
        np.testing.assert_allclose(trajectory.timestamps, TIMES, atol=1e-6)


def test_trajectory_published_euroc_lines_give_known_poses(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_bytes(EUROC.encode())
    trajectory = read_trajectory(tmp_path / "data.csv")
    assert trajectory.format is TrajectoryFormat.EUROC
    np.testing.assert_allclose(trajectory.timestamps, [1403636580.838555648, 1403636580.843555328], atol=1e-6)
    np.testing.assert_array_equal(trajectory.poses[0][:3, 3], [4.688319, -1.786938, 0.783338])
    expected = Rotation.from_quat([-0.153029, -0.827383, -0.082152, 0.534108]).as_matrix()
    np.testing.assert_allclose(trajectory.poses[0][:3, :3], expected, atol=1e-12)


@pytest.mark.parametrize(("text", "t"), [(KITTI, [0, 0, 0]), (RTABMAP, [0.000599, -0.018083, 0.011538])])
def test_trajectory_published_matrix_lines_give_known_poses(tmp_path: Path, text: str, t: list[float]) -> None:
    (tmp_path / "poses.txt").write_text(text)
    trajectory = read_trajectory(tmp_path / "poses.txt")
    assert (trajectory.format, trajectory.timestamps) == (TrajectoryFormat.KITTI, None)
    np.testing.assert_allclose(trajectory.poses[0][:3, 3], t, atol=1e-12)
    np.testing.assert_allclose(trajectory.poses[0][:3], np.reshape(text.split(), (3, 4)).astype(float), atol=1e-5)


@pytest.mark.parametrize("extra", ["7", "1 2 3", "0.1 0 0 0.2", "0 0 0 0 0 0 0 0 0", "1 1 1 1 1 1 1 1 1 1 1 1"])
def test_trajectory_tum_extra_columns_are_ignored(tmp_path: Path, extra: str) -> None:
    write_tum(tmp_path / "plain.txt", TIMES, POSES)
    lines = (tmp_path / "plain.txt").read_text().splitlines()
    (tmp_path / "extra.txt").write_text("".join(f"{line} {extra}\n" for line in lines))
    plain, read = (read_trajectory(tmp_path / f"{name}.txt") for name in ("plain", "extra"))
    assert read.format is TrajectoryFormat.TUM
    np.testing.assert_array_equal(read.poses, plain.poses)
    np.testing.assert_array_equal(read.timestamps, plain.timestamps)


POSE = "1 2 3 0 0 0 1"
INVALID = [
    (f"0 {POSE} 5\n1 {POSE}\n", "line 2: expected 9 columns, as in the first line, got 8"),
    (f"0 {POSE} 5\n1 {POSE} 6 2 {POSE} 7\n", "line 2: expected 9 columns, as in the first line, got 18"),
    (f"0 {POSE}\n1 {POSE} 2 {POSE}\n", "line 2: expected 8 numbers .*, got 16"),
    ("0 1 2 3 0 0 0 2 5\n", "line 1: expected a quaternion qx qy qz qw of length 1, got 2"),
    ("0,1,2,3,0,0,0,1\n", "expected a header that names the columns, .* or Unix times in ns, as in EuRoC, got '0,1,2"),
    ("1305031100.5;1;2;3;0;0;0;1\n", "expected a header that names the columns, such as timestamp,tx,ty,tz,qx,"),
    ("#timestamp [ns],x,y,z\n0,1,2,3\n", "expected a header that names the columns, .*; add the header"),
    (f"0 {KITTI}1 {KITTI}", "expected 12 numbers .*, got 13; remove the first column"),
    (EUROC + "1403636580848555520,4.6\r\n", "line 4: expected 9 columns, as in the first line, got 2"),
    (
        EUROC + "1403636580848.5,4,-1,0,1,0,0,0,0\n",
        "line 4: expected a timestamp in ns without decimals, got '140363658",
    ),
    (EUROC + "1403636580848555520,4,-1,0,1,0,0,x,0\n", "line 4: expected 8 numbers .*'x'"),
    (EUROC + "1403636580848555520,4,-1,0,2,0,0,0,0\n", "line 4: expected a quaternion .* of length 1, got 2"),
    (EUROC + "1403636580838555648,4,-1,0,1,0,0,0,0\n", "line 4: expected a timestamp > 1403636580.84 s, got"),
    (KITTI + "1 0 0 0\n", "line 2: expected 12 numbers .3 x 4, row-major., got 4"),
    (KITTI + "2 0 0 0 0 1 0 0 0 0 1 0\n", "line 2: pose: expected a rigid transform"),
    (KITTI + "nan 0 0 0 0 1 0 0 0 0 1 0\n", "line 2: pose: expected finite values"),
]


@pytest.mark.parametrize(("text", "message"), INVALID)
def test_trajectory_invalid_line_raises(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_bytes(text.encode())
    with pytest.raises(DataError, match=f"t.txt.*{message}") as refused:
        read_trajectory(tmp_path / "t.txt")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("# timestamp tx ty tz qw qx qy qz", "{t:.6f} {x} {y} {z} {qw} {qx} {qy} {qz}"),
        ("timestamp tx ty tz qx qy qz qw", "{t:.6f} {x} {y} {z} {qx} {qy} {qz} {qw}"),
        ("% time\tq_w\tq_x\tq_y\tq_z\tp_x\tp_y\tp_z", "{t:.6f}\t{qw}\t{qx}\t{qy}\t{qz}\t{x}\t{y}\t{z}"),
        ("# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12", "{t:.6f} {x} {y} {z} {qx} {qy} {qz} {qw} 0.1 0"),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", "{t:.6f},{x},{y},{z},{qx},{qy},{qz},{qw}"),
        (",time,x,y,z,qw,qx,qy,qz", "{k},{t:.6f},{x},{y},{z},{qw},{qx},{qy},{qz}"),
        ("timestamp [ns], vertex index, position x [m], position y [m], position z [m], quaternion x, quaternion y, "
         "quaternion z, quaternion w", "{ns}, {k}, {x}, {y}, {z}, {qx}, {qy}, {qz}, {qw}"),
        ("#timestamp [s];p_RS_R_x [m];p_RS_R_y [m];p_RS_R_z [m];q_RS_w [];q_RS_x [];q_RS_y [];q_RS_z []",
         "{t:.6f};{x};{y};{z};{qw};{qx};{qy};{qz}"),
        ("%time,field.header.seq,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
         "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
         "{ns},{k},{ns},{x},{y},{z},{qx},{qy},{qz},{qw}"),
        ("", "{ns},{x},{y},{z},{qw},{qx},{qy},{qz},0.1,0.2,0.3,"),
        ("", "{ns}.0,{x},{y},{z},{qw},{qx},{qy},{qz}"),
    ],
    ids=["wxyz", "no_hash", "tabs", "openvins", "csv", "pandas", "maplab", "semicolons", "rostopic", "vins", "float"],
)  # fmt: skip
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_trajectory_header_names_columns(tmp_path: Path, header: str, line: str, end: str) -> None:
    write_table(tmp_path / "t.txt", TIMES, POSES, header, line, end)
    trajectory = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(trajectory.timestamps, TIMES, atol=1e-6)
    np.testing.assert_allclose(trajectory.poses, POSES, atol=1e-6)


def test_trajectory_other_comment_names_no_columns(tmp_path: Path) -> None:
    write_table(tmp_path / "t.txt", TIMES, POSES, "# poses qw x, y", "{t:.6f} {x} {y} {z} {qx} {qy} {qz} {qw}")
    np.testing.assert_allclose(read_trajectory(tmp_path / "t.txt").poses, POSES, atol=1e-6)


@pytest.mark.parametrize("separator", [" ", "\t", ",", ", "])
@pytest.mark.parametrize("rows", [3, 4])
def test_trajectory_matrix_lines_of_any_separator(tmp_path: Path, rows: int, separator: str) -> None:
    lines = [separator.join(f"{value:.9e}" for value in T[:rows].ravel()) for T in (np.zeros((4, 4)), *POSES)]
    (tmp_path / "t.txt").write_text("\r\n".join(lines))
    trajectory = read_trajectory(tmp_path / "t.txt")
    assert (trajectory.format, trajectory.poses[0]) == (TrajectoryFormat.KITTI, None)
    np.testing.assert_allclose(trajectory.poses[1:], POSES, atol=1e-6)


def test_trajectory_euroc_without_header_needs_unix_times(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("\n".join(EUROC.splitlines()[1:]))
    assert read_trajectory(tmp_path / "t.csv").format is TrajectoryFormat.EUROC


def test_trajectory_empty_or_missing_file_has_no_format(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# nothing\n")
    assert read_pose_lines(tmp_path / "t.txt") == (TrajectoryFormat.TUM, [])
    with pytest.raises(DataError, match=r"missing.txt: expected a trajectory in TUM format, got no such file"):
        read_pose_lines(tmp_path / "missing.txt")


def test_trajectory_unknown_matrix_line_is_invalid_alone(tmp_path: Path) -> None:
    """A frame of an RGB-D folder without a valid pose is skipped, and the other frames are kept."""
    (tmp_path / "t.txt").write_text(KITTI + "0 0 0 0 0 0 0 0 0 0 0 0\n" + KITTI)
    _, lines = read_pose_lines(tmp_path / "t.txt")
    assert [line.is_zero for line in lines if hasattr(line, "is_zero")] == [False, True, False]
    with pytest.raises(DataError, match=r"t.txt, line 2: pose: expected a rigid transform"):
        lines[1].pose()
