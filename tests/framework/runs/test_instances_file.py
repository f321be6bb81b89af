"""Tests for instances.json."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from framework.api import Mapper
from framework.data import Instance
from framework.errors import DataError
from framework.evaluation.instances import PredictedInstances
from framework.pipeline import Pipeline
from framework.runs import instances_file
from framework.runs.instances_file import read_instances, write_instances
from framework.runs.run_directory import likely_labels
from tests.support.scenes.corner_room import CLASSES, CornerRoom, GivenPose, GridFuser, GridMap, KeepAll, SphereDetector

BOX = {"center": [1, 2, 3], "extent": [0.5, 0.5, 1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
ENTRY = {
    **{"id": 3, "class": "chair", "confidence": 0.5, "class_probabilities": {"chair": 0.75, "couch": 0.25}},
    **{"observations": 4, "first_frame": 2, "last_frame": 9, "centroid": [1, 2, 3], "obb": BOX, "vertices": 12},
}


def mapped() -> GridMap:
    fuser = GridFuser()
    Pipeline(SphereDetector(), GivenPose(), KeepAll(), fuser).run(CornerRoom(frames=1))
    return fuser.scene


def nearly_equal(found: dict[int, Instance]) -> dict[int, Instance]:
    """Return the instances with confidences and class probabilities that differ only in the last bit."""
    confidences = {1: 1 / 3, 2: np.nextafter(1 / 3, 1)}
    even = np.float32(0.5)
    likely = np.array([np.nextafter(even, np.float32(0)), np.nextafter(even, np.float32(1))], np.float32)
    return {
        key: replace(instance, confidence=float(confidences[key]), class_probabilities=likely)
        for key, instance in found.items()
    }


def test_instances_file_round_trip_is_exact(tmp_path: Path) -> None:
    scene = mapped()
    mesh, found = scene.mesh(), nearly_equal(dict(scene.instances()))
    write_instances(tmp_path / "instances.json", mesh, found, CLASSES)
    stored = read_instances(tmp_path / "instances.json")
    for one, (key, instance) in zip(stored, found.items(), strict=True):
        assert (one.id, one.class_name, one.confidence) == (key, "couch", instance.confidence)
        np.testing.assert_array_equal(
            np.array(list(one.class_probabilities.values()), np.float32), instance.class_probabilities
        )
        assert one.probability == one.class_probabilities["couch"]
        assert (one.observations, one.vertices) == (instance.observations, len(instance.vertices))
        assert (one.first_frame, one.last_frame) == (instance.first_frame, instance.last_frame)
        np.testing.assert_array_equal(one.centroid, mesh.vertices[instance.vertices].mean(axis=0))
        for name in ("center", "extent", "rotation"):
            np.testing.assert_array_equal(getattr(one.obb, name), getattr(instance.obb, name))
    again = PredictedInstances.on_mesh(
        mesh, [one.id for one in stored], [one.confidence for one in stored], [one.class_name for one in stored]
    )
    direct = PredictedInstances.of_map(mesh, found, CLASSES)
    for name in ("points_world", "instance_ids", "ids", "confidences", "class_names"):
        np.testing.assert_array_equal(getattr(again, name), getattr(direct, name))


def test_class_probabilities_are_written_with_float32_digits(tmp_path: Path) -> None:
    scene = mapped()
    found = nearly_equal(dict(scene.instances()))
    write_instances(tmp_path / "instances.json", scene.mesh(), found, CLASSES)
    [first, _] = json.loads((tmp_path / "instances.json").read_text())
    read = np.array(list(first["class_probabilities"].values()), np.float32)
    np.testing.assert_array_equal(read, found[1].class_probabilities)
    assert max(len(str(value)) for value in first["class_probabilities"].values()) <= 10


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected valid JSON"),
        ("[", "expected valid JSON"),
        ("[" * 100_000, "expected JSON with at most 50 nested lists"),
        ("{}", "expected a JSON array of instances, got {}"),
        ("[7]", "entry 1: expected a JSON object"),
        ([ENTRY, ENTRY | {"id": 0}], r"entry 2: id: expected an integer in \[1, 2147483647\], got 0"),
        ([ENTRY | {"id": 2**31}], "entry 1: id"),
        ([ENTRY | {"id": True}], "entry 1: id"),
        ([ENTRY | {"id": 3.0}], "entry 1: id"),
        ([ENTRY | {"vertices": -1}], "entry 1: vertices"),
        ([ENTRY | {"class": 7}], "entry 1: class: expected a name or null, got 7"),
        (
            [{key: ENTRY[key] for key in ENTRY if key != "class"}],
            "entry 1: class: expected a name or null, got no class",
        ),
        ([ENTRY | {"confidence": 1.5}], r"entry 1: confidence: expected a number in \[0, 1\], got 1\.5"),
        ([ENTRY | {"confidence": float("nan")}], "entry 1: confidence"),
        ([ENTRY | {"confidence": 10**400}], "expected integers of at most 63 bits, got 10{19}... of 401 digits"),
        ([ENTRY | {"confidence": "high"}], "entry 1: confidence"),
        ([{"id": 3}], "entry 1: expected JSON objects in obb and class_probabilities, got None and None"),
        (
            [ENTRY | {"obb": [1, 2, 3]}],
            r"entry 1: expected JSON objects in obb and class_probabilities, got \[1, 2, 3\] and",
        ),
        (
            [ENTRY | {"class_probabilities": {"chair": 0.5, "couch": -1}}],
            "entry 1, class_probabilities: couch: expected",
        ),
        ([ENTRY | {"observations": 1.5}], "entry 1: observations: expected an integer.*"),
        ([ENTRY | {"first_frame": None}], "entry 1: first_frame: expected an integer.*, got None"),
        ([ENTRY | {"last_frame": True}], "entry 1: last_frame: expected an integer.*, got True"),
        (
            [ENTRY | {"centroid": [1, 2]}],
            r"entry 1: centroid: expected numbers of shape \(3,\) in \[-1e\+06, 1e\+06\],",
        ),
        (
            [ENTRY, ENTRY | {"id": 4, "obb": BOX | {"center": [1, 2, float("nan")]}}],
            "entry 2: center: expected numbers",
        ),
        (
            [ENTRY | {"obb": BOX | {"extent": [1e300, 1, 1]}}],
            "entry 1: extent: expected numbers of shape .*,",
        ),
        (
            [ENTRY | {"obb": BOX | {"rotation": [1, 0, 0]}}],
            "entry 1: rotation: expected numbers of shape .*,",
        ),
        ([ENTRY | {"obb": {}}], "entry 1: center: expected numbers of shape .*,"),
        ([ENTRY, ENTRY], "expected unique ids, got 1 ids for 2 instances"),
    ],
)
def test_read_instances_invalid_content_raises_one_line_error(tmp_path: Path, content: object, message: str) -> None:
    path = tmp_path / "instances.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(DataError, match=message) as caught:
        read_instances(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_read_instances_null_class_is_named_object(tmp_path: Path) -> None:
    """Maps without classes contain null. Frame numbers can be timestamps."""
    path = tmp_path / "instances.json"
    last = 1_700_000_000_000
    entry = ENTRY | {"class": None, "class_probabilities": {}, "last_frame": last, "centroid": None}
    path.write_text(json.dumps([entry]))
    [one] = read_instances(path)
    assert (one.class_name, one.probability, one.last_frame, one.centroid) == ("object", None, last, None)


def test_instances_file_without_instances_is_empty_list(tmp_path: Path) -> None:
    write_instances(tmp_path / "instances.json", GridMap().mesh(), {}, CLASSES)
    assert read_instances(tmp_path / "instances.json") == []


SCHEMA = json.loads((Path(instances_file.__file__).parent / "instances.schema.json").read_text())


def test_instances_schema_accepts_written_files(tmp_path: Path, room: CornerRoom) -> None:
    """The first map has upright boxes, and the second map has only the required values."""
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    mapper = Mapper("detector=ground_truth", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")
    for frame in room:
        mapper.add(frame)
    up = mapper.up()
    assert up is not None
    write_instances(tmp_path / "instances.json", mapper.mesh(), mapper.instances(), mapper.classes)
    written = json.loads((tmp_path / "instances.json").read_text())
    jsonschema.validate(written, SCHEMA)
    assert written
    for entry in written:
        np.testing.assert_allclose(np.array(entry["obb"]["rotation"])[:, 2], up, atol=1e-9)
    scene = mapped()
    write_instances(tmp_path / "others.json", scene.mesh(), dict(scene.instances()), CLASSES)
    jsonschema.validate(json.loads((tmp_path / "others.json").read_text()), SCHEMA)


@pytest.mark.parametrize(
    "damage",
    [{"id": 0}, {"confidence": 2}, {"centroid": [1, 2]}, {"obb": {}}, {"more": 1}, {"class_probabilities": {"a": 2}}],
)
def test_instances_schema_rejects_invalid_entries(tmp_path: Path, damage: dict[str, object]) -> None:
    scene = mapped()
    write_instances(tmp_path / "instances.json", scene.mesh(), dict(scene.instances()), CLASSES)
    [entry, *_] = json.loads((tmp_path / "instances.json").read_text())
    jsonschema.validate([entry], SCHEMA)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate([entry | damage], SCHEMA)


def test_instances_file_keeps_calibrated_probabilities(tmp_path: Path) -> None:
    scene = mapped()
    mesh, found = scene.mesh(), dict(scene.instances())
    key = min(found)
    found[key] = replace(found[key], confidence=0.2, exists=0.75, class_probability=0.5, expected_iou=0.625)
    write_instances(tmp_path / "instances.json", mesh, found, CLASSES)
    stored = {one.id: one for one in read_instances(tmp_path / "instances.json")}
    assert stored[key].probabilities == found[key].probabilities == (0.75, 0.5)
    assert (stored[key].existence, stored[key].expected_iou) == (0.75, 0.625)
    assert key in likely_labels(found, CLASSES), "expected a label despite the low confidence"


def test_instances_file_without_calibration_uses_confidence(tmp_path: Path) -> None:
    (tmp_path / "instances.json").write_text(json.dumps([ENTRY]))  # as written by older versions
    (one,) = read_instances(tmp_path / "instances.json")
    assert (one.exists, one.existence, one.probabilities) == (None, 0.5, (0.5, 0.75))
