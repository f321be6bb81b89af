"""Tests for the detection of output layouts from shapes and values."""

import numpy as np
import pytest

from framework.detection.runtimes.onnx_network import ExportMetadata
from framework.detection.segmentation_output import BoxKind, detect_layout
from framework.errors import DataError

SHAPE = (64, 96)  # height and width of the input, px
CLASSES, MASKS = 3, 4
ULTRALYTICS = ExportMetadata(author="Ultralytics")


def cells():
    """Return the boxes (K, 4), px, of all cells with the strides 8, 16 and 32, as center and size."""
    rng = np.random.default_rng(0)
    rows = []
    for stride in (8, 16, 32):
        y, x = np.indices((SHAPE[0] // stride, SHAPE[1] // stride)).reshape(2, -1)
        rows.append(np.stack([stride * (x + 0.5), stride * (y + 0.5), *rng.uniform(4, 24, (2, len(x)))], axis=1))
    return np.concatenate(rows)


def as_corners(boxes):
    return np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)


def as_unit(boxes):
    return boxes / [*SHAPE[::-1], *SHAPE[::-1]]


def dense(boxes, classes=CLASSES, objectness=False):
    """Return an output (1, 4 + C + M, K) with one column per cell: box, class scores and mask coefficients."""
    rng = np.random.default_rng(1)
    numbers = classes + MASKS + objectness
    return np.concatenate([boxes, rng.uniform(1e-6, 0.1, (len(boxes), numbers))], axis=1).T[None].astype(np.float32)


def detections(boxes, score, label):
    """Return an output (1, K, 6 + M) after suppression with box, score, label and mask coefficients."""
    rest = np.full((len(boxes), MASKS), 0.5)
    return np.concatenate([boxes, np.full((len(boxes), 1), score), np.full((len(boxes), 1), label), rest], 1)[None]


def prototypes(channels_last=False):
    maps = np.arange(MASKS * 16 * 24, dtype=np.float32).reshape(1, MASKS, 16, 24)
    return np.moveaxis(maps, 1, -1) if channels_last else maps


def seen(table, maps=None, **given):
    """Return the detected layout and the outputs that are read with this layout."""
    outputs = {"output0": np.asarray(table, np.float32), "output1": prototypes() if maps is None else maps}
    arguments = {
        "classes": CLASSES,
        "objectness": False,
        "boxes": BoxKind.AUTO,
        "shape": SHAPE,
        "input_channels_last": False,
        "metadata": ExportMetadata(),
        **given,
    }
    layout = detect_layout(outputs, **arguments)
    return layout, layout.read(outputs)


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize("corner", [False, True])
@pytest.mark.parametrize("unit", [False, True])
@pytest.mark.parametrize("objectness", [False, True])
def test_detect_layout_cells_in_any_layout_give_same_boxes(channels_last, transpose, corner, unit, objectness):
    boxes = as_corners(cells()) if corner else cells()
    table = dense(as_unit(boxes) if unit else boxes, objectness=objectness)
    layout, output = seen(
        table.transpose(0, 2, 1) if transpose else table, prototypes(channels_last), objectness=objectness
    )
    assert layout.boxes is (BoxKind.CORNER if corner else BoxKind.CENTER)
    assert (layout.unit, layout.channels_last, layout.rows_first) == (unit, channels_last, transpose)
    assert not layout.suppressed
    np.testing.assert_allclose(output.candidates.boxes, as_corners(cells()), atol=1e-3)
    np.testing.assert_array_equal(output.prototypes, prototypes()[0])
    scores = table[0, 4:5].T * table[0, 5:8].T if objectness else table[0, 4:7].T
    np.testing.assert_array_equal(output.candidates.class_scores, scores)
    np.testing.assert_array_equal(output.coefficients, table[0, -MASKS:].T)


@pytest.mark.parametrize("unit", [False, True])
@pytest.mark.parametrize("count", [1, 40])
def test_detect_layout_detections_have_one_class_each(unit, count):
    boxes = as_corners(cells())[50 : 50 + count]
    layout, output = seen(detections(as_unit(boxes) if unit else boxes, 0.7, 2))
    assert layout.suppressed
    assert layout.unit == unit
    np.testing.assert_allclose(output.candidates.boxes, boxes, atol=1e-3)
    np.testing.assert_allclose(output.candidates.class_scores, np.tile([0, 0, 0.7], (count, 1)), rtol=1e-6)


@pytest.mark.parametrize("count", [0, 30])
def test_detect_layout_without_detections_defers_box_unit(count):
    """An output after suppression has no rows, or rows of zeros."""
    layout, output = seen(np.zeros((1, count, 6 + MASKS)))
    assert layout.suppressed
    assert layout.unit is None
    assert output.candidates.class_scores.sum() == 0
    boxes = as_corners(cells())[60:61]
    for given in (boxes, as_unit(boxes)):
        table = np.concatenate([detections(given, 0.9, 1), np.zeros((1, 3, 6 + MASKS))], axis=1)
        later = layout.read({"output0": np.asarray(table, np.float32), "output1": prototypes()})
        np.testing.assert_allclose(later.candidates.boxes[:1], boxes, atol=1e-3)


def test_detect_layout_inverted_corners_raise():
    boxes = cells()[50:53]
    with pytest.raises(
        DataError,
        match=r"detector\.box_format: expected corners with x1 <= x2 and y1 <= y2 in confident detections, got \[",
    ):
        seen(detections(boxes, 0.9, 1))
    _, output = seen(detections(boxes, 0.9, 1), boxes=BoxKind.CENTER)
    np.testing.assert_allclose(output.candidates.boxes, as_corners(boxes), atol=1e-4)
    layout, _ = seen(detections(cells(), 0.9, 1))  # the format is detected from a sufficient number of boxes
    assert layout.boxes is BoxKind.CENTER


def test_detect_layout_tables_of_equal_width_are_distinguished():
    """With two classes, both layouts have 6 + M columns."""
    layout, _ = seen(dense(cells(), classes=2).transpose(0, 2, 1), classes=2)
    assert not layout.suppressed
    layout, _ = seen(detections(as_corners(cells())[50:60], 0.7, 1), classes=2)
    assert layout.suppressed
    below = detections(as_corners(cells())[50:60], 0.0, 0)  # exports of TensorFlow keep boxes below the threshold
    layout, output = seen(below, classes=2)
    assert layout.suppressed
    assert output.candidates.class_scores.sum() == 0
    quantized = dense(cells(), classes=2)
    quantized[:, 4:6] = 0  # in 8 bits, small scores are rounded to 0
    layout, _ = seen(quantized.transpose(0, 2, 1), classes=2)
    assert not layout.suppressed


def test_detect_layout_given_box_format_is_kept():
    layout, output = seen(dense(as_corners(cells())), boxes=BoxKind.CENTER)
    assert layout.boxes is BoxKind.CENTER
    np.testing.assert_allclose(output.candidates.boxes, as_corners(as_corners(cells())), atol=1e-3)


def test_detect_layout_ambiguous_prototype_axes_raise():
    square = {"shape": (16, 16), "maps": np.zeros((1, 4, 4, 4), np.float32)}
    boxes = cells() / 6
    with pytest.raises(
        DataError, match=r"expected prototypes \(1, M, h, w\) or \(1, h, w, M\), got .* ambiguous order of axes"
    ):
        seen(dense(boxes), **square)
    assert not seen(dense(boxes), **square, metadata=ULTRALYTICS)[0].channels_last
    assert seen(dense(boxes), **square, metadata=ULTRALYTICS, input_channels_last=True)[0].channels_last


MIXED = np.where((np.arange(126) % 3 > 0)[:, None], as_corners(cells()), cells())


@pytest.mark.parametrize(
    ("table", "given", "message"),
    [
        (dense(MIXED), {}, r"got ambiguous boxes \(.* could be corners\); set detector\.box_format=CENTER or CORNER"),
        (dense(cells() / 8), {}, r"detector\.weights: expected boxes in px of the input 96x64 or in 0\.\.1"),
        (dense(cells(), objectness=True), {}, r"11 columns .* shape \(1, 12, 126\); set detector.objectness=true"),
        (dense(cells()), {"objectness": True}, r"12 columns .* \(1, 11, 126\); set detector.objectness=false"),
        (dense(cells(), classes=7), {}, r"11 columns .* or 10 with suppression .*another detector\.label_space"),
        (detections(as_corners(cells()), 0.9, 3), {}, r"label_space: expected integer labels 0 to 2 .*, got 3 to 3"),
        (detections(as_corners(cells()), 1.5, 1), {}, r"detector\.weights: expected scores in \[0, 1\], got 0 to 1\.5"),
        (np.zeros((1, 11, 11)), {}, "expected different numbers of candidates and columns, got 11 for both"),
        (dense(cells()), {"maps": np.zeros((1, 4, 16, 16))}, r"= 64:96, got .*16, 16\) with another aspect ratio"),
        (dense(cells())[0], {}, r"expected two outputs, .*, got output0 \(11, 126\)"),
    ],
)  # fmt: skip
def test_detect_layout_ambiguous_outputs_raise(table, given, message):
    with pytest.raises(DataError, match=message) as refused:
        seen(table, **given)
    assert "\n" not in str(refused.value)
