"""Tests for label spaces and label files of external maps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from framework.errors import ConfigError, DataError
from framework.runs.external_maps.class_labels import ClassIdNames, InstanceLabel, read_labels_by_id


def written(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_label_space_ids_are_those_of_scannet_or_start_at_zero() -> None:
    assert ClassIdNames.of("coco").name("x", 0) == "person"
    assert ClassIdNames.of("nyu40").name("x", 1) == "wall"
    assert ClassIdNames.of("nyu40").name("x", 40) == "otherprop"
    assert ClassIdNames.of("scannet20").name("x", 39) == "otherfurniture"
    assert ClassIdNames.of("scannet200").name("x", 13) == "pillow"
    assert ClassIdNames.of("scannet200").name("x", 1191) == "mattress"


def test_label_space_file_has_one_name_per_id(tmp_path: Path) -> None:
    assert ClassIdNames.of(str(written(tmp_path / "names.txt", "forklift\npallet\n"))).name("x", 1) == "pallet"
    assert ClassIdNames.of(str(written(tmp_path / "a.json", ["forklift", "pallet"]))).name("x", 1) == "pallet"
    assert ClassIdNames.of(str(written(tmp_path / "b.json", {"1163": "pallet"}))).name("x", 1163) == "pallet"


def test_unknown_label_space_names_the_option() -> None:
    with pytest.raises(ConfigError, match="label_space: expected one of coco"):
        ClassIdNames.of("nyu41")


@pytest.mark.parametrize("content", [{"chair": 3}, {"3": 4}, {}, 3])
def test_invalid_names_are_error(content: object, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a"):
        ClassIdNames.of(str(written(tmp_path / "names.json", content)))


@pytest.mark.parametrize(
    "content",
    [
        [{"id": 3, "class": "chair", "confidence": 0.5, "vertices": 7}, {"id": 12, "class": "sofa"}],
        {"3": {"class": "chair", "confidence": 0.5}, "12": "sofa"},
    ],
    ids=["list", "object"],
)
def test_labels_by_id_are_read(content: object, tmp_path: Path) -> None:
    found = read_labels_by_id(written(tmp_path / "labels.json", content), None)
    assert found == {3: InstanceLabel("chair", 0.5), 12: InstanceLabel("sofa", None)}


def test_too_long_csv_field_is_error(tmp_path: Path) -> None:
    path = written(tmp_path / "labels.csv", f"id,class\n3,{'x' * 200_000}\n")
    with pytest.raises(DataError, match=r"labels.csv: expected valid CSV, got an error \(field larger than"):
        read_labels_by_id(path, None)


def test_labels_without_classes_have_no_name(tmp_path: Path) -> None:
    path = written(tmp_path / "labels.csv", "id,confidence\n3,0.5\n")
    assert read_labels_by_id(path, None) == {3: InstanceLabel(None, 0.5)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([{"id": 3}, {"id": 3}], "entry 2: id: expected unique ids, got 3 twice"),
        ([{"class": "chair"}], "entry 1: id: expected an integer, got None"),
        ([{"id": 3, "confidence": 2}], "entry 1: confidence: expected a number in"),
        ([{"id": 3, "confidence": True}], "entry 1: confidence: expected a number in"),
        (["chair"], "entry 1: expected a JSON object"),
        ("3", "expected a JSON array or object of instances"),
    ],
)
def test_invalid_labels_are_error(content: object, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message):
        read_labels_by_id(written(tmp_path / "labels.json", content), None)
