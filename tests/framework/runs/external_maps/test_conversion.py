"""Tests for the conversion of external maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.ply import PlyMesh
from framework.runs.external_maps.conversion import NO_FRAME, ConvertedMap, MapPlacement, read_transform
from framework.runs.external_maps.external_map import ExternalInstance, ExternalMap
from framework.vocabulary.label_spaces import COCO, ClassNames

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4], [1, 1, 1]], np.float32)
TRIANGLES = np.array([[0, 1, 2]], np.int32)
HERE = MapPlacement()


def external_map(*instances: tuple[list[int], str | None, float | None], **properties: np.ndarray) -> ExternalMap:
    found = {
        key: ExternalInstance(np.array(vertices, np.int32), label, confidence)
        for key, (vertices, label, confidence) in enumerate(instances, start=1)
    }
    return ExternalMap(PlyMesh(VERTICES, TRIANGLES, properties, ()), found, "")


def test_names_of_other_spaces_become_coco_names() -> None:
    converted = ConvertedMap.of(external_map(([0, 1], "Sofa, couch", 0.5), ([2], "office chair", 0.25)), HERE)
    classes = {key: COCO[int(one.class_probabilities.argmax())] for key, one in converted.instances.items()}
    assert classes == {1: "couch", 2: "chair"}
    assert [COCO[k] if k >= 0 else None for k in converted.mesh.class_ids] == ["couch", "couch", "chair", None, None]
    assert {one.class_probabilities.sum() for one in converted.instances.values()} == {1.0}
    assert converted.remarks == ()


def test_instances_without_coco_class_are_counted() -> None:
    """All names are in known label spaces."""
    external = external_map(([0], "chair", 1.0), ([1], "wall", 1.0), ([2], "wall", 1.0), ([3], "floor", 1.0))
    converted = ConvertedMap.of(external, HERE)
    assert converted.mesh.instance_ids.tolist() == [1, 0, 0, 0, 0]
    [remark] = converted.remarks
    assert remark == "left out: 3 of 4 instances without a COCO class: wall (2), floor (1)"


def test_auto_keeps_all_names_with_unknown_name() -> None:
    external = external_map(([0], "Sofa", 1.0), ([1], "wall", 1.0), ([2], "forklift", 1.0), ([3], "unlabeled", 1.0))
    converted = ConvertedMap.of(external, HERE)
    assert converted.mesh.classes == ("Sofa", "wall", "forklift")
    assert converted.mesh.class_ids.tolist() == [0, 1, 2, -1, -1]
    assert converted.remarks == (
        "classes: all names are kept, because 1 of 3 are in no known label space: 'forklift'",
        "left out: 1 of 4 instances without a class: unlabeled (1)",
    )


def test_auto_considers_label_space_without_instances() -> None:
    """The classes of a scene do not depend on the objects in it."""
    external = replace(external_map(([0], "chair", 1.0), ([1], "wall", 1.0)), label_space=("n/a", "pallet", "chair"))
    assert ConvertedMap.of(external, HERE).mesh.classes == ("pallet", "chair", "wall")


@pytest.mark.parametrize(
    ("class_names", "ids"), [(ClassNames.COCO, [1, 0, 0, 0, 0]), (ClassNames.OWN, [1, 2, 3, 0, 0])]
)
def test_class_names_select_instances(class_names: ClassNames, ids: list[int]) -> None:
    external = external_map(([0], "chair", 1.0), ([1], "wall", 1.0), ([2], "forklift", 1.0))
    assert ConvertedMap.of(external, HERE, class_names).mesh.instance_ids.tolist() == ids


def test_map_without_coco_class_is_error() -> None:
    with pytest.raises(DataError, match=r"an instance with a COCO class, got none .*wall .1.*; set class_names=OWN"):
        ConvertedMap.of(external_map(([0], "wall", 1.0)), HERE, ClassNames.COCO)


@pytest.mark.parametrize("name", ["fork\nlift", "f" * 101])
def test_invalid_class_name_is_error(name: str) -> None:
    with pytest.raises(DataError, match="class: expected a class name of 1 to 100 characters"):
        ConvertedMap.of(external_map(([0], name, 1.0)), HERE)


def test_map_without_classes_keeps_all_instances() -> None:
    converted = ConvertedMap.of(external_map(([0], None, 0.5), ([1], None, 0.5)), HERE)
    assert converted.mesh.classes == ()
    assert [len(one.class_probabilities) for one in converted.instances.values()] == [0, 0]
    assert set(converted.mesh.class_ids.tolist()) == {-1}


def test_overlap_belongs_to_highest_confidence() -> None:
    external = external_map(([0, 1, 2], "chair", 0.5), ([1, 2, 3], "couch", 0.75), ([3, 4], "bed", 0.75))
    converted = ConvertedMap.of(external, HERE)
    assert converted.mesh.instance_ids.tolist() == [1, 2, 2, 2, 3]
    assert converted.remarks == ("overlaps: removed 3 labels at points of several instances",)


def test_covered_instance_is_kept_without_vertices() -> None:
    converted = ConvertedMap.of(external_map(([1, 2], "chair", 0.5), ([0, 1, 2], "couch", 0.75)), HERE)
    covered = converted.instances[1]
    assert covered.vertices.tolist() == []
    np.testing.assert_allclose(covered.aabb.extent, [1, 2, 0])


def test_unknown_confidence_is_one_and_reported() -> None:
    converted = ConvertedMap.of(external_map(([0], "chair", None), ([1], "couch", 0.5)), HERE)
    assert [one.confidence for one in converted.instances.values()] == [1.0, 0.5]
    assert converted.remarks == ("confidence: unknown for 1 instances, set to 1; AP ranks equal confidences by id",)


def test_imported_instance_has_no_frames() -> None:
    one = ConvertedMap.of(external_map(([0, 1], "chair", 0.5)), HERE).instances[1]
    assert (one.observations, one.first_frame, one.last_frame) == (0, NO_FRAME, NO_FRAME)


def test_placement_scales_before_it_transforms() -> None:
    T_world_map = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    converted = ConvertedMap.of(external_map(([0, 1], "chair", 0.5)), MapPlacement(0.001, T_world_map))
    np.testing.assert_allclose(converted.mesh.vertices[1], [10, 20.001, 30], atol=1e-5)
    np.testing.assert_allclose(converted.mesh.vertices[2], [9.998, 20, 30], atol=1e-5)


def test_placement_up_gives_upright_boxes() -> None:
    up = np.array([0.0, 1.0, 0.0])
    box = ConvertedMap.of(external_map(([0, 1, 2, 3], "chair", 0.5)), MapPlacement(up=up)).instances[1].obb
    np.testing.assert_allclose(box.rotation[:, 2], up)
    assert box.extent[2] == pytest.approx(2)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_invalid_scale_is_error(scale: float) -> None:
    with pytest.raises(DataError, match="scale: expected a positive number"):
        MapPlacement(scale)


def test_coordinates_in_millimeters_are_error() -> None:
    with pytest.raises(DataError, match="set scale"):
        ConvertedMap.of(external_map(([0, 1], "chair", 0.5)), MapPlacement(1e6))


def test_transform_must_be_rigid(tmp_path: Path) -> None:
    path = tmp_path / "T.txt"
    path.write_text("1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n")
    np.testing.assert_array_equal(read_transform(path)[:3, 3], [5, 6, 7])
    path.write_text("2 0 0 5\n0 2 0 6\n0 0 2 7\n0 0 0 1\n")
    with pytest.raises(DataError, match=r"T\.txt"):
        read_transform(path)


def test_colors_are_read_or_gray() -> None:
    instance = ([0], "chair", 0.5)
    colors = {name: np.array([0, 51, 102, 153, 255], np.uint8) for name in ("red", "green", "blue")}
    fractions = {name: np.array([0, 0.2, 0.4, 0.6, 1], np.float32) for name in colors}
    expected = np.stack(list(colors.values()), axis=1)
    np.testing.assert_array_equal(ConvertedMap.of(external_map(instance, **colors), HERE).mesh.colors, expected)
    np.testing.assert_array_equal(ConvertedMap.of(external_map(instance, **fractions), HERE).mesh.colors, expected)
    assert (ConvertedMap.of(external_map(instance), HERE).mesh.colors == 180).all()
