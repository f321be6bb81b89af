"""Decoding of the outputs of common box detectors, and selection of the best boxes.

A box is x1 y1 x2 y2 in px of the network's input. The left border of the first pixel is at 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from framework.config.validation import require
from framework.data import Float32, Int32
from framework.detection.masks.boxes import LARGEST_LOG_SCALE, suppress_boxes
from framework.detection.masks.letterbox import ImageFormat, Placement
from framework.errors import DataError
from framework.vocabulary.category_ids import CategoryIds, column_ids, label_ids
from framework.vocabulary.label_spaces import COCO, COCO_BY_ID, NO_CLASS

CONFIDENT = 0.5  # minimum score of detections that must have valid boxes and labels
MIN_CANDIDATES = 20  # minimum number of candidates to find the column of the background
MIN_BACKGROUND = 0.5  # minimum fraction of candidates without an object in a black image, typically above 0.9
LARGEST_UNIT = 2.0  # boxes in 0..1 may slightly exceed the image; boxes in px are never all within 2 px of its corner
YOLOX_STRIDES = (8, 16, 32)  # px per cell, in the order of the output's rows


class OutputLayout(Enum):
    """Output format of a box detector with K candidates and C classes.

    Arrays may have a leading axis of length 1. In the SSD layouts, scores and labels have the shape (K,). Class scores
    have the shape (K, C), or (K, C + 1) with the background first.
    """

    yolox = "yolox"  # (K, 5 + C): center offset dx, dy and log w, log h, in cells; objectness; C class scores
    yolo = "yolo"  # (4 + C, K) or (K, 4 + C): center x, y, width, height in px; C class scores (Ultralytics, from v8)
    yolo_objectness = "yolo_objectness"  # (K, 5 + C) or (5 + C, K): as yolo, with objectness before the class scores
    ssd_tensorflow = "ssd_tensorflow"  # boxes (K, 4) y1 x1 y2 x2 in 0..1; scores and labels, or class scores
    ssd_torchvision = "ssd_torchvision"  # boxes (K, 4) x1 y1 x2 y2 in px; scores and labels, or class scores
    ssd_unit = "ssd_unit"  # boxes (K, 4) x1 y1 x2 y2 in 0..1; scores and labels, or class scores
    end_to_end = "end_to_end"  # (K, 6): x1 y1 x2 y2 in px or 0..1, score, label from 0 (YOLOv10, YOLO26)
    label_first = "label_first"  # (K, 6): label from 0, score, x1 y1 x2 y2 in px (PaddleDetection)
    image_first = "image_first"  # (K, 7): index of the image, x1 y1 x2 y2 in px, label from 0, score (YOLOv7)
    yolo_nas = "yolo_nas"  # (K, 7): index of the image, x1 y1 x2 y2 in px, score, label from 0 (flat format)
    efficientdet = "efficientdet"  # (K, 7): index of the image, y1 x1 y2 x2 in px, score, label (automl)
    auto = "auto"  # the layout of a recognized network


# numbering of published networks; other networks with ssd_unit count from 0 or from 1, with or without gaps
PUBLISHED_IDS: Mapping[OutputLayout, CategoryIds | None] = {
    OutputLayout.ssd_tensorflow: CategoryIds.COCO_91,
    OutputLayout.ssd_torchvision: CategoryIds.COCO_91,
    OutputLayout.ssd_unit: None,
    OutputLayout.end_to_end: CategoryIds.FROM_ZERO,
    OutputLayout.label_first: CategoryIds.FROM_ZERO,
    OutputLayout.image_first: CategoryIds.FROM_ZERO,
    OutputLayout.yolo_nas: CategoryIds.FROM_ZERO,
    OutputLayout.efficientdet: CategoryIds.COCO_91,
}
YOLO_FORMAT = ImageFormat(Placement.center, bgr=False, black=0.0, white=1.0)  # as in Ultralytics' exports


@dataclass(frozen=True)
class RowColumns:
    """Columns of a table with one detection per row."""

    box: tuple[int, int, int, int]  # x1 y1 x2 y2
    score: int
    label: int
    count: int


ROW_COLUMNS: Mapping[OutputLayout, RowColumns] = {
    OutputLayout.end_to_end: RowColumns((0, 1, 2, 3), score=4, label=5, count=6),
    OutputLayout.label_first: RowColumns((2, 3, 4, 5), score=1, label=0, count=6),
    OutputLayout.image_first: RowColumns((1, 2, 3, 4), score=6, label=5, count=7),
    OutputLayout.yolo_nas: RowColumns((1, 2, 3, 4), score=5, label=6, count=7),
    OutputLayout.efficientdet: RowColumns((2, 1, 4, 3), score=5, label=6, count=7),
}
"""Layouts of networks with suppression and a single table."""


@dataclass(frozen=True)
class Candidates:
    """K candidate boxes with scores for C classes.

    The score of a candidate is its largest class score.
    """

    boxes: Float32  # (K, 4) px
    class_scores: Float32  # (K, C) in [0, 1], multiplied by the objectness, if any

    def best(self, threshold: float, nms: float, limit: int) -> Int32:
        """Select candidates by score and non-maximum suppression.

        Args:
            threshold: The minimum score.
            nms: The IoU above which the worse of two candidates of a class is removed.
            limit: The maximum number of candidates.

        Returns:
            The indices of the selected candidates, best first.
        """
        scores = self.class_scores.max(axis=1)
        x1, y1, x2, y2 = self.boxes.T
        chosen = np.flatnonzero((scores > threshold) & (x2 > x1) & (y2 > y1))
        label = self.class_scores[chosen].argmax(axis=1).astype(np.int32)
        kept = suppress_boxes(self.boxes[chosen], scores[chosen], nms, label, limit=limit, extent=0.0)
        return chosen[kept].astype(np.int32)


def decode(
    layout: OutputLayout,
    outputs: Mapping[str, Float32],
    shape: tuple[int, int],
    classes: int,
    ids: Sequence[int] | None = None,
) -> Candidates:
    """Decode the outputs of a network to candidate boxes.

    Args:
        layout: The output format of the network, except auto.
        outputs: The output arrays by name.
        shape: The size of the input (height, width), px.
        classes: The number of classes.
        ids: The label of each class in label outputs, or its column in class scores; None = 1 to `classes`, or 0 to
            `classes` - 1 for a single table.

    Raises:
        DataError: The outputs do not have this layout.
    """
    if layout in (OutputLayout.ssd_tensorflow, OutputLayout.ssd_torchvision, OutputLayout.ssd_unit):
        return _decode_ssd(layout, outputs, shape, classes, ids)
    output = single_table(outputs)
    if layout in ROW_COLUMNS:
        columns = ROW_COLUMNS[layout]
        rows = _rows(output, columns.count, "")
        class_scores = class_scores_of_labels(
            rows[:, columns.score], rows[:, columns.label], range(classes) if ids is None else ids
        )
        return Candidates(_in_px(rows[:, columns.box], shape), spread_evenly(class_scores))
    if layout is OutputLayout.yolo:
        rows = _rows(output, 4 + classes, "yolo_objectness")
        return _checked(corners(_in_px(rows[:, :4], shape)), rows[:, 4:])
    rows = _rows(output, 5 + classes, "yolo" if layout is OutputLayout.yolo_objectness else "")
    boxes = _in_px(rows[:, :4], shape) if layout is OutputLayout.yolo_objectness else _yolox_boxes(rows, shape)
    return _checked(corners(boxes), rows[:, 4:5] * rows[:, 5:])


def label_numbers(
    layout: OutputLayout, outputs: Mapping[str, Float32], labels: Sequence[str], ids: CategoryIds
) -> list[int] | None:
    """Return the label of each class in the label output of a network, or its column in class scores of an SSD.

    The result is None for other networks with class scores.

    Args:
        layout: The layout, except auto.
        outputs: The output arrays by name.
        labels: The class names.
        ids: The numbering; AUTO = that of published networks.

    Raises:
        ConfigError: The numbering is ambiguous, or does not match the labels.
    """
    by_class = _by_class(_tables(outputs), len(labels)) if layout not in ROW_COLUMNS else []
    if layout in PUBLISHED_IDS and not by_class:
        return label_ids(ids, labels, PUBLISHED_IDS[layout])
    if layout in PUBLISHED_IDS:
        table = by_class[0]
        if ids is CategoryIds.AUTO and table.shape[1] == len(labels) + 1:
            ids = CategoryIds.FROM_ZERO if ends_with_background(table) else CategoryIds.FROM_ONE
        return column_ids(ids, labels, table.shape[1])
    require(ids is CategoryIds.AUTO, "detector.category_ids", ids.name, "AUTO for a network without labels")
    return None


def _checked(boxes: Float32, class_scores: Float32) -> Candidates:
    check_scores(class_scores)
    return Candidates(boxes, class_scores)


def check_scores(class_scores: Float32, key: str = "detector.layout", fix: str = "choose another layout, or ") -> None:
    """Raise DataError unless all scores are in [0, 1].

    Scores are outside of this range if a network was exported without its sigmoid or softmax.

    Args:
        class_scores: The scores, of any shape.
        key: The config key at the beginning of the message.
        fix: The first part of the fix in the message.
    """
    if class_scores.size and (class_scores.min() < -1e-3 or class_scores.max() > 1 + 1e-3):
        raise DataError(
            f"{key}: expected scores in [0, 1], got {class_scores.min():.3g} to {class_scores.max():.3g}; {fix}export "
            "the network with its sigmoid or softmax"
        )


def described(outputs: Mapping[str, Float32]) -> str:
    """Format the names and shapes of network outputs for messages."""
    return ", ".join(f"{name} {array.shape}" for name, array in outputs.items())


def _rows(output: Float32, columns: int, other_layout: str) -> Float32:
    """Return the candidates as rows (K, columns), transposed if necessary."""
    table = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if table.ndim == 2 and table.shape[1] == columns:
        return table
    if table.ndim == 2 and table.shape[0] == columns:
        return table.T
    fix = f", or detector.layout={other_layout}" if other_layout else ""
    raise DataError(
        f"detector.label_space: expected {columns} columns for box and classes, got an output of shape {output.shape}; "
        f"set another label_space{fix}"
    )


def cell_counts(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the number of cells of a YOLO with the strides 8 to 32, and 8 to 64, for an input (height, width), px."""
    counts = [-(-shape[0] // stride) * -(-shape[1] // stride) for stride in (*YOLOX_STRIDES, 2 * YOLOX_STRIDES[-1])]
    return sum(counts[:3]), sum(counts)


def single_table(outputs: Mapping[str, Float32]) -> Float32:
    """Return the single output of a network, without numbers of detections.

    Raises:
        DataError: The network has several outputs.
    """
    tables = [array for array in outputs.values() if array.ndim > 1 and array.shape[-1] > 1]
    if len(tables) != 1 or any(array.size > 1 for array in outputs.values() if array.ndim == 1):
        raise DataError(f"detector.layout: expected one output, got {described(outputs)}; choose another layout")
    return tables[0]


def _in_px(boxes: Float32, shape: tuple[int, int]) -> Float32:
    """Return boxes (K, 4) in px of the input. Boxes in 0..1 are scaled."""
    unit = 0 < np.abs(boxes).max(initial=0) <= LARGEST_UNIT
    return boxes * np.array([shape[1], shape[0]] * 2, np.float32) if unit else boxes


def corners(boxes: Float32) -> Float32:
    """Convert boxes (N, 4) from center x, center y, width, height to x1 y1 x2 y2."""
    half = boxes[:, 2:] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def _yolox_boxes(rows: Float32, shape: tuple[int, int]) -> Float32:
    """Decode the boxes (K, 4) of a YOLOX output, as center x, center y, width and height in px.

    Source: Ge et al., "YOLOX", 2021; github.com/Megvii-BaseDetection/YOLOX, yolox/utils/demo_utils.py.
    """
    cells, strides = [], []
    for stride in YOLOX_STRIDES:
        y, x = np.indices((shape[0] // stride, shape[1] // stride), np.float32).reshape(2, -1)
        cells.append(np.stack([x, y], axis=1))
        strides.append(np.full((len(x), 1), stride, np.float32))
    cell, stride_of = np.concatenate(cells), np.concatenate(strides)
    if len(cell) != len(rows):
        raise DataError(
            f"detector.layout: expected {len(cell)} candidates of a YOLOX with input {shape[1]}x{shape[0]} px, "
            f"got {len(rows)}; choose another layout"
        )
    centers = (rows[:, :2] + cell) * stride_of
    sizes = np.exp(np.minimum(rows[:, 2:4], np.float32(LARGEST_LOG_SCALE))) * stride_of
    return np.concatenate([centers, sizes], axis=1)


def _decode_ssd(
    layout: OutputLayout,
    outputs: Mapping[str, Float32],
    shape: tuple[int, int],
    classes: int,
    ids: Sequence[int] | None,
) -> Candidates:
    """Decode the outputs of an SSD.

    The outputs are identified by name. TensorFlow's object detection API uses detection_boxes, detection_classes,
    detection_scores and detection_multiclass_scores. torchvision uses boxes, labels and scores.
    """
    tables = _tables(outputs)
    boxes = [array for name, array in tables.items() if "box" in name and array.shape[1:] == (4,)]
    if len(boxes) == 1:
        by_class = _by_class(tables, classes)
        scores = [t for name, t in tables.items() if "score" in name and t.ndim == 1]
        labels = [t for name, t in tables.items() if ("label" in name or "class" in name) and t.ndim == 1]
        if len(by_class) == 1:
            columns = _columns(by_class[0].shape[1], classes) if ids is None else ids
            return _checked(_ssd_boxes(layout, boxes[0], shape), by_class[0][:, columns])
        if not by_class and len(scores) == len(labels) == 1:
            numbers = range(1, classes + 1) if ids is None else ids
            class_scores = class_scores_of_labels(scores[0], labels[0], numbers)
            return _checked(_ssd_boxes(layout, boxes[0], shape), spread_evenly(class_scores))
    raise DataError(
        f"detector.layout: expected boxes (K, 4) with scores (K, {classes}) or (K, {classes + 1}), or boxes (K, 4) "
        f"with scores (K,) and labels (K,), for {layout.value}, got {described(outputs)}; choose another layout"
    )


def _ssd_boxes(layout: OutputLayout, boxes: Float32, shape: tuple[int, int]) -> Float32:
    boxes = boxes.reshape(-1, 4)
    if layout is OutputLayout.ssd_tensorflow:
        boxes = boxes[:, [1, 0, 3, 2]]
    if layout is not OutputLayout.ssd_torchvision:
        boxes = boxes * np.array([shape[1], shape[0]] * 2, np.float32)
    return boxes


def _tables(outputs: Mapping[str, Float32]) -> dict[str, Float32]:
    """Return the outputs of an SSD without a leading axis of length 1 and without additional outputs."""
    # "raw" outputs are the candidates before TensorFlow's non-maximum suppression
    tables = {name: array for name, array in outputs.items() if "raw" not in name and "num" not in name}
    if any("box" in name and array.ndim == 3 for name, array in tables.items()):
        return {name: array[0] for name, array in tables.items() if array.ndim > 1}
    return tables


def _by_class(tables: Mapping[str, Float32], classes: int) -> list[Float32]:
    """Return the tables of class scores of an SSD."""
    # the first of C + 1 class scores is the background; COCO's ids have 90 or, with the background, 91 columns
    widths = {classes, classes + 1} | ({len(COCO_BY_ID) - 1, len(COCO_BY_ID)} if classes == len(COCO) else set())
    return [t for name, t in tables.items() if "score" in name and t.ndim == 2 and t.shape[1] in widths]


def ends_with_background(classes: Float32) -> bool:
    """Return True if the last class column (K, C) is the background, by the outputs for a black image."""
    if len(classes) < MIN_CANDIDATES:
        return False
    return bool((classes.argmax(axis=1) == classes.shape[1] - 1).mean() > MIN_BACKGROUND)


def _columns(width: int, classes: int) -> list[int]:
    """Return the column of each class in a table of class scores."""
    if width <= classes + 1:
        return list(range(width - classes, width))
    return [k - (len(COCO_BY_ID) - width) for k, name in enumerate(COCO_BY_ID) if name != NO_CLASS]


def class_scores_of_labels(scores: Float32, labels: Float32, ids: Sequence[int]) -> Float32:
    """Return class scores (K, C) that contain the score of each box at its label, and 0 elsewhere.

    Padding (score 0) gets 0 for all classes, and the background (label 0), unless 0 is the label of a class.

    Args:
        scores: The scores (K,).
        labels: The labels (K,).
        ids: The label of each class.

    Raises:
        DataError: A label is unknown, or a score is not in [0, 1].
    """
    column = {k: c for c, k in enumerate(ids)}
    numbers = np.rint(labels).astype(np.int64)
    is_background = (numbers == 0) & (0 not in column)
    used = (scores > 0) & ~is_background
    unknown = [k for k in numbers[used].tolist() if k not in column]
    has_gaps = max(column) > len(column)
    # published networks with COCO's ids report no background
    unknown += [0] * bool(has_gaps and (scores[is_background] >= CONFIDENT).any())
    if unknown:
        fix = f", or detector.category_ids={'FROM_ONE' if min(unknown) else 'FROM_ZERO'} if labels have no gaps"
        raise DataError(
            f"detector.category_ids: expected labels {min(column)} to {max(column)} of {len(ids)} classes, got "
            f"{unknown[0]}; set another detector.label_space{fix if has_gaps else ''}"
        )
    check_scores(scores)
    rows = np.zeros((len(scores), len(ids)), np.float32)
    rows[np.flatnonzero(used), [column[k] for k in numbers[used].tolist()]] = scores[used]
    return rows


def spread_evenly(class_scores: Float32) -> Float32:
    """Distribute the remainder 1 - score of each box evenly over the other classes, but at most the score each.

    Args:
        class_scores: The scores (K, C), at most one per row above 0. Rows of zeros are not changed.
    """
    own = class_scores.max(axis=1, initial=0.0)[:, None]
    rest = np.minimum((1 - own) / max(class_scores.shape[1] - 1, 1), own)
    return np.asarray(np.where(class_scores > 0, class_scores, rest), np.float32)


def spread_rest(one_hot: Float32, scores: Float32, spread: float) -> Float32:
    """Return class distributions (N, C) for detections with one label and one score each.

    The label gets the probability 1 - spread * (1 - score), but at least 1 / C. The other classes share the remainder
    equally.

    Args:
        one_hot: The one-hot labels (N, C).
        scores: The scores (N,).
        spread: A factor in [0, 1]. With 1, the probability of the label is its score. With 0, it is 1.
    """
    c = one_hot.shape[1]
    if c == 1:
        return one_hot
    own = np.maximum(1 - spread * (1 - scores.astype(np.float64)), 1 / c)[:, None]
    return np.asarray(np.where(one_hot > 0, own, (1 - own) / (c - 1)), np.float32)
