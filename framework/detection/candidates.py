"""Decoding of the outputs of common box detectors, and selection of the best boxes.

A box is x1 y1 x2 y2 in px of the network's input. The left border of the first pixel is at 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from framework.data import Float32, Int32
from framework.detection.masks.boxes import LARGEST_LOG_SCALE, suppress_boxes
from framework.errors import DataError

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


def decode(layout: OutputLayout, outputs: Mapping[str, Float32], shape: tuple[int, int], classes: int) -> Candidates:
    """Decode the outputs of a network to candidate boxes.

    Args:
        layout: The output format of the network.
        outputs: The output arrays by name.
        shape: The size of the input (height, width), px.
        classes: The number of classes.

    Raises:
        DataError: The outputs do not have this layout.
    """
    if layout not in (OutputLayout.yolox, OutputLayout.yolo, OutputLayout.yolo_objectness):
        return _decode_ssd(layout, outputs, shape, classes)
    if len(outputs) != 1:
        raise DataError(f"detector.layout: expected one output, got {described(outputs)}; choose another layout")
    (output,) = outputs.values()
    if layout is OutputLayout.yolo:
        rows = _rows(output, 4 + classes, "yolo_objectness")
        return _checked(corners(rows[:, :4]), rows[:, 4:])
    rows = _rows(output, 5 + classes, "yolo" if layout is OutputLayout.yolo_objectness else "")
    boxes = rows[:, :4] if layout is OutputLayout.yolo_objectness else _yolox_boxes(rows, shape)
    return _checked(corners(boxes), rows[:, 4:5] * rows[:, 5:])


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
    layout: OutputLayout, outputs: Mapping[str, Float32], shape: tuple[int, int], classes: int
) -> Candidates:
    """Decode the outputs of an SSD.

    The outputs are identified by name. TensorFlow's object detection API uses detection_boxes, detection_classes,
    detection_scores and detection_multiclass_scores. torchvision uses boxes, labels and scores.
    """
    # "raw" outputs are the candidates before TensorFlow's non-maximum suppression
    tables = {name: array for name, array in outputs.items() if "raw" not in name and "num" not in name}
    boxes = [array for name, array in tables.items() if "box" in name and array.shape[-1] == 4 and array.ndim in (2, 3)]
    if len(boxes) == 1:
        if boxes[0].ndim == 3:
            tables = {name: array[0] for name, array in tables.items() if array.ndim > 1}
        # label 0 and the first of C + 1 class scores are the background
        by_class = [t for name, t in tables.items() if "score" in name and t.shape[1:] in ((classes,), (classes + 1,))]
        scores = [t for name, t in tables.items() if "score" in name and t.ndim == 1]
        labels = [t for name, t in tables.items() if ("label" in name or "class" in name) and t.ndim == 1]
        if len(by_class) == 1:
            return _checked(_ssd_boxes(layout, boxes[0], shape), by_class[0][:, -classes:])
        if not by_class and len(scores) == len(labels) == 1:
            return _checked(_ssd_boxes(layout, boxes[0], shape), _spread(scores[0], labels[0], classes))
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


def _spread(scores: Float32, labels: Float32, classes: int) -> Float32:
    """Return class scores (K, C) for boxes with one score and one label each.

    The remainder 1 - score is distributed evenly over the other classes, but each gets at most the score. Label 0 is
    the background, and label k is class k - 1. Background and padding (score 0) get 0 for all classes.
    """
    column = np.rint(labels).astype(np.int64) - 1
    used = (column != -1) & (scores > 0)
    if (beyond := column[used & ((column < 0) | (column >= classes))]).size:
        raise DataError(
            f"detector.label_space: expected labels 1 to {classes}, got {beyond.max() + 1}; set another label_space"
        )
    check_scores(scores)
    own = scores[used]
    rows = np.zeros((len(scores), classes), np.float32)
    rows[used] = np.minimum((1 - own) / max(classes - 1, 1), own)[:, None]
    rows[np.flatnonzero(used), column[used]] = own
    return rows


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
