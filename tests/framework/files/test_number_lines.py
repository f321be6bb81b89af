"""Tests for text files with lines of numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.number_lines import numbers, read_lines


def test_number_lines_python_number_formats_are_read() -> None:
    np.testing.assert_array_equal(numbers("here", ["1", "-2.5", "1e-3", "nan"], 4), [1, -2.5, 1e-3, np.nan])


@pytest.mark.parametrize(
    "word", ["-1.#IND", "1.#IND00", "1.#QNAN", "-1.#QNAN0", "1.#INF", "-1.#INF000000", "-nan(ind)", "nan(snan)", "-nan"]
)
def test_number_lines_microsoft_nan_and_inf_are_nan(word: str) -> None:
    assert np.isnan(numbers("here", [word], 1)).all()


@pytest.mark.parametrize("word", ["1.#", "1#IND", "2.#IND", "nan(", "nan()", "nan(a b)", "1.#IND-"])
def test_number_lines_nan_lookalike_raises(word: str) -> None:
    with pytest.raises(DataError, match="expected 1 numbers"):
        numbers("here", [word], 1)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["1", "2"], r"here: expected 3 numbers \(x y z\), got 2"),
        (["1", "two", "3"], r"here: expected 3 numbers \(x y z\), got 'two'"),
        (["1", "2", "3x" * 5000], r"here: expected 3 numbers \(x y z\), got '(3x){30}'"),
        (["1", "2", "\x9b3\u2028"], r"got '\\x9b3\\u2028'"),
    ],
)
def test_number_lines_invalid_number_raises_one_line_error(words: list[str], message: str) -> None:
    with pytest.raises(DataError, match=f"{message}$") as caught:
        numbers("here", words, 3, "x y z")
    assert str(caught.value).isprintable()


def test_number_lines_binary_or_missing_file_raises(tmp_path: Path) -> None:
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match=r"binary.txt: expected UTF-8 text"):
        read_lines(tmp_path / "binary.txt")
    with pytest.raises(DataError, match=r"none.txt: expected a list, got none; write one$"):
        read_lines(tmp_path / "none.txt", missing="expected a list, got none; write one")
