"""Tests for matrices in text files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera
from framework.errors import DataError
from framework.files.number_lines import PrintedMatrix, read_matrix, read_matrix_lines

QUARTER_TURN = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
ROWS = "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n"


def test_matrix_file_of_four_lines_is_read(tmp_path: Path) -> None:
    path = tmp_path / "pose.txt"
    path.write_text("\n" + ROWS.replace(" ", "\t ").replace("\n", "\t\r\n"))
    np.testing.assert_array_equal(read_matrix(path).values, QUARTER_TURN)
    np.testing.assert_allclose(read_matrix(path).pose(), QUARTER_TURN, atol=1e-15)


def test_matrix_file_of_one_matrix_per_line_is_read(tmp_path: Path) -> None:
    path = tmp_path / "traj.txt"
    path.write_text(ROWS.replace("\n", " ") + "\n\n" + "1e0 0 0 7 0 1 0 8 0 0 1 9 0 0 0 nan\n")
    first, second = read_matrix_lines(path)
    np.testing.assert_array_equal(first.values, QUARTER_TURN)
    np.testing.assert_array_equal(second.values[:3, 3], [7, 8, 9])
    with pytest.raises(DataError, match=r"traj\.txt, line 3: pose: expected finite values"):
        second.pose()


@pytest.mark.parametrize(
    ("text", "message"),
    [("1 2 3", "line 1: expected 16 numbers, got 3"), (ROWS.replace("\n", " x "), "line 1: .* got 20")],
)
def test_matrix_file_invalid_line_error_gives_line_number(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "traj.txt").write_text(text)
    with pytest.raises(DataError, match=rf"traj\.txt, {message}"):
        read_matrix_lines(tmp_path / "traj.txt")


def test_matrix_file_missing_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"missing.txt: expected a text file, got no such file"):
        read_matrix(tmp_path / "missing.txt")


def test_matrix_file_empty_has_no_matrix(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").touch()
    assert read_matrix_lines(tmp_path / "empty.txt") == []


KINECT_MATRIX = np.array([[585.0, 0, 320, 0], [0, 580, 240, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_intrinsics_matrix_gives_pinhole_camera() -> None:
    assert PrintedMatrix("here", KINECT_MATRIX).camera(640, 480) == Camera(640, 480, 585, 580, 320, 240)


def test_intrinsics_matrix_invalid_raises() -> None:
    K = KINECT_MATRIX.copy()
    for row, column, value in ((0, 1, 0.1), (2, 0, 1), (2, 2, 2), (0, 0, np.nan), (3, 3, 0)):
        wrong = K.copy()
        wrong[row, column] = value
        with pytest.raises(DataError, match=r"^here: expected intrinsics"):
            PrintedMatrix("here", wrong).camera(640, 480)
    K[0, 0] = -585
    with pytest.raises(
        DataError, match=r"^here: Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy ="
    ):
        PrintedMatrix("here", K).camera(640, 480)
