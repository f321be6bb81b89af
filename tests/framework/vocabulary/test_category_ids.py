"""Tests for the recognition of class numberings."""

from __future__ import annotations

import logging

import pytest

from framework.errors import ConfigError, DataError
from framework.vocabulary.category_ids import CategoryIds, column_ids, label_ids, recognize
from framework.vocabulary.label_spaces import COCO, COCO_BY_ID, NO_CLASS, SPACES

OWN = ("forklift", "pallet", "crate")
DARKNET = tuple({"couch": "sofa", "tv": "tvmonitor", "airplane": "aeroplane"}.get(name, name) for name in COCO)
WITH_BACKGROUND = (NO_CLASS, *OWN)
SCANNET20 = SPACES["scannet20"]


@pytest.mark.parametrize(
    ("ids", "labels", "numbering"),
    [
        ([62, 84], COCO, CategoryIds.COCO_91),  # above 80
        ([90], COCO, CategoryIds.COCO_91),
        ([0, 56], COCO, CategoryIds.FROM_ZERO),
        ([56, 0, 12], COCO, CategoryIds.FROM_ZERO),
        ([12, 80], COCO, CategoryIds.FROM_ONE),  # a gap of COCO's ids, and one more than the last index
        ([0, 2], OWN, CategoryIds.FROM_ZERO),
        ([1, 3], OWN, CategoryIds.FROM_ONE),
        ([1, 2], WITH_BACKGROUND, CategoryIds.FROM_ZERO),
        ([62], COCO_BY_ID, CategoryIds.FROM_ZERO),  # a label file with all ids
        ([1], ("forklift",), CategoryIds.FROM_ONE),
        ([0], ("forklift",), CategoryIds.FROM_ZERO),
        ([90], DARKNET, CategoryIds.COCO_91),
        ([5, 39], SCANNET20, CategoryIds.SCANNET),
        ([20, 5], SCANNET20, CategoryIds.FROM_ONE),
        ([2, 1191], SPACES["scannet200"], CategoryIds.SCANNET),
    ],
)
def test_recognize_certain_ids_log_example(
    ids: list[int], labels: tuple[str, ...], numbering: CategoryIds, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        assert recognize("a.json", ids, labels) is numbering
    [record] = caplog.records
    assert record.levelname == "INFO"
    assert f"a.json: class ids read as {numbering.name}, so {ids[0]} is" in record.getMessage()


@pytest.mark.parametrize("ids", [[56], [41, 56, 62, 73], [1], [79, 80], [62, 63, 72]])
def test_recognize_ids_of_all_numberings_are_coco_with_warning(
    ids: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    assert recognize("a.json", ids, COCO) is CategoryIds.COCO_91
    [record] = caplog.records
    assert record.levelname == "WARNING"
    assert "set detector.category_ids=FROM_" in record.getMessage()
    assert "detector.category_ids=COCO_91 to confirm" in record.getMessage()


def test_recognize_ambiguous_coco_ids_show_both_names(caplog: pytest.LogCaptureFixture) -> None:
    recognize("a.json", [56], COCO)
    assert "56 is 'broccoli', but it could be 'cake' by FROM_ONE or 'chair' by FROM_ZERO" in caplog.text


@pytest.mark.parametrize(
    ("ids", "labels", "first"),
    [
        ([12, 56], COCO, "12"),
        ([26], COCO, "26"),
        ([45, 68], COCO, "45"),
        ([1], OWN, "1"),
        ([2, 1], OWN, "2"),
        ([5], SCANNET20, "5"),
    ],
)
def test_recognize_ambiguous_ids_raise_with_settings(ids: list[int], labels: tuple[str, ...], first: str) -> None:
    with pytest.raises(ConfigError, match=rf"where {first} is .*set detector\.category_ids=.* or det.*=FROM_ZERO"):
        recognize("a.json", ids, labels)


@pytest.mark.parametrize(
    ("ids", "labels"),
    [([91], COCO), ([0, 85], COCO), ([-1], COCO), ([0, 3], OWN), ([7], OWN), ([0, 1], WITH_BACKGROUND)],
)
def test_recognize_ids_of_no_numbering_raise(ids: list[int], labels: tuple[str, ...]) -> None:
    with pytest.raises(DataError, match=r"category_id: expected the ids of .*set detector\.label_space"):
        recognize("a.json", ids, labels)


def test_recognize_named_ids_decide() -> None:
    assert recognize("a.json", [57], COCO, [(56, "chair")]) is CategoryIds.FROM_ZERO
    assert recognize("a.json", [57], COCO, [(57, "chair")]) is CategoryIds.FROM_ONE
    assert recognize("a.json", [57], COCO, [(62, "chair")]) is CategoryIds.COCO_91


@pytest.mark.parametrize(
    ("labels", "published", "name", "number"),
    [
        (COCO, CategoryIds.COCO_91, "chair", 62),
        (DARKNET, CategoryIds.COCO_91, "sofa", 63),
        (COCO_BY_ID, CategoryIds.COCO_91, "chair", 62),  # torchvision's list, with the background and unused ids
        ((NO_CLASS, *COCO), CategoryIds.COCO_91, "chair", 57),
        (OWN, CategoryIds.COCO_91, "forklift", 1),
        (WITH_BACKGROUND, CategoryIds.COCO_91, "forklift", 1),
        (OWN, CategoryIds.FROM_ZERO, "forklift", 0),
    ],
)
def test_label_ids_of_published_network_fit_labels(
    labels: tuple[str, ...], published: CategoryIds, name: str, number: int
) -> None:
    assert label_ids(CategoryIds.AUTO, labels, published)[labels.index(name)] == number


@pytest.mark.parametrize(
    ("labels", "columns", "name", "column"),
    [
        (DARKNET, 91, "sofa", 63),
        (DARKNET, 90, "sofa", 62),
        (DARKNET, 80, "sofa", 57),
        (COCO_BY_ID, 91, "chair", 62),
        (WITH_BACKGROUND, 4, "pallet", 2),
    ],
)
def test_column_ids_follow_labels(labels: tuple[str, ...], columns: int, name: str, column: int) -> None:
    assert column_ids(CategoryIds.AUTO, labels, columns)[labels.index(name)] == column
