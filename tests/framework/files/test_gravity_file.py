"""Tests for gravity files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples

from framework.data import UNIT_TOLERANCE
from framework.errors import DataError
from framework.files.number_lines import read_gravity, write_gravity
from tests.support.recordings.damaged_files import EXAMPLES, damaged

UPS = [np.array([0.0, -1.0, 0.0]), None, np.array([0.6, 0.0, -0.8])]
CONTENT = b"# x y z\n0 -1 0\nnan nan nan\n0.6 0.0 -0.8\n"


def test_gravity_file_round_trip_preserves_directions(tmp_path: Path) -> None:
    write_gravity(tmp_path / "gravity.txt", UPS)
    first, second, third = read_gravity(tmp_path / "gravity.txt")
    np.testing.assert_allclose(first, UPS[0], atol=1e-9)
    assert second is None
    np.testing.assert_allclose(third, UPS[2], atol=1e-9)


def test_gravity_file_in_m_s2_is_normalized(tmp_path: Path) -> None:
    (tmp_path / "gravity.txt").write_text("# a header\n\n0.0 -9.81 0.0  # at rest\n-1.#IND nan NaN\n")
    up, unknown = read_gravity(tmp_path / "gravity.txt")
    np.testing.assert_allclose(up, [0, -1, 0])
    assert unknown is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 0 0", "expected a direction x y z of length 1e-06 to .*, or nan nan nan if unknown, got '0 0 0'"),
        ("inf 0 0", "expected a direction"),
        ("nan 0 1", "expected a direction"),
        ("1e300 1e300 0", "expected a direction"),
        ("1 2", r"expected 3 numbers \(x y z\), got 2"),
        ("1 2 up", "expected 3 numbers .* got 'up'"),
    ],
)
def test_gravity_file_invalid_line_raises_one_line_error(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "gravity.txt").write_text(f"0 -1 0\n{line}\n")
    with pytest.raises(DataError, match=rf"gravity\.txt, line 2: {message}"):
        read_gravity(tmp_path / "gravity.txt")


@examples(max_examples=EXAMPLES, deadline=None)
@given(damaged(CONTENT, (b"nan", b"inf", b"1e-320", b"#")))
def test_gravity_file_fuzzed_is_read_or_raises_one_line_error(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.mktemp("gravity") / "gravity.txt"
    path.write_bytes(content)
    try:
        ups = read_gravity(path)
    except DataError as error:
        assert str(error).startswith(str(path))
        assert str(error).isprintable()
        return
    for up in ups:
        assert up is None or abs(np.linalg.norm(up) - 1) < UNIT_TOLERANCE
