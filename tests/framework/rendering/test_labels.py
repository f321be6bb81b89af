"""Tests for the placement of labels. Labels must be on large objects or next to small ones, without overlap."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from PIL import Image

from framework.rendering.labels import MIN_PIXELS, Label, _box, draw_labels, place_labels
from framework.rendering.overview import LABEL_PX, _font


def size(text: str) -> tuple[float, float]:
    return 9.0 * len(text), 17.0


def placed(labels: list[Label]) -> dict[str, Label]:
    return {label.text: label for label in labels}


def test_labels_are_on_large_and_next_to_small_objects() -> None:
    ids = np.zeros((300, 400), np.int32)
    ids[50:250, 20:220] = 1
    ids[50:250, 20:100] = 0  # the free part of the table is 120 px wide and centered at 159.5 px
    ids[150:160, 300:312] = 2
    labels = placed(place_labels(ids, {1: "table", 2: "cup", 3: "not in view"}, size))
    assert set(labels) == {"table", "cup"}
    assert labels["table"].target is None
    assert labels["table"].u == pytest.approx(159.5, abs=1)
    assert labels["cup"].target == pytest.approx((305.5, 154.5), abs=1)
    assert abs(labels["cup"].u - 305.5) + abs(labels["cup"].v - 154.5) > 20
    left, top, right, bottom = (round(x) for x in _box(labels["cup"].u, labels["cup"].v, *size("cup")))
    assert not ids[top:bottom, left:right].any()


def test_label_of_large_object_does_not_cover_other_objects() -> None:
    ids = np.zeros((400, 400), np.int32)
    ids[100:300, 100:300] = 1
    ids[150:160, 195:205] = 2
    assert placed(place_labels(ids, {1: "dining table", 2: "cup"}, size))["dining table"].target is None
    ids[190:210, 120:180] = 3  # the gap between 3 and 4 is 40 px wide; the label of the table needs 108 px
    ids[190:210, 220:280] = 4
    label = placed(place_labels(ids, {1: "dining table", 2: "cup", 3: "book", 4: "tray"}, size))["dining table"]
    left, top, right, bottom = (round(x) for x in _box(label.u, label.v, *size("dining table")))
    assert (ids[top:bottom, left:right] > 1).mean() <= 0.1


@pytest.mark.parametrize("seed", range(5))
def test_labels_of_many_objects_stay_inside_without_overlap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ids = np.zeros((500, 600), np.int32)
    for key in range(1, 31):
        v, u, side = rng.integers(0, 460), rng.integers(0, 560), rng.integers(10, 40)
        ids[v : v + side, u : u + side] = key
    names = {key: f"thing {key}" for key in range(1, 31)}
    labels = place_labels(ids, names, size)
    shown = [key for key in names if (ids == key).sum() >= MIN_PIXELS]
    assert len(labels) >= 0.9 * len(shown)
    boxes = [_box(label.u, label.v, *size(label.text)) for label in labels]
    for a, b in combinations(boxes, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
    for left, top, right, bottom in boxes:
        assert 0 <= left <= right <= 599
        assert 0 <= top <= bottom <= 499
    for label in labels:
        if label.target is not None:
            u, v = (round(x) for x in label.target)
            assert names[int(ids[v, u])] == label.text, "expected a line that ends on the object"


def test_place_labels_without_placeable_names_is_empty() -> None:
    assert place_labels(np.zeros((20, 30), np.int32), {}, size) == []
    assert place_labels(np.zeros((20, 30), np.int32), {4: "chair"}, size) == []
    ids = np.full((20, 30), 4, np.int32)
    assert place_labels(ids, {4: "a name that is wider than the picture"}, size) == []


def test_draw_labels_connects_label_to_object() -> None:
    image = Image.new("RGB", (300, 100), "red")
    draw_labels(image, [Label("cup", 60.0, 50.0, (200.0, 50.0))], _font(LABEL_PX))
    drawn = (np.asarray(image) != (255, 0, 0)).any(axis=2)
    assert drawn[50, 90:200].all()
    assert not drawn[20].any()
    assert not drawn[:, 210:].any()
