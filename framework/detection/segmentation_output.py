"""Decoding of segmentation networks with mask prototypes, such as exports of the YOLO family.

A network has two outputs: mask prototypes and a table of candidates. Usually, the table has one row with C class scores
for each cell. If the network contains non-maximum suppression, the table has one row with one class for each detection.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from framework.data import Bool, Float32, Int32
from framework.detection.candidates import (
    CONFIDENT,
    LARGEST_UNIT,
    Candidates,
    cell_counts,
    check_scores,
    corners,
    described,
)
from framework.detection.masks.binary_masks import masks_from_prototypes
from framework.detection.masks.letterbox import Letterbox
from framework.detection.runtimes.onnx_network import ExportMetadata, Outputs
from framework.errors import DataError

MIN_ORDERED_CORNERS = 0.9  # minimum fraction of boxes with x2 >= x1 and y2 >= y1, if boxes are corners
MAX_ORDERED_CENTERS = 0.5  # maximum fraction of such boxes, if boxes are centers and sizes; typically a few percent
MIN_ROWS = 20  # minimum number of detections to evaluate these fractions
BOXES_PER_CELL = (1, 3)  # 3 up to YOLOv7
SCORE, LABEL, COEFFICIENTS = 4, 5, 6  # columns of a table with suppression, after x1 y1 x2 y2

log = logging.getLogger(__name__)


class BoxKind(Enum):
    """Meaning of the four numbers of a box."""

    AUTO = "detected from the outputs for a black image"
    CENTER = "center x, y, width, height"
    CORNER = "x1 y1 x2 y2"


class MaskOutput(ABC):
    """K candidates of a segmentation network, with masks that are computed on demand."""

    candidates: Candidates

    @abstractmethod
    def masks(
        self, chosen: Int32, borders: Float32, letterbox: Letterbox, shape: tuple[int, int], threshold: float
    ) -> Bool:
        """Return the masks (N, H, W) of the chosen candidates.

        Args:
            chosen: The indices (N,) of the candidates.
            borders: The boxes (N, 4) x1 y1 x2 y2 of the chosen candidates in the image, px.
            letterbox: The placement of the image in the input of the network.
            shape: The image size (height, width), px.
            threshold: The minimum probability of a pixel in the mask.
        """


@dataclass(frozen=True)
class SegmentationOutput(MaskOutput):
    """K candidates with mask coefficients, and the mask prototypes."""

    candidates: Candidates
    coefficients: Float32  # (K, M)
    prototypes: Float32  # (M, h, w)

    def masks(
        self, chosen: Int32, borders: Float32, letterbox: Letterbox, shape: tuple[int, int], threshold: float
    ) -> Bool:
        return masks_from_prototypes(self.coefficients[chosen], self.prototypes, borders, letterbox, shape, threshold)


@dataclass(frozen=True)
class SegmentationLayout:
    """Layout of the two outputs of a network."""

    classes: int  # C
    objectness: bool  # True = the class scores follow an objectness score
    shape: tuple[int, int]  # (height, width) px of the network's input
    suppressed: bool  # True = one row per detection: x1 y1 x2 y2, score, label, coefficients
    rows_first: bool  # True = the table is (1, K, columns), False = (1, columns, K)
    channels_last: bool  # True = prototypes are (1, h, w, M), False = (1, M, h, w)
    boxes: BoxKind | None = None  # CENTER or CORNER; None = undetermined
    unit: bool | None = None  # True = boxes are in 0..1 of the input's sides, False = in px; None = undetermined

    def read(self, outputs: Outputs) -> SegmentationOutput:
        """Decode the outputs of a network.

        Raises:
            DataError: The outputs do not have this layout.
        """
        table, prototypes = _table_and_prototypes(outputs)
        rows = self._rows(table)
        maps = np.moveaxis(prototypes[0], -1, 0) if self.channels_last else prototypes[0]
        if self.suppressed:
            class_scores, coefficients = self._one_class_scores(rows), rows[:, COEFFICIENTS:]
        else:
            start = 5 if self.objectness else 4
            class_scores, coefficients = rows[:, start : start + self.classes], rows[:, start + self.classes :]
            if self.objectness:
                class_scores = class_scores * rows[:, start - 1 : start]
        check_scores(class_scores, "detector.weights", fix="")
        return SegmentationOutput(Candidates(self._boxes_px(rows, class_scores), class_scores), coefficients, maps)

    def determined_by(self, outputs: Outputs) -> SegmentationLayout:
        """Return the layout with the kind and unit of the boxes, detected from their values.

        If the kind is already known, it is not changed.

        Raises:
            DataError: The kind or unit of the boxes is ambiguous.
        """
        table, _ = _table_and_prototypes(outputs)
        rows = self._rows(table)
        used = rows[rows[:, SCORE] > 0] if self.suppressed else rows
        boxes = self.boxes or _box_kind(used[:, :4], self.suppressed)
        return replace(self, boxes=boxes, unit=_is_unit(used[:, :4], self.shape, self.suppressed))

    def _rows(self, table: Float32) -> Float32:
        rows: Float32 = table[0] if self.rows_first else table[0].T
        return rows

    def _one_class_scores(self, rows: Float32) -> Float32:
        """Return class scores (K, C) that contain the score of each detection at its label, and 0 elsewhere."""
        labels = rows[:, LABEL]
        if not _are_labels(labels, self.classes):
            raise DataError(
                f"detector.label_space: expected integer labels 0 to {self.classes - 1} in column 6 of the network's "
                f"output, got {labels.min():g} to {labels.max():g}; set another label_space"
            )
        class_scores = np.zeros((len(rows), self.classes), np.float32)
        class_scores[np.arange(len(rows)), labels.astype(np.int64)] = rows[:, SCORE]
        return class_scores

    def _boxes_px(self, rows: Float32, class_scores: Float32) -> Float32:
        """Return the boxes (K, 4) x1 y1 x2 y2, px of the input."""
        boxes = rows[:, :4]
        unit = _is_unit(boxes[rows[:, SCORE] > 0], self.shape, self.suppressed) if self.unit is None else self.unit
        confident = class_scores.max(axis=1, initial=0.0) >= CONFIDENT
        if self.boxes is BoxKind.CENTER:
            boxes = corners(boxes)
        # None is treated as CORNER, because every known export with suppression has corners
        elif len(unordered := boxes[confident][(boxes[confident, 2:] < boxes[confident, :2]).any(axis=1)]):
            raise DataError(
                "detector.box_format: expected corners with x1 <= x2 and y1 <= y2 in confident detections, got "
                f"{unordered[0].tolist()}; set detector.box_format=CENTER"
            )
        return boxes * np.array([self.shape[1], self.shape[0]] * 2, np.float32) if unit else boxes


def detect_layout(
    outputs: Outputs,
    classes: int,
    objectness: bool,
    boxes: BoxKind,
    shape: tuple[int, int],
    input_channels_last: bool,
    metadata: ExportMetadata,
) -> SegmentationLayout:
    """Detect the layout of a network from its outputs for a black image.

    Args:
        outputs: The outputs by name.
        classes: The number of classes.
        objectness: True = the class scores follow an objectness score.
        boxes: The meaning of the box numbers; AUTO = detected from their values.
        shape: The size of the input (height, width), px.
        input_channels_last: True = the input of the network is (1, H, W, 3).
        metadata: The metadata of the ONNX file.

    Raises:
        DataError: The outputs do not match any layout.
    """
    table, prototypes = _table_and_prototypes(outputs)
    channels_last = _is_channels_last(prototypes, shape, input_channels_last, metadata)
    count = prototypes.shape[-1 if channels_last else 1]
    columns = (5 if objectness else 4) + classes + count
    if not objectness and table.shape[2] == columns + 1 and table.shape[1] in [3 * k for k in cell_counts(shape)]:
        objectness, columns = True, columns + 1  # YOLOv5 and YOLOv7 have three boxes per cell
        log.info("detector.objectness: class scores follow an objectness score, as in YOLOv5")
    is_rows, is_columns = table.shape[2] == columns, table.shape[1] == columns
    suppressed = table.shape[2] == COEFFICIENTS + count and (
        not (is_rows or is_columns) or _looks_suppressed(table[0], classes, shape)
    )
    if not suppressed and is_rows == is_columns:
        raise DataError(_no_such_table(table.shape, columns, count, objectness, is_rows))
    given = None if boxes is BoxKind.AUTO else boxes
    layout = SegmentationLayout(classes, objectness, shape, suppressed, suppressed or is_rows, channels_last, given)
    layout = layout.determined_by(outputs)
    layout.read(outputs)  # raises DataError for another layout
    return layout


def _table_and_prototypes(outputs: Outputs) -> tuple[Float32, Float32]:
    tables = [output for output in outputs.values() if output.ndim == 3 and output.shape[0] == 1]
    maps = [output for output in outputs.values() if output.ndim == 4 and output.shape[0] == 1]
    if len(outputs) == 1 and max(len(tables), *(one.ndim == 2 for one in outputs.values())):
        raise DataError(
            f"detector.weights: expected masks, got boxes only ({described(outputs)}); set detector=onnx_boxes"
        )
    if len(outputs) != 2 or len(tables) != 1 or len(maps) != 1:
        raise DataError(
            "detector.weights: expected two outputs, a table (1, 4 + classes + M, K), or (1, K, 6 + M) with "
            f"suppression, and prototypes (1, M, h, w), or boxes, classes and masks of RF-DETR, torchvision or "
            f"Detectron2, got {described(outputs)}; use detector=rf_detr_seg or detector=transformers_segmentation for "
            "models on huggingface.co"
        )
    queries = maps[0].shape[1]
    if tables[0].shape[1] == queries != tables[0].shape[2] - COEFFICIENTS:  # one mask for each query, but no box
        raise DataError(
            f"detector.weights: expected boxes, classes and masks, got {described(outputs)}, as of Mask2Former, "
            "MaskFormer or OneFormer; set detector=transformers_segmentation and detector.model to the network's folder"
        )
    return tables[0], maps[0]


def _is_channels_last(
    prototypes: Float32, shape: tuple[int, int], input_channels_last: bool, metadata: ExportMetadata
) -> bool:
    """Return True if the channels of the prototypes are the last axis."""
    # cells are square, so the prototypes have the aspect ratio of the input in only one order of the axes
    _, a, b, c = prototypes.shape
    height, width = shape
    first, last = (abs(rows * width - columns * height) < max(shape) for rows, columns in ((b, c), (a, b)))
    if first and last and metadata.author.startswith("Ultralytics"):
        return input_channels_last  # Ultralytics exports transpose both input and output, or neither
    if first == last:
        expected = f"expected prototypes with the aspect ratio of the input, height:width = {height}:{width}"
        found = "with another aspect ratio"
        if first:
            expected = "expected prototypes (1, M, h, w) or (1, h, w, M)"
            found = "with an ambiguous order of axes; export for another input size"
        raise DataError(f"detector.weights: {expected}, got {prototypes.shape} {found}")
    return bool(last)


def _are_labels(column: Float32, classes: int) -> bool:
    return bool(((column >= 0) & (column < classes) & (column == np.rint(column))).all())


def _looks_suppressed(rows: Float32, classes: int, shape: tuple[int, int]) -> bool:
    """Return True if the rows of a table are detections, False if they are cells."""
    # labels alone are not sufficient in 8-bit networks, where most scores are 0 and resemble labels
    counts = {boxes * cells for boxes in BOXES_PER_CELL for cells in cell_counts(shape)}
    return _are_labels(rows[:, LABEL], classes) and len(rows) not in counts


def _no_such_table(shape: tuple[int, ...], columns: int, count: int, objectness: bool, both: bool) -> str:
    if both:
        return (
            f"detector.weights: expected different numbers of candidates and columns, got {columns} for both; "
            "export for another input size"
        )
    other = columns - 1 if objectness else columns + 1
    fix = f"set detector.objectness={str(not objectness).lower()} or" if other in shape[1:] else "choose"
    return (
        f"detector.label_space: expected {columns} columns for box, classes and {count} coefficients, or "
        f"{COEFFICIENTS + count} with suppression in the network, got an output of shape {shape}; {fix} another "
        "detector.label_space"
    )


def _box_kind(boxes: Float32, suppressed: bool) -> BoxKind | None:
    """Detect whether boxes (K, 4) are corners, or centers and sizes.

    The result is None if the boxes of detections are ambiguous.

    Raises:
        DataError: The boxes of cells are ambiguous.
    """
    if suppressed and len(boxes) < MIN_ROWS:
        return None
    # cells cover the image, so most centers are larger than the sizes of their boxes and few would be valid corners
    ordered = (boxes[:, 2:] >= boxes[:, :2]).all(axis=1).mean()
    if ordered >= MIN_ORDERED_CORNERS:
        return BoxKind.CORNER
    if ordered <= MAX_ORDERED_CENTERS:
        return BoxKind.CENTER
    if suppressed:
        return None
    raise DataError(
        f"detector.box_format: expected corners or centers and sizes, got ambiguous boxes ({ordered:.0%} "
        "could be corners); set detector.box_format=CENTER or CORNER"
    )


def _is_unit(boxes: Float32, shape: tuple[int, int], suppressed: bool) -> bool | None:
    """Return True if boxes (K, 4) are in 0..1, False if they are in px, and None without boxes.

    Raises:
        DataError: The boxes of cells do not cover the input.
    """
    if not len(boxes):
        return None
    if float(np.abs(boxes).max()) <= LARGEST_UNIT:
        return True
    # cells cover the input, but detections may not
    if not suppressed and (boxes[:, 0].max() < shape[1] / 4 or boxes[:, 1].max() < shape[0] / 4):
        raise DataError(
            f"detector.weights: expected boxes in px of the input {shape[1]}x{shape[0]} or in 0..1, got "
            f"x, y of at most {boxes[:, 0].max():.3g}, {boxes[:, 1].max():.3g}; export with decoded boxes"
        )
    return False
