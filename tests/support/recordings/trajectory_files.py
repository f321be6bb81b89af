"""Writers of trajectories in TUM, EuRoC and KITTI format.

Sources: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats; the header and the columns of
state_groundtruth_estimate0/data.csv of the EuRoC MAV dataset; readme.txt of the development kit of KITTI odometry; the
header of RTAB-Map's export "RGBD-SLAM + ID" (graph::exportPoses, format 11).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)


def write_tum_with_ids(path: Path, timestamps: Sequence[float], poses: Sequence[np.ndarray]) -> None:
    lines = ["#timestamp x y z qx qy qz qw id"]
    for number, (time, T) in enumerate(zip(timestamps, poses, strict=True), start=1):
        lines.append(f"{time:.6f} {_words([*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])} {number}")
    path.write_text("\n".join(lines) + "\n")


def write_euroc(path: Path, timestamps: Sequence[float], poses: Sequence[np.ndarray]) -> None:
    lines = [EUROC_HEADER]
    for time, T in zip(timestamps, poses, strict=True):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        values = [*T[:3, 3], w, x, y, z, *np.linspace(-0.1, 0.9, 9)]
        lines.append(f"{round(time * 1e9)},{','.join(f'{value:.9f}' for value in values)}")
    path.write_text("\r\n".join(lines) + "\r\n")  # the published files have Windows line ends


def write_kitti(path: Path, timestamps: Sequence[float], poses: Sequence[np.ndarray]) -> None:
    path.write_text("".join(f"{' '.join(f'{value:.6e}' for value in T[:3].ravel())}\n" for T in poses))


def write_table(
    path: Path, timestamps: Sequence[float], poses: Sequence[np.ndarray], header: str, line: str, end: str = "\n"
) -> None:
    """Write a header and a line per pose in a format of its columns, such as "{t:.6f},{x},{y},{z},{qx},{qy},{qz},{qw}".

    The names ns and k are the time in nanoseconds and the line number from 0.
    """
    lines = [header] * bool(header)
    for k, (time, T) in enumerate(zip(timestamps, poses, strict=True)):
        values = [f"{value:.9f}" for value in (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())]
        named = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True))
        lines.append(line.format(t=time, ns=round(time * 1e9), k=k, **named))
    path.write_bytes((end.join(lines) + end).encode())


def _words(values: Sequence[float]) -> str:
    return " ".join(f"{value:.9f}" for value in values)
