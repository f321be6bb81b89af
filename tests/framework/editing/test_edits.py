"""Tests for edits and their file format."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from framework.editing import edits
from framework.editing.edits import Delete, Edit, Merge, Rename, Split, SplitBy, edits_of, read_edits, write_edits
from framework.errors import DataError

SCHEMA = json.loads((Path(edits.__file__).parent / "edits.schema.json").read_text())
ALL: list[Edit] = [Merge((3, 7, 2)), Split(5), Split(6, SplitBy.PLANE), Rename(4, "dining table"), Delete((9, 10))]


def test_edits_file_round_trip_is_identical(tmp_path: Path) -> None:
    write_edits(tmp_path / "edits.json", ALL)
    assert read_edits(tmp_path / "edits.json") == ALL
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(json.loads((tmp_path / "edits.json").read_text()), SCHEMA)


def test_split_without_criterion_is_by_parts() -> None:
    assert edits_of("edits", [{"split": [5]}]) == [Split(5, SplitBy.PARTS)]
    jsonschema.validate([{"split": [5]}], SCHEMA)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({}, "entry 2: expected a JSON object with one of the keys merge, split, rename, delete, got {}"),
        ({"merge": [1, 2], "delete": [3]}, "entry 2: expected a JSON object with one of the keys"),
        ({"join": [1, 2]}, "entry 2: expected a JSON object with one of the keys"),
        ("merge", "entry 2: expected a JSON object with one of the keys"),
        ({"merge": [3]}, "entry 2: merge: expected two or more instance ids, got [3]"),
        ({"merge": [3, 3]}, "entry 2: merge: expected different instance ids, got [3, 3]"),
        ({"merge": 3}, "entry 2: merge: expected two or more instance ids, got 3"),
        ({"delete": []}, "entry 2: delete: expected one or more instance ids, got []"),
        ({"delete": [0]}, "entry 2: delete: expected instance ids in [1, 16777216], got 0"),
        ({"delete": [True]}, "entry 2: delete: expected instance ids in [1, 16777216], got True"),
        ({"delete": [1.5]}, "entry 2: delete: expected one or more instance ids, got [1.5]"),
        ({"delete": ["chair"]}, "entry 2: delete: expected instance ids in [1, 16777216], got 'chair'"),
        ({"split": [5, "line"]}, "entry 2: split: expected an instance id and optionally 'parts' or 'plane'"),
        ({"split": [5, "plane", 1]}, "entry 2: split: expected an instance id and optionally 'parts' or 'plane'"),
        ({"rename": [4]}, "entry 2: rename: expected an instance id and a class name, got [4]"),
        ({"rename": [4, 5]}, "entry 2: rename: expected an instance id and a class name, got [4, 5]"),
    ],
)
def test_edits_invalid_entry_raises_data_error(entry: Any, message: str) -> None:
    with pytest.raises(DataError, match=f"^edits, {re.escape(message)}"):
        edits_of("edits", [{"delete": [1]}, entry])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate([{"delete": [1]}, entry], SCHEMA)


def test_read_edits_without_array_raises_data_error(tmp_path: Path) -> None:
    (tmp_path / "edits.json").write_text('{"merge": [3, 7]}')
    with pytest.raises(DataError, match=re.escape("expected a JSON array of edits, got {'merge': ")):
        read_edits(tmp_path / "edits.json")
