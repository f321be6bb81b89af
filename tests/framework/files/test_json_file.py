"""Tests for JSON files, including files that are invalid, too large or too deeply nested."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.errors import DataError
from framework.files.json_file import MAX_DEPTH, parse_json, read_json, write_json


def test_json_round_trip_is_exact(tmp_path: Path) -> None:
    content = {"a": [1, 0.1, 2**62, None, True, "\u00e9"], "b": {"c": {}}}
    write_json(tmp_path / "a.json", content)
    assert read_json(tmp_path / "a.json") == content


@pytest.mark.parametrize("marked", [b"\xef\xbb\xbf[1]", b"\xff\xfe[\x001\x00]\x00"])
def test_json_byte_order_mark_is_ignored(marked: bytes) -> None:
    assert parse_json("here", marked) == [1]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "Expecting value"),
        (b"[1", "delimiter"),
        (b"\xff", "decode"),
        (b"[" * 10**6, "expected JSON with at most 50 nested lists"),
        (b'{"a":' * 10**5, "expected JSON with at most 50 nested lists"),
        (b"[" * (MAX_DEPTH + 1) + b"]" * (MAX_DEPTH + 1), "expected JSON with at most 50 nested lists"),
        (b'{"a":' * 51 + b"1" + b"}" * 51, "expected JSON with at most 50 nested lists"),
        (b"[" + b"9" * 100_000 + b"]", "expected integers of at most 63 bits, got 9{20}... of 100000 digits"),
        (b"[9223372036854775808]", "expected integers of at most 63 bits"),
        (b'[{"fx": 1, "fy": 2, "fx": 3}]', "expected unique keys, got 'fx' twice"),
    ],
)
def test_json_invalid_raises_one_line_error_with_source(content: bytes, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        parse_json("results.json", content)
    assert str(caught.value).startswith("results.json: expected ")
    assert len(str(caught.value)) < 300


def test_json_duplicate_of_many_keys_is_found() -> None:
    keys = [*map(str, range(100_000)), "99999"]
    with pytest.raises(DataError, match="expected unique keys, got '99999' twice"):
        parse_json("results.json", "{" + ", ".join(f'"{key}": 0' for key in keys) + "}")


def test_json_maximum_nesting_depth_is_read(tmp_path: Path) -> None:
    (tmp_path / "deep.json").write_text("[" * MAX_DEPTH + "]" * MAX_DEPTH)
    found = read_json(tmp_path / "deep.json")
    for _ in range(MAX_DEPTH - 1):
        [found] = found
    assert found == []


@pytest.mark.parametrize("content", [b'["\\ud800"]', b'{"\\uDFFF": 1}', b'[{"a": ["x\\udc00\\ud800"]}]', '["\\ud800"]'])
def test_json_lone_surrogate_raises(content: bytes | str) -> None:
    with pytest.raises(DataError, match=r"^here: expected valid Unicode, got the lone surrogate '\\ud"):
        parse_json("here", content)


def test_json_surrogate_pair_is_character() -> None:
    assert parse_json("here", b'["\\ud83d\\ude00"]') == ["😀"]


def test_json_file_name_without_unicode_is_readable(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"room \udcff": ["\udcff"]})
    assert read_json(tmp_path / "a.json") == {r"room \udcff": [r"\udcff"]}
