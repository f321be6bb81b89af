"""Tests for the stored mesh of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import MAX_CLASSES, InstanceMesh
from framework.errors import DataError
from framework.files.ply import write_ply
from framework.runs.mesh_file import read_mesh, write_mesh
from framework.vocabulary.label_spaces import COCO
from tests.support.scenes.corner_room import GridMap

TETRAHEDRON = InstanceMesh(
    vertices=np.array([[0, 0, 0], [1 / 3, 0, 1e-9], [0, -1e4, 0], [7, 0.1, 2.5]], np.float32),
    triangles=np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32),
    colors=np.arange(12, dtype=np.uint8).reshape(4, 3),
    instance_ids=np.array([0, 5, 2**31 - 1, 5], np.int32),
    class_ids=np.array([-1, 1, 0, 1], np.int32),
    classes=("chair", "dining table"),
)


@pytest.mark.parametrize(
    "mesh",
    [
        TETRAHEDRON,
        GridMap().mesh(),
        replace(TETRAHEDRON, structure=np.array([0, 1, 2, 4], np.uint8)),
        replace(TETRAHEDRON, classes=()),
        replace(TETRAHEDRON, classes=("sofa, couch", "50% palette", "Hubwagen für Paletten")),
    ],
    ids=["some", "empty", "structure", "no classes", "encoded classes"],
)
def test_mesh_file_round_trip_is_exact(tmp_path: Path, mesh: InstanceMesh) -> None:
    write_mesh(tmp_path / "mesh.ply", mesh)
    read = read_mesh(tmp_path / "mesh.ply")
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids", "structure"):
        np.testing.assert_array_equal(getattr(read, name), getattr(mesh, name))
    assert read.classes == mesh.classes


def test_mesh_file_lists_plain_classes_unchanged(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", replace(TETRAHEDRON, classes=COCO))
    assert f"comment classes {','.join(COCO)}\n".encode() in (tmp_path / "mesh.ply").read_bytes()


def test_read_mesh_foreign_ply_raises_one_line_error(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    mesh = TETRAHEDRON
    shades = dict.fromkeys(("red", "green", "blue"), mesh.colors[:, 0])
    labels = {"instance": mesh.instance_ids, "class": mesh.class_ids}
    for properties, comments, message in [
        (shades, ("classes chair",), "expected int32 for the vertex property 'instance', got none"),
        (
            shades | labels | {"class": mesh.class_ids.astype(np.float32)},
            ("classes chair",),
            "expected int32 for the vertex property 'class', got float32",
        ),
        (labels, ("classes chair",), "expected uint8 for the vertex property 'red', got none"),
        (shades | labels | {"structure": np.full(4, 9, np.uint8)}, ("classes chair",), "uint8 values of at most 4"),
        (shades | labels, (), "expected a line 'comment classes ...', got none"),
    ]:
        write_ply(path, mesh.vertices, mesh.triangles, properties, comments)
        with pytest.raises(DataError, match=message) as caught:
            read_mesh(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [0, 1, 80, 1203, MAX_CLASSES])
def test_write_mesh_splits_long_class_list(tmp_path: Path, count: int) -> None:
    """Open3D aborts the process if a line of the header has 1,024 bytes or more."""
    classes = tuple(f"class {k}, with a comma" for k in range(count))
    write_mesh(tmp_path / "mesh.ply", replace(TETRAHEDRON, class_ids=np.full(4, count - 1, np.int32), classes=classes))
    header = (tmp_path / "mesh.ply").read_bytes().partition(b"end_header\n")[0]
    assert max(map(len, header.splitlines())) < 1024
    assert read_mesh(tmp_path / "mesh.ply").classes == classes
