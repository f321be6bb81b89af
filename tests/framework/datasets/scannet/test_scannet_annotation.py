"""Tests for the labeled mesh of ScanNet: instances from segments and objects, and classes from names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.datasets.scannet.scannet_annotation import (
    LARGEST_FILE,
    read_aggregation,
    read_label_table,
    read_labeled_mesh,
    read_scannet200_names,
)
from framework.errors import DataError
from framework.files.ply import write_ply
from framework.vocabulary.label_spaces import MEANINGS

SEGMENTS = [3, 3, 70, 70, 5, 5, 9, 9, 11, 12]  # segment ids of ten vertices in a row
TABLE = """id\traw_category\tcategory\tnyu40class
1\tRecliner chair \trecliner\tchair
2\tgizmo\tgizmo\totherprop
3\tlaptop\tlaptop\tbox
"""


def group(object_id: int, label: str, *segments: int) -> dict[str, Any]:
    return {"id": object_id, "objectId": object_id, "label": label, "segments": list(segments)}


def read(folder: Path, groups: list[dict[str, Any]], segments: list[int] | None = None, table: str = "") -> LabeledMesh:
    vertices = np.zeros((10, 3), np.float32)
    vertices[:, 0] = np.arange(10)
    write_ply(folder / "s.ply", vertices, np.array([[0, 1, 2]], np.int32), {"red": np.zeros(10, np.uint8)})
    content = {"params": {"kThresh": "0.01"}, "sceneId": "s", "segIndices": SEGMENTS if segments is None else segments}
    (folder / "s.segs.json").write_text(json.dumps(content))
    (folder / "s.aggregation.json").write_text(json.dumps({"sceneId": "scannet.s", "segGroups": groups}))
    (folder / "labels.tsv").write_text(table)
    nyu40 = read_label_table(folder / "labels.tsv") if table else {}
    scannet200 = read_scannet200_names(folder / "labels.tsv") if table else {}
    files = (folder / "s.ply", folder / "s.segs.json", folder / "s.aggregation.json")
    return read_labeled_mesh(*files, nyu40, scannet200)


def test_scannet_annotation_maps_segments_to_instances(tmp_path: Path) -> None:
    mesh = read(tmp_path, [group(0, "office chair", 70, 9), group(4, "couch", 5), group(1, "wall", 3)])
    # the wall is not an instance; the part without labels is an instance without a class
    np.testing.assert_array_equal(mesh.instance_ids, [0, 0, 1, 1, 5, 5, 1, 1, 6, 6])
    assert mesh.class_names == {1: "chair", 5: "couch", 6: None}
    assert mesh.instance_ids.dtype == np.int32
    np.testing.assert_array_equal(mesh.vertices[:, 0], np.arange(10))
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2]])


def test_scannet_annotation_full_mesh_adds_no_unknown_instance(tmp_path: Path) -> None:
    mesh = read(tmp_path, [group(0, "bed", 3, 70, 5, 9, 11), group(1, "floor", 12)])
    np.testing.assert_array_equal(mesh.instance_ids, [1] * 9 + [0])
    assert mesh.class_names == {1: "bed"}


def test_scannet_annotation_without_objects_is_unknown_instance(tmp_path: Path) -> None:
    mesh = read(tmp_path, [])
    np.testing.assert_array_equal(mesh.instance_ids, [1] * 10)
    assert mesh.class_names == {1: None}


@pytest.mark.parametrize(
    ("label", "instance", "name"),
    [
        ("tv", 1, "tv"),
        ("Monitor ", 1, "tv"),
        ("books", 1, "book"),
        ("trash can", 0, None),
        ("trashcan", 0, None),
        ("TV_monitor", 1, "tv"),
        ("washbasin", 1, "sink"),
        ("junk", 1, None),
        ("ceiling", 0, None),
        ("object", 1, None),
        ("otherfurniture", 1, None),
        ("gizmo", 1, None),
        ("recliner chair", 1, None),
        ("", 1, None),
    ],
)
def test_scannet_annotation_label_maps_to_instance_and_class(
    tmp_path: Path, label: str, instance: int, name: str | None
) -> None:
    mesh = read(tmp_path, [group(0, label, *SEGMENTS)])
    assert set(mesh.instance_ids.tolist()) == {instance}
    assert mesh.class_names == ({instance: name} if instance else {})


@pytest.mark.parametrize(("label", "name"), [("recliner chair", "chair"), ("gizmo", None), ("laptop", "laptop")])
def test_scannet_label_table_resolves_rare_names(tmp_path: Path, label: str, name: str | None) -> None:
    assert read(tmp_path, [group(0, label, *SEGMENTS)], table=TABLE).class_names == {1: name}


def test_scannet_annotated_objects_have_names_in_label_spaces(tmp_path: Path) -> None:
    table = (
        "id\traw_category\tnyu40class\n2\tchair\tchair\n5\toffice chair\tchair\n2\tstack of chairs\tchair\n"
        "1\twall\twall\n900\tgizmo\totherprop\n"
    )
    groups = [group(0, "stack of chairs", 3), group(1, "office chair", 70), group(2, "wall", 5), group(3, "gizmo", 9)]
    annotated = read(tmp_path, groups, table=table).annotated
    assert annotated is not None
    np.testing.assert_array_equal(np.unique(annotated.instance_ids), [1, 2, 3, 4, 5])  # 5 = unlabeled
    assert annotated.own_names == {1: "stack of chairs", 2: "office chair", 3: "wall", 4: "gizmo", 5: None}
    assert annotated.names["nyu40"] == {1: "chair", 2: "chair", 3: "wall", 4: "otherprop"}
    assert annotated.names["scannet200"] == {1: "chair", 2: "office chair", 3: "wall"}
    assert annotated.names["scannet20"] is annotated.names["agnostic"] is annotated.names["nyu40"]


def test_scannet_label_table_of_first_release_is_read(tmp_path: Path) -> None:
    table = "category\tcount\tnyu40class\nrecliner chair\t3\tchair\nnerf gun\t8\totherprop\nstorage\t8\t\n"
    mesh = read(tmp_path, [group(0, "reclinerchair", 3), group(1, "nerf gun", 70)], table=table)
    assert mesh.class_names == {1: "chair", 2: None, 3: None}
    assert read_label_table(tmp_path / "labels.tsv") == {
        "recliner chair": "chair",
        "nerf gun": "otherprop",
        "storage": "",
    }


def test_scannet_label_table_missing_names_are_listed(tmp_path: Path) -> None:
    objects = [
        group(k, label, 3) for k, label in enumerate(("zimzum", "laptop", "Gizmo", "unknown", "whatnot", "zimzum"))
    ]
    message = r"s\.aggregation\.json: expected labels from scannetv2-labels.*, got 'whatnot', 'zimzum'; add a line"
    with pytest.raises(DataError, match=message) as caught:
        read(tmp_path, objects, table=TABLE)
    assert "\n" not in str(caught.value)


def test_scannet_name_spellings_have_same_class() -> None:
    """Names may be written without spaces and punctuation."""
    meanings: dict[str, set[str | None]] = {}
    for name, meaning in MEANINGS.items():
        meanings.setdefault("".join(filter(str.isalnum, name)), set()).add(meaning)
    assert all(len(meant) == 1 for meant in meanings.values())


def test_scannet_annotation_later_object_has_shared_segment(tmp_path: Path) -> None:
    mesh = read(tmp_path, [group(0, "bed", 3, 70), group(1, "pillow", 70), group(2, "chair", 3)])
    np.testing.assert_array_equal(mesh.instance_ids[:4], [3, 3, 0, 0])


def test_scannet_annotation_duplicate_object_is_merged(tmp_path: Path) -> None:
    mesh = read(tmp_path, [group(0, "bed", 3), group(0, "bed", 3, 70)])
    np.testing.assert_array_equal(mesh.instance_ids[:4], 1)
    with pytest.raises(DataError, match=r"s\.aggregation\.json: object 0: expected one label, got 'bed' and 'sofa'"):
        read(tmp_path, [group(0, "bed", 3), group(0, "sofa", 70)])


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([group(0, "bed", 4)], r"object 0: expected segments of s\.segs\.json, got segment 4"),
        ([group(0, "bed", 3), 5], r"segGroups\[1\]: expected a JSON object, got int"),
        ([group(-1, "bed", 3)], r"segGroups\[0\]: objectId: expected an integer from 0"),
        ([group(2**31, "bed", 3)], "objectId: expected an integer from 0"),
        ([group(0, "bed", 3) | {"objectId": True}], "objectId: expected an integer from 0"),
        ([group(0, "bed", 3) | {"label": None}], r"expected a label \(text\) and segments \(list\), got"),
        ([group(0, "bed", 3) | {"segments": "3"}], r"expected a label \(text\) and segments \(list\), got"),
        ([group(0, "bed", 3) | {"segments": [3, 3.5]}], r"segments: expected integers, got 3\.5"),
        ({}, "expected a list 'segGroups', got dict"),
    ],
)
def test_scannet_annotation_invalid_object_raises(tmp_path: Path, groups: Any, message: str) -> None:
    with pytest.raises(DataError, match=r"s\.aggregation\.json: .*" + message) as caught:
        read(tmp_path, groups)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("segments", "message"),
    [
        (SEGMENTS[:-1], r"segIndices: expected 10 ids, one for each vertex of s\.ply, got 9"),
        ([*SEGMENTS[:-1], None], "segIndices: expected integers, got None"),
        ([SEGMENTS], r"segIndices: expected integers, got \["),
        ("3", "expected a list 'segIndices', got str"),
    ],
)
def test_scannet_annotation_invalid_segments_raise(tmp_path: Path, segments: Any, message: str) -> None:
    with pytest.raises(DataError, match=r"s\.segs\.json.*" + message):
        read(tmp_path, [], segments)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected valid JSON"),
        (b"[" * 100000, "expected JSON with at most 50 nested lists"),
        (b'{"segGroups": [' + b"9" * 5000 + b"]}", "expected integers of at most 63 bits"),
        (b"\xff\xfe", "expected valid JSON"),
        (b"[]", "expected a JSON object"),
    ],
)
def test_scannet_annotation_invalid_json_raises_one_line_error(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "s.aggregation.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        read_aggregation(path)
    assert "\n" not in str(caught.value)


def test_scannet_annotation_oversized_raises_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "s.aggregation.json"
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    with pytest.raises(DataError, match=f"expected at most {LARGEST_FILE} bytes, got {LARGEST_FILE + 1}"):
        read_aggregation(path)


def test_scannet_label_table_invalid_line_error_gives_number(tmp_path: Path) -> None:
    path = tmp_path / "scannetv2-labels.combined.tsv"
    path.write_text("id\traw_category\tnyu40class\r\n1\tArm chair\tchair\r\n2\tdesk\tdesk\r\n")
    assert read_label_table(path) == {"arm chair": "chair", "desk": "desk"}
    path.write_text("id\traw_category\tnyu40class\n1\tarm chair\tchair\n2\tdesk\n")
    with pytest.raises(DataError, match="line 3: expected 3 columns, got 2"):
        read_label_table(path)
    path.write_text("raw\tnyu40class\n")
    with pytest.raises(DataError, match="line 1: expected columns raw_category or category and nyu40class"):
        read_label_table(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match="expected UTF-8 text"):
        read_label_table(path)
