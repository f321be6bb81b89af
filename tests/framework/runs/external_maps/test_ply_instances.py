"""Tests for instances in the properties of PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.ply import PlyMesh, read_ply, write_ply
from framework.runs.external_maps.class_labels import ClassIdNames, InstanceLabel
from framework.runs.external_maps.external_map import UNLABELED, ExternalMap
from framework.runs.external_maps.ply_instances import LabelProperties, read_ply_instances

VERTICES = np.array([[k, 0, 0] for k in range(6)], np.float32)
TRIANGLES = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
NYU40 = ClassIdNames.of("nyu40")


def surface_of(tmp_path: Path, **properties: list[int] | list[float]) -> PlyMesh:
    """Write and read a PLY file with int32 properties, or float32 properties for fractions."""
    arrays = {}
    for name, values in properties.items():
        arrays[name] = np.array(values, np.int32 if all(isinstance(one, int) for one in values) else np.float32)
    write_ply(tmp_path / "map.ply", VERTICES, TRIANGLES, arrays)
    return read_ply(tmp_path / "map.ply")


def instances_in(surface: PlyMesh, chosen: LabelProperties | None = None, labels=None, names=NYU40) -> ExternalMap:
    return read_ply_instances(Path("map.ply"), surface, chosen or LabelProperties(), names, labels)


@pytest.mark.parametrize("instance", ["instance", "instance_id", "objectId", "object_id"])
@pytest.mark.parametrize("class_", ["label", "class", "semantic", "Category"])
def test_usual_properties_are_detected(instance: str, class_: str, tmp_path: Path) -> None:
    surface = surface_of(tmp_path, **{instance: [7, 7, 0, 3, 3, 3], class_: [5, 5, 1, 6, 6, 4]})
    found = instances_in(surface)
    assert {key: (one.label, one.vertices.tolist()) for key, one in found.instances.items()} == {
        3: ("sofa", [3, 4, 5]),  # two of three vertices
        7: ("chair", [0, 1]),
    }
    assert instance in found.source
    assert class_ in found.source


def test_chosen_properties_have_precedence(tmp_path: Path) -> None:
    surface = surface_of(tmp_path, instance=[1] * 6, mine=[2] * 6, label=[5] * 6, kind=[6] * 6)
    found = instances_in(surface, LabelProperties("mine", "kind"))
    assert {key: one.label for key, one in found.instances.items()} == {2: "sofa"}


def test_unknown_property_is_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"instance_property: expected one of label, got mine"):
        instances_in(surface_of(tmp_path, label=[5] * 6), LabelProperties("mine"))


def test_ply_without_instances_is_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a property with instance ids"):
        instances_in(surface_of(tmp_path, label=[5] * 6))


def test_empty_class_property_gives_no_classes(tmp_path: Path) -> None:
    surface = surface_of(tmp_path, instance=[1] * 6, label=[5] * 6)
    assert instances_in(surface, LabelProperties(class_="")).instances[1].label is None
    assert instances_in(surface_of(tmp_path, instance=[1] * 6)).instances[1].label is None


def test_class_ids_without_names_are_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected names of the class ids, got none; set label_space"):
        instances_in(surface_of(tmp_path, instance=[1] * 6, label=[5] * 6), names=None)


def test_class_id_above_label_space_is_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"expected a class id of nyu40 \(1 to 40\), got 41"):
        instances_in(surface_of(tmp_path, instance=[1] * 6, label=[41] * 6))


def test_class_id_below_label_space_is_unlabeled(tmp_path: Path) -> None:
    assert instances_in(surface_of(tmp_path, instance=[1] * 6, label=[0] * 6)).instances[1].label == UNLABELED


def test_negative_instance_is_error_until_chosen(tmp_path: Path) -> None:
    surface = surface_of(tmp_path, instance=[-1, 0, 0, 1, 1, 1], label=[5] * 6)
    with pytest.raises(DataError, match="set no_instance=-1 if it means no instance"):
        instances_in(surface)
    found = instances_in(surface, LabelProperties(no_instance=-1))
    assert {key: one.vertices.tolist() for key, one in found.instances.items()} == {1: [1, 2], 2: [3, 4, 5]}


def test_whole_numbers_in_float_property_are_ids(tmp_path: Path) -> None:
    surface = surface_of(tmp_path, instance=[1.0, 1.0, 2.0, 2.0, 0.0, 0.0])
    assert instances_in(surface).instances.keys() == {1, 2}
    with pytest.raises(DataError, match="instance: expected integers, got fractions"):
        instances_in(surface_of(tmp_path, instance=[0.5] * 6))


def test_labels_by_id_use_ids_of_the_file(tmp_path: Path) -> None:
    surface = surface_of(tmp_path, instance=[-1, 0, 0, 1, 2, 2])
    labels = {0: InstanceLabel("chair", 0.5), 2: InstanceLabel("couch", None)}
    found = instances_in(surface, LabelProperties(no_instance=-1), labels)
    assert {key: (one.label, one.confidence) for key, one in found.instances.items()} == {
        1: ("chair", 0.5),
        3: ("couch", None),
    }
    assert "1 of 3 instances without an entry left out" in found.source


def test_face_property_is_transferred_to_vertices(tmp_path: Path) -> None:
    quads = [
        *("ply", "format ascii 1.0", "element vertex 6", "property float x", "property float y", "property float z"),
        *("element face 2", "property list uchar int vertex_indices", "property int object_id", "end_header"),
        *("0 0 0", "1 0 0", "1 1 0", "0 1 0", "2 0 0", "2 1 0", "4 0 1 2 3 4", "3 4 5 2 9"),
    ]
    (tmp_path / "map.ply").write_text("\n".join(quads) + "\n")
    found = instances_in(read_ply(tmp_path / "map.ply"))
    assert {key: one.vertices.tolist() for key, one in found.instances.items()} == {4: [0, 1, 3], 9: [2, 4, 5]}
