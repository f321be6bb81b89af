"""What the outputs of a network with prototypes mean: one of the layouts that exports of the YOLO family have.

Beside prototypes there is one table. Either it has a row for every cell of the network, with a score for each class,
or suppression and the choice of the class are part of the network, and it has a row for each detection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from framework.data import Float32
from framework.detection.candidates import Candidates, check_scores, corners, described
from framework.detection.runtimes.onnx_network import ExportMetadata, Outputs
from framework.errors import DataError

SURELY_CORNERS = 0.9  # share of the cells whose third and fourth number are not below the first two
SURELY_CENTERS = 0.5  # likewise, of which sizes have a few per cent: no size grows with the place of its cell
FEWEST_ROWS = 20  # below, the shares above say little
LARGEST_UNIT = 2.0  # boxes in 0..1 may reach over the border; no box in px lies within 2 px of the upper left corner
CONFIDENT = 0.5  # score from which a box that ends before it begins is no accident
STRIDES = (8, 16, 32, 64)  # px; of the cells of the YOLO family, the last in large networks only
BOXES_A_CELL = (1, 3)  # 3 up to YOLOv7
SCORE, LABEL, COEFFICIENTS = 4, 5, 6  # columns of a table with suppression, after x1 y1 x2 y2


class BoxKind(Enum):
    """What the four numbers of a box are."""

    AUTO = "what the network's answer to a black image shows"
    CENTER = "centre x, y, width, height"
    CORNER = "x1 y1 x2 y2"


@dataclass(frozen=True)
class SegmentationOutput:
    """K candidates with the M coefficients of their masks."""

    candidates: Candidates
    coefficients: Float32  # (K, M)
    prototypes: Float32  # (M, h, w)


@dataclass(frozen=True)
class SegmentationLayout:
    """How to read the two outputs of a network. None = its answer to a black image did not show it."""

    classes: int  # C
    objectness: bool  # it stands before the class scores
    shape: tuple[int, int]  # (height, width) px of the network's input
    suppressed: bool  # rows x1 y1 x2 y2, score, label, coefficients; one for each detection
    rows_first: bool  # the table is (1, K, columns), not (1, columns, K)
    channels_last: bool  # prototypes are (1, h, w, M), not (1, M, h, w)
    boxes: BoxKind | None = None  # CENTER or CORNER
    unit: bool | None = None  # boxes are in 0..1 of the input's sides, not in px

    def read(self, outputs: Outputs) -> SegmentationOutput:
        """Raises DataError when the outputs do not have this layout, and where boxes cannot be what they seem."""
        table, prototypes = _table_and_prototypes(outputs)
        rows = self._rows(table)
        maps = np.moveaxis(prototypes[0], -1, 0) if self.channels_last else prototypes[0]
        if self.suppressed:
            class_scores, coefficients = self._one_class_scores(rows), rows[:, COEFFICIENTS:]
        else:
            first = _first_score(self.objectness)
            class_scores, coefficients = rows[:, first : first + self.classes], rows[:, first + self.classes :]
            if self.objectness:
                class_scores = class_scores * rows[:, first - 1 : first]
        check_scores(class_scores)
        return SegmentationOutput(Candidates(self._boxes_px(rows, class_scores), class_scores), coefficients, maps)

    def seen_in(self, outputs: Outputs) -> SegmentationLayout:
        """With `boxes` and `unit` as these outputs show them, where they show them. Raises DataError where both fit."""
        table, _ = _table_and_prototypes(outputs)
        rows = self._rows(table)
        used = rows[rows[:, SCORE] > 0] if self.suppressed else rows
        boxes = self.boxes or _box_kind(used[:, :4], self.suppressed)
        return replace(self, boxes=boxes, unit=_is_unit(used[:, :4], self.shape, self.suppressed))

    def _rows(self, table: Float32) -> Float32:
        rows: Float32 = table[0] if self.rows_first else table[0].T
        return rows

    def _one_class_scores(self, rows: Float32) -> Float32:
        """(K, C): of each row the score of its label, 0 for the other classes."""
        labels = rows[:, LABEL]
        if not _are_labels(labels, self.classes):
            raise DataError(
                f"the network's sixth column must be labels from 0 to {self.classes - 1}, found {labels.min():g} to"
                f" {labels.max():g}: choose other detector.labels"
            )
        class_scores = np.zeros((len(rows), self.classes), np.float32)
        class_scores[np.arange(len(rows)), labels.astype(np.int64)] = rows[:, SCORE]
        return class_scores

    def _boxes_px(self, rows: Float32, class_scores: Float32) -> Float32:
        """x1 y1 x2 y2 (K, 4) in px of the input."""
        boxes = rows[:, :4]
        kind = self.boxes or BoxKind.CORNER  # every known export with suppression has corners
        unit = _is_unit(boxes[rows[:, SCORE] > 0], self.shape, self.suppressed) if self.unit is None else self.unit
        if kind is BoxKind.CENTER:
            boxes = corners(boxes)
        else:
            sure = class_scores.max(axis=1, initial=0.0) >= CONFIDENT
            if (boxes[sure, 2:] < boxes[sure, :2]).any():
                raise DataError(
                    "the network's boxes cannot be corners, for one of a confident detection ends before it begins:"
                    " set detector.boxes=CENTER"
                )
        return boxes * np.array([self.shape[1], self.shape[0]] * 2, np.float32) if unit else boxes


def recognise(
    outputs: Outputs,
    classes: int,
    objectness: bool,
    boxes: BoxKind,
    shape: tuple[int, int],
    input_channels_last: bool,
    metadata: ExportMetadata,
) -> SegmentationLayout:
    """The layout of a network, by its answer to a black image. Raises DataError, with the reason, when it has none.

    shape: (height, width) px of its input. Shapes tell all but what boxes are; the rows of cells show that, because
    cells cover the image: their centres come near its far border, in px or as 1; and sizes do not exceed them.
    """
    table, prototypes = _table_and_prototypes(outputs)
    channels_last = _is_channels_last(prototypes, shape, input_channels_last, metadata)
    count = prototypes.shape[-1 if channels_last else 1]
    columns = _first_score(objectness) + classes + count
    is_rows, is_columns = table.shape[2] == columns, table.shape[1] == columns
    suppressed = table.shape[2] == COEFFICIENTS + count and (
        not (is_rows or is_columns) or _looks_suppressed(table[0], classes, shape)
    )
    if not suppressed and is_rows == is_columns:
        raise DataError(_no_such_table(table.shape, columns, count, objectness, is_rows))
    given = None if boxes is BoxKind.AUTO else boxes
    rows_first = suppressed or is_rows
    layout = SegmentationLayout(classes, objectness, shape, suppressed, rows_first, channels_last, given)
    layout = layout.seen_in(outputs)
    layout.read(outputs)  # raises where it is another one after all
    return layout


def _table_and_prototypes(outputs: Outputs) -> tuple[Float32, Float32]:
    tables = [output for output in outputs.values() if output.ndim == 3 and output.shape[0] == 1]
    maps = [output for output in outputs.values() if output.ndim == 4 and output.shape[0] == 1]
    if len(outputs) != 2 or len(tables) != 1 or len(maps) != 1:
        raise DataError(
            "a segmentation network must have two outputs, (1, 4 + classes + M, K) or with suppression (1, K, 6 + M),"
            f" and (1, M, h, w), found {described(outputs)}"
        )
    return tables[0], maps[0]


def _first_score(objectness: bool) -> int:
    """The column of the first class score."""
    return 5 if objectness else 4


def _is_channels_last(
    prototypes: Float32, shape: tuple[int, int], input_channels_last: bool, metadata: ExportMetadata
) -> bool:
    """Cells are as long as they are wide: only one way round does the map have the input's proportions."""
    _, a, b, c = prototypes.shape
    height, width = shape
    first, last = (abs(rows * width - columns * height) < max(shape) for rows, columns in ((b, c), (a, b)))
    if first and last and metadata.author.startswith("Ultralytics"):
        return input_channels_last  # their exports turn both or none
    if first == last:
        why = "may be (1, M, h, w) or (1, h, w, M): export for another size" if first else "have other proportions"
        raise DataError(f"the network's prototypes {prototypes.shape} {why}; its input is {height}x{width}")
    return bool(last)


def _are_labels(column: Float32, classes: int) -> bool:
    return bool(((column >= 0) & (column < classes) & (column == np.rint(column))).all())


def _looks_suppressed(rows: Float32, classes: int, shape: tuple[int, int]) -> bool:
    """Whether a table that could be either is one of detections: with labels, and not as many rows as cells.

    Scores are no whole numbers, but for those of networks of 8 bits, where most are 0.
    """
    cells = [-(-shape[0] // stride) * -(-shape[1] // stride) for stride in STRIDES]
    counts = {boxes * sum(cells[:levels]) for boxes in BOXES_A_CELL for levels in (3, 4)}
    return _are_labels(rows[:, LABEL], classes) and len(rows) not in counts


def _no_such_table(shape: tuple[int, ...], columns: int, count: int, objectness: bool, both: bool) -> str:
    found = f"found the shape {shape}"
    if both:
        return f"a network with as many candidates as columns, {columns}, cannot be read: export for another size"
    wanted = (
        f"the network's output must have {columns} columns for box, classes and {count} coefficients, or"
        f" {COEFFICIENTS + count} with suppression inside"
    )
    other = columns - 1 if objectness else columns + 1
    if other in shape[1:]:
        return f"{wanted}, {found}: set detector.objectness={str(not objectness).lower()} or other detector.labels"
    return f"{wanted}, {found}: choose other detector.labels"


def _box_kind(boxes: Float32, suppressed: bool) -> BoxKind | None:
    """CENTER or CORNER where boxes (K, 4) show it; None where detections do not. Raises DataError for other boxes."""
    if suppressed and len(boxes) < FEWEST_ROWS:
        return None
    ordered = (boxes[:, 2:] >= boxes[:, :2]).all(axis=1).mean()
    if ordered >= SURELY_CORNERS:
        return BoxKind.CORNER
    if ordered <= SURELY_CENTERS:
        return BoxKind.CENTER
    if suppressed:
        return None
    raise DataError(
        f"the network's boxes may be corners or centre and size ({ordered:.0%} of them could be corners): set"
        " detector.boxes=CENTER or CORNER"
    )


def _is_unit(boxes: Float32, shape: tuple[int, int], suppressed: bool) -> bool | None:
    """Whether boxes (K, 4) are in 0..1; None where there is none. Raises DataError where they are not in px either."""
    if not len(boxes):
        return None
    if float(np.abs(boxes).max()) <= LARGEST_UNIT:
        return True
    # the cells of a network cover its input, detections need not
    if not suppressed and (boxes[:, 0].max() < shape[1] / 4 or boxes[:, 1].max() < shape[0] / 4):
        raise DataError(
            f"the network's boxes are neither in px of its input {shape[0]}x{shape[1]} nor in 0..1: they begin at up to"
            f" {boxes[:, 0].max():.3g}, {boxes[:, 1].max():.3g}; export it with boxes that are decoded"
        )
    return False
