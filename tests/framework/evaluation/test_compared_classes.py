"""Tests for label spaces of the evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.config.composition import composed, resolved
from framework.data import AnnotatedObjects, SceneTruth
from framework.errors import ConfigError
from framework.evaluation.compared_classes import OUTSIDE, ComparedClasses, listed
from framework.evaluation.instances import PredictedInstances, evaluate


def classes_in(label_space: str | None, **names: str | None) -> ComparedClasses:
    return ComparedClasses.of({"evaluation": {"label_space": label_space, "names": names}})


def predictions_of(*names: str) -> PredictedInstances:
    """Return one instance of 200 points for each name, side by side."""
    ids = np.repeat(np.arange(1, len(names) + 1), 200).astype(np.int32)
    points = np.zeros((len(ids), 3), np.float32)
    points[:, 0] = np.arange(len(ids))
    return PredictedInstances(points, ids, np.arange(1, len(names) + 1), np.ones(len(names)), names)


def truth_of(*names: str | None, annotated: AnnotatedObjects | None = None, **changes: Any) -> SceneTruth:
    found = predictions_of(*["" for _ in names])
    return SceneTruth(
        found.points_world, found.instance_ids, dict(enumerate(names, start=1)), annotated=annotated, **changes
    )


@pytest.mark.parametrize(
    ("label_space", "name", "expected"),
    [
        ("nyu40", "couch", "sofa"),
        ("nyu40", "Sofa", "sofa"),
        ("nyu40", "tv", "television"),
        ("nyu40", "laptop", None),
        ("scannet20", "television", None),
        ("scannet200", "dining table", "dining table"),
        ("scannet200", "teddy bear", "stuffed animal"),
        ("scannet200", "handbag", "purse"),
        ("coco", "sofa", "couch"),
        ("coco", "wall", None),
        ("agnostic", "forklift", "object"),
        (None, "forklift", "forklift"),
    ],
)
def test_name_becomes_class_of_label_space(label_space: str | None, name: str, expected: str | None) -> None:
    assert classes_in(label_space).class_of(name) == expected


def test_names_in_config_take_precedence() -> None:
    classes = classes_in("scannet200", **{"dining table": "table", "cup": None})
    assert classes.class_of("dining table") == "table"
    assert classes.class_of("cup") is None
    assert classes.class_of("bowl") == "bowl"
    assert classes_in(None, desk="table").class_of("desk") == "table"


def test_label_space_of_file_has_its_names(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("forklift\nseat\n")
    classes = classes_in(str(tmp_path / "names.txt"))
    assert [classes.class_of(name) for name in ("forklift", "chair", "pallet")] == ["forklift", "seat", None]


@pytest.mark.parametrize(
    ("block", "error"),
    [
        ({"label_space": "nyu"}, "evaluation.label_space: expected one of coco, .*, agnostic, or a text file"),
        ({"names": "chair"}, "evaluation.names: expected the class of each name, got 'chair'"),
        ({"names": {"chair": 3}}, "evaluation.names: expected a class or null for each name"),
        ({"label_space": "coco", "names": {"sofa": "sofa"}}, "expected classes of coco, got 'sofa'"),
    ],
)
def test_invalid_label_space_of_evaluation_is_error(block: dict[str, Any], error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        ComparedClasses.of({"evaluation": block})


def test_evaluation_without_label_space_changes_nothing() -> None:
    truth, predictions = truth_of("chair", None), predictions_of("chair", "laptop")
    compared = ComparedClasses.of({}).compare(predictions, truth)
    assert evaluate(compared.predictions, compared.truth).metrics() == evaluate(predictions, truth).metrics()
    assert not compared.ignored_predictions
    assert not compared.ignored_truths


def test_objects_outside_of_label_space_are_ignored() -> None:
    truth = truth_of("sofa", "lamp", "laptop", None, "wall")
    compared = classes_in("scannet20").compare(predictions_of("couch", "laptop", "laptop", "tv", "bed"), truth)
    assert compared.predictions.class_names == ("sofa", OUTSIDE, OUTSIDE, OUTSIDE, "bed")
    assert compared.truth.class_names == {1: "sofa", 2: None, 3: None, 4: None}
    assert listed(compared.ignored_predictions) == "laptop (2), tv (1)"
    assert compared.ignored_truths == {"lamp": 1, "laptop": 1}
    found = evaluate(compared.predictions, compared.truth)
    assert found.overall is not None
    assert (found.overall.true_positives, found.overall.false_positives, found.overall.ignored) == (1, 1, 3)
    points = np.bincount(compared.true_classes + 1).tolist()
    assert points[:2] == [600, 200]  # no class, and the wall, which is no instance but has a class


def test_annotated_names_are_used_except_in_coco() -> None:
    ids = np.repeat([1, 2, 3], 200).astype(np.int32)
    own = {1: "office chair", 2: "cabinet", 3: None}
    annotated = AnnotatedObjects(ids, own, {"nyu40": {1: "chair", 2: "cabinet"}})
    truth = truth_of("chair", None, None, annotated=annotated)
    predictions = predictions_of("chair", "bed", "bed")
    in_space = {
        space: classes_in(space).compare(predictions, truth).truth.class_names
        for space in (None, "coco", "nyu40", "scannet200", "agnostic")
    }
    assert in_space[None] == in_space["coco"] == {1: "chair", 2: None, 3: None}
    assert in_space["nyu40"] == {1: "chair", 2: "cabinet", 3: None}
    assert in_space["scannet200"] == {1: "office chair", 2: "cabinet", 3: None}
    assert in_space["agnostic"] == {1: "object", 2: "object", 3: None}


def test_annotated_classes_of_dataset_are_converted() -> None:
    truth = truth_of("couch", None, classes=("couch", "tv", "cup"))
    found = classes_in("nyu40").compare(predictions_of("couch", "bed"), truth).truth
    assert found.classes == ("sofa", "television")
    assert classes_in(None).compare(predictions_of("couch", "bed"), truth).truth.classes == ("couch", "tv", "cup")
    assert classes_in("nyu40").compare(predictions_of("a", "b"), truth_of("couch", None)).truth.classes is not None


def test_long_list_of_ignored_names_is_shortened() -> None:
    assert listed({f"name {k:02d}": 1 for k in range(14)}).endswith("name 11 (1) and 2 more")
    assert listed({}) == ""


def test_names_of_config_are_read_from_overrides() -> None:
    config = composed("evaluation.label_space=scannet200", "evaluation.names={dining table: table, cup: null}")
    classes = ComparedClasses.of(resolved(config))
    assert classes.label_space == "scannet200"
    assert classes.names == {"dining table": "table", "cup": None}


def test_label_space_of_json_file_has_its_names(tmp_path: Path) -> None:
    (tmp_path / "names.json").write_text('{"20": "chair", "80": "table"}')
    assert classes_in(str(tmp_path / "names.json")).classes == ("chair", "table")


def test_names_that_differ_in_case_or_synonyms_stay_apart(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("Cup\ncup\nshelf, big\nshelf, small\nn/a\n")
    classes = classes_in(str(tmp_path / "names.txt"))
    assert classes.classes == ("Cup", "cup", "shelf, big", "shelf, small")
    assert [classes.class_of(name) for name in classes.classes] == list(classes.classes)


def test_walls_and_floors_are_background_after_conversion() -> None:
    truth = truth_of("Wall", "carpet", "chair")
    for space, names, found_as in (("nyu40", {"carpet": "floor"}, "floor"), ("agnostic", {}, "carpet")):
        compared = classes_in(space, **names).compare(predictions_of("wall", found_as, "chair"), truth)
        found = evaluate(compared.predictions, compared.truth)
        assert "floor" not in found.by_class[0.5]
        assert "wall" not in found.by_class[0.5]
        assert found.ap(0.5) == 1.0


def test_annotated_name_in_config_takes_precedence_over_label_space() -> None:
    ids = np.repeat([1, 2, 3], 200).astype(np.int32)
    own = {1: "office chair", 2: "ping pong set", 3: "gizmo"}
    annotated = AnnotatedObjects(ids, own, {"nyu40": {1: "chair"}})
    truth = truth_of("chair", None, None, annotated=annotated)
    classes = classes_in("nyu40", **{"office chair": "sofa", "ping pong set": "table"})
    compared = classes.compare(predictions_of("chair", "bed", "bed"), truth)
    assert compared.truth.class_names == {1: "sofa", 2: "table", 3: None}
    assert compared.ignored_truths == {"gizmo": 1}
