"""Tests for the decoding of candidates in every layout, compared with a slow reference."""

import math

import numpy as np
import pytest

from framework.detection.candidates import Candidates, OutputLayout, decode
from framework.errors import DataError

CLASSES = 3
SHAPE = (64, 96)  # height and width of the input, px


def yolox_output(rng):
    cells = 8 * 12 + 4 * 6 + 2 * 3
    return np.concatenate([rng.normal(0, 1, (1, cells, 4)), rng.random((1, cells, 1 + CLASSES))], axis=2).astype("f4")


def test_decode_yolox_matches_reference():
    output = yolox_output(np.random.default_rng(0))
    found = decode(OutputLayout.yolox, {"output": output}, SHAPE, CLASSES)
    k = 0
    for stride in (8, 16, 32):
        for gy in range(SHAPE[0] // stride):
            for gx in range(SHAPE[1] // stride):
                tx, ty, tw, th, objectness, *scores = output[0, k].tolist()
                x, y, w, h = (tx + gx) * stride, (ty + gy) * stride, math.exp(tw) * stride, math.exp(th) * stride
                expected = [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
                np.testing.assert_allclose(found.boxes[k], expected, rtol=1e-5, atol=1e-4)
                np.testing.assert_allclose(found.class_scores[k], [objectness * s for s in scores], rtol=1e-6)
                k += 1
    assert k == len(found.boxes)


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.parametrize(("layout", "objectness"), [(OutputLayout.yolo, False), (OutputLayout.yolo_objectness, True)])
def test_decode_yolo_matches_reference(layout, objectness, transposed, batch):
    rng = np.random.default_rng(1)
    rows = np.concatenate([rng.random((20, 4)) * 50, rng.random((20, CLASSES + objectness))], axis=1).astype("f4")
    output = rows.T if transposed else rows
    found = decode(layout, {"output0": output[None] if batch else output}, SHAPE, CLASSES)
    for row, box, scores in zip(rows.tolist(), found.boxes, found.class_scores, strict=True):
        x, y, w, h = row[:4]
        np.testing.assert_allclose(box, [x - w / 2, y - h / 2, x + w / 2, y + h / 2], rtol=1e-5, atol=1e-5)
        expected = [row[4] * s for s in row[5:]] if objectness else row[4:]
        np.testing.assert_allclose(scores, expected, rtol=1e-6)


SSD_BOXES = np.array([[0.1, 0.2, 0.5, 0.6], [0.0, 0.25, 1.0, 0.75]], np.float32)
SSD_PIXELS = {
    OutputLayout.ssd_tensorflow: [[19.2, 6.4, 57.6, 32], [24, 0, 72, 64]],  # y1 x1 y2 x2
    OutputLayout.ssd_unit: [[9.6, 12.8, 48, 38.4], [0, 16, 96, 48]],
    OutputLayout.ssd_torchvision: [[0.1, 0.2, 0.5, 0.6], [0.0, 0.25, 1.0, 0.75]],
}


@pytest.mark.parametrize("layout", SSD_PIXELS)
@pytest.mark.parametrize("batch", [False, True])
def test_decode_ssd_with_labels_matches_reference(layout, batch):
    outputs = {"labels": np.array([2, 3], "f4"), "scores": np.array([0.8, 0.3], "f4"), "boxes": SSD_BOXES}
    found = decode(layout, {n: a[None] if batch else a for n, a in outputs.items()}, SHAPE, CLASSES)
    np.testing.assert_allclose(found.boxes, SSD_PIXELS[layout], atol=1e-5)
    np.testing.assert_allclose(found.class_scores, [[0.1, 0.8, 0.1], [0.3, 0.3, 0.3]], atol=1e-6)


def test_decode_ssd_tensorflow_skips_padding_and_background():
    outputs = {
        "detection_anchor_indices": np.zeros((1, 4)),
        "detection_boxes": np.zeros((1, 4, 4)),
        "detection_classes": np.array([[1, 3, 0, 1]]),
        "detection_scores": np.array([[0.9, 0.5, 0.7, 0.0]]),
        "num_detections": np.array([2]),
        "raw_detection_boxes": np.ones((1, 50, 4)),
        "raw_detection_scores": np.ones((1, 50, 4)),
    }
    outputs = {name: value.astype(np.float32) for name, value in outputs.items()}
    found = decode(OutputLayout.ssd_tensorflow, outputs, SHAPE, CLASSES)
    expected = [[0.9, 0.05, 0.05], [0.25, 0.25, 0.5], [0, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(found.class_scores, expected, atol=1e-6)
    by_class = np.random.default_rng(2).random((1, 4, 1 + CLASSES)).astype(np.float32)
    found = decode(OutputLayout.ssd_tensorflow, {**outputs, "detection_multiclass_scores": by_class}, SHAPE, CLASSES)
    np.testing.assert_array_equal(found.class_scores, by_class[0, :, 1:])


@pytest.mark.parametrize("background", [0, 1])
def test_decode_ssd_class_scores_drop_background(background):
    scores = np.random.default_rng(3).random((1, 2, CLASSES + background)).astype(np.float32)
    found = decode(OutputLayout.ssd_unit, {"scores": scores, "boxes": SSD_BOXES[None]}, SHAPE, CLASSES)
    np.testing.assert_array_equal(found.class_scores, scores[0, :, background:])


def test_decode_ssd_without_detections_is_empty():
    outputs = {"boxes": np.zeros((0, 4), "f4"), "labels": np.zeros(0, "f4"), "scores": np.zeros(0, "f4")}
    found = decode(OutputLayout.ssd_torchvision, outputs, SHAPE, CLASSES)
    assert (found.boxes.shape, found.class_scores.shape) == ((0, 4), (0, CLASSES))
    assert found.best(0.1, 0.5, 10).tolist() == []


@pytest.mark.parametrize(
    ("layout", "outputs", "message"),
    [
        (
            OutputLayout.yolo,
            {"y": np.zeros((1, 20, 8))},
            r"expected 7 columns .*\(1, 20, 8\); .* detector.layout=yolo_objectness$",
        ),
        (
            OutputLayout.yolo_objectness,
            {"y": np.zeros((1, 7, 20))},
            r"expected 8 columns .*\(1, 7, 20\); .* detector.layout=yolo$",
        ),
        (
            OutputLayout.yolox,
            {"y": np.zeros((1, 20, 8))},
            r"detector\.layout: expected 126 candidates of a YOLOX with input .*, got 20",
        ),
        (
            OutputLayout.yolo,
            {"y": np.zeros((1, 9, 7)), "z": np.zeros(2)},
            r"detector\.layout: expected one output, got",
        ),
        (OutputLayout.yolo, {"y": np.full((1, 9, 7), 3.0)}, "expected scores in .*, got 3 to 3"),
        (
            OutputLayout.ssd_unit,
            {"boxes": np.zeros((9, 4))},
            r"detector\.layout: expected boxes \(K, 4\) with scores .*, got boxes \(9, 4\)",
        ),
        (
            OutputLayout.ssd_unit,
            {"boxes": np.zeros((2, 4)), "labels": np.array([4, 1]), "scores": np.ones(2)},
            r"detector\.category_ids: expected labels 1 to 3 of 3 classes, got 4",
        ),
    ],
)
def test_decode_mismatched_outputs_raise(layout, outputs, message):
    with pytest.raises(DataError, match=message) as refused:
        decode(layout, {name: value.astype(np.float32) for name, value in outputs.items()}, SHAPE, CLASSES)
    assert "\n" not in str(refused.value)


def test_best_candidates_are_selected_by_class_and_threshold():
    boxes = np.array(
        [[0, 0, 10, 10], [1, 0, 10, 10], [0, 0, 10, 9], [20, 20, 30, 30], [9, 9, 5, 5], [0, 0, 1, 1]], "f4"
    )
    scores = np.array([[0.5, 0.1], [0.9, 0.1], [0.2, 0.6], [0.3, 0.1], [1.0, 0.0], [0.05, 0.2]], "f4")
    candidates = Candidates(boxes, scores)
    # 1 suppresses 0, the area of 4 is zero, and the score of 5 is too low
    assert candidates.best(0.25, 0.5, 10).tolist() == [1, 2, 3]
    assert candidates.best(0.25, 0.95, 10).tolist() == [1, 2, 0, 3]
    assert candidates.best(0.25, 0.95, 2).tolist() == [1, 2]
