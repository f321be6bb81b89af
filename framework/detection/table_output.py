"""Recognition of box detectors with a single table as output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from framework.data import Float32
from framework.detection.candidates import (
    LARGEST_UNIT,
    ROW_COLUMNS,
    YOLO_FORMAT,
    OutputLayout,
    RowColumns,
    cell_counts,
    described,
    single_table,
)
from framework.detection.masks.letterbox import ImageFormat, Placement
from framework.errors import DataError

ROW_NAMES = {"multiclass_nms": OutputLayout.label_first, "flat_predictions": OutputLayout.yolo_nas}
"""Layouts by a part of the output's name, for networks without detections in a black image."""
MAX_OFFSET = 16  # cells, limit of the offsets and log sizes of a YOLOX; decoded boxes are in px
ROW_FORMATS: Mapping[OutputLayout, ImageFormat] = {
    OutputLayout.end_to_end: YOLO_FORMAT,
    OutputLayout.image_first: YOLO_FORMAT,
    OutputLayout.label_first: replace(YOLO_FORMAT, placement=Placement.stretch),
    OutputLayout.efficientdet: replace(YOLO_FORMAT, placement=Placement.top_left, white=255.0),
}


def recognize_table(
    outputs: Mapping[str, Float32], shape: tuple[int, int], classes: int
) -> tuple[OutputLayout, ImageFormat | None]:
    """Return the layout and image format of a network from its outputs for a black image.

    Args:
        outputs: The output arrays by name.
        shape: The size of the input (height, width), px.
        classes: The number of classes.

    Returns:
        The layout, and the image format of published networks of this layout; None = unknown, as for YOLOX, whose
        networks have several formats.

    Raises:
        DataError: The layout is unknown or ambiguous.
    """
    boxes = [array for array in outputs.values() if array.ndim > 1 and array.shape[-1] == 4]
    if len(boxes) == 1 and len(outputs) > 1:
        unit = np.abs(boxes[0]).max(initial=0) <= LARGEST_UNIT
        layout = OutputLayout.ssd_unit if unit else OutputLayout.ssd_torchvision
        raise DataError(
            f"detector.layout: expected one output, or outputs of a known network, got {described(outputs)}; set "
            f"detector.layout={layout.value} if boxes are x1 y1 x2 y2"
        )
    if any(array.ndim > 3 for array in outputs.values()):
        raise DataError(
            f"detector.layout: expected a table of boxes, got {described(outputs)}; set detector=onnx_segmentation for "
            "a network with masks, or export with decoded boxes"
        )
    output = single_table(outputs)
    table = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if table.ndim != 2:
        raise DataError(f"detector.layout: expected a table of boxes, got {described(outputs)}; choose another layout")
    count, columns = table.shape
    cells = cell_counts(shape)
    if columns == 5 + classes and count == cells[0]:
        return _with_objectness(table)
    if columns == 5 + classes and count in [3 * number for number in cells]:
        return OutputLayout.yolo_objectness, YOLO_FORMAT  # YOLOv5 and YOLOv7 have three boxes per cell
    if count == 4 + classes:
        return OutputLayout.yolo, YOLO_FORMAT
    if columns == 4 + classes and count in cells:  # or a YOLOX with one class less
        raise DataError(
            f"detector.layout: expected {5 + classes} columns for a YOLOX with {classes} classes, got "
            f"{described(outputs)}; set another detector.label_space, or for the layout of Ultralytics "
            "detector.layout=yolo detector.placement=center detector.bgr=false detector.white_level=1"
        )
    rows = _recognize_rows(table, outputs, batched=output.ndim == 3)
    if rows is None and columns == 4 + classes and count not in [3 * number for number in cells]:
        unit = np.abs(table[:, :4]).max(initial=0) <= LARGEST_UNIT  # as in RT-DETR, whose images are stretched
        return OutputLayout.yolo, replace(YOLO_FORMAT, placement=Placement.stretch) if unit else YOLO_FORMAT
    return rows or (OutputLayout.yolox, None)


def _with_objectness(table: Float32) -> tuple[OutputLayout, ImageFormat | None]:
    """Recognize a table with one row per cell: offsets of a YOLOX, or decoded boxes of a YOLOX or YOLOv6."""
    if np.abs(table[:, :4]).max() <= MAX_OFFSET:
        return OutputLayout.yolox, None
    is_constant = bool((table[:, 4] == 1).all())  # YOLOv6 has no objectness
    return OutputLayout.yolo_objectness, YOLO_FORMAT if is_constant else None


def _recognize_rows(
    table: Float32, outputs: Mapping[str, Float32], batched: bool
) -> tuple[OutputLayout, ImageFormat | None] | None:
    """Recognize a table with one detection per row; None = no such table."""
    # tables with the index of the image have no batch, except those of EfficientDet
    other = {OutputLayout.image_first, OutputLayout.yolo_nas} if batched else {OutputLayout.efficientdet}
    counts = {layout: columns.count for layout, columns in ROW_COLUMNS.items() if layout not in other}
    same_count = [layout for layout, count in counts.items() if count == table.shape[1]]
    fitting = [layout for layout in same_count if _are_rows(table, ROW_COLUMNS[layout])]
    if not fitting:
        return None
    if len(table) and OutputLayout.end_to_end in fitting:
        fitting = [OutputLayout.end_to_end]  # rows of zeros are padding, which only these networks have
    elif named := [layout for part, layout in ROW_NAMES.items() if any(part in name for name in outputs)]:
        fitting = [layout for layout in fitting if layout in named] or fitting
    if len(fitting) > 1:
        fixes = " or ".join(f"detector.layout={layout.value}" for layout in fitting)
        raise DataError(f"detector.layout: expected detections in a black image, got {described(outputs)}; set {fixes}")
    return fitting[0], ROW_FORMATS.get(fitting[0])


def _are_rows(table: Float32, columns: RowColumns) -> bool:
    """Return True if the columns of a table contain scores, labels and corners."""
    scores, labels, boxes = table[:, columns.score], table[:, columns.label], table[:, columns.box]
    are_labels = (labels >= 0) & (labels == np.rint(labels))
    are_corners = (boxes[:, 2:] >= boxes[:, :2]).all(axis=1)
    return bool(((scores >= 0) & (scores <= 1) & are_labels & are_corners).all())
