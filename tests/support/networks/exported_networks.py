"""ONNX networks with the outputs of published exports: random values, and one known detection.

The detection is in the left half of the image: x in [1/8, 3/8] and y in [1/4, 3/4] of the input.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from tests.support.networks.tiny_networks import save

BOX = (0.125, 0.25, 0.375, 0.75)  # x1 y1 x2 y2, fractions of the input
Outputs = Mapping[str, np.ndarray[Any, Any]]


def export(
    path: Path,
    shape: tuple[int | str, ...],
    outputs: Outputs,
    dynamic: bool = False,
    empty: bool = False,
    element: int = TensorProto.FLOAT,
    sizes: Mapping[str, int] | None = None,
    size_shape: tuple[int, ...] = (1, 2),
) -> Path:
    """Write a network with constant outputs.

    Args:
        path: The file.
        shape: The shape of the image input.
        outputs: The outputs by name; integers keep their type, and floats have 32 bits.
        dynamic: True = the first dimension of every output is dynamic.
        empty: True = the outputs have no rows for a black image, as after suppression.
        element: The type of the image input.
        sizes: The types of further inputs by name.
        size_shape: The shape of these inputs.
    """
    nodes = [
        helper.make_node("Cast", ["image"], ["values"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMax", ["values"], ["largest"], keepdims=0),
        helper.make_node("Greater", ["largest", "zero"], ["bright"]),
        helper.make_node("Or", ["bright", "always"], ["kept"]),
    ]
    constants = [
        numpy_helper.from_array(np.zeros(1, np.float32), "zero"),
        numpy_helper.from_array(np.array([not empty]), "always"),
    ]
    described = []
    for name, value in outputs.items():
        array = value.astype(np.float32) if value.dtype == np.float64 else value
        constants.append(numpy_helper.from_array(array, f"{name}_value"))
        if dynamic and empty and not name.endswith("size"):
            constants.append(numpy_helper.from_array(np.array([len(array)], np.int64), f"{name}_rows"))
            nodes.append(helper.make_node("Expand", ["kept", f"{name}_rows"], [f"{name}_kept"]))
            nodes.append(helper.make_node("Compress", [f"{name}_value", f"{name}_kept"], [name], axis=0))
        else:
            nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
        shape_of_output = [None if dynamic and k == 0 else n for k, n in enumerate(array.shape)]
        kind = helper.np_dtype_to_tensor_dtype(array.dtype)
        described.append(helper.make_tensor_value_info(name, kind, shape_of_output))
    inputs = [helper.make_tensor_value_info("image", element, shape)]
    inputs += [helper.make_tensor_value_info(name, kind, size_shape) for name, kind in (sizes or {}).items()]
    return save(path, nodes, inputs, described, constants)


def corners_px(height: int, width: int) -> np.ndarray[Any, Any]:
    return np.array(BOX) * [width, height, width, height]


def rf_detr(column: int, columns: int = 91, queries: int = 200, side: int = 432, masks: bool = True) -> Outputs:
    """Return outputs of RF-DETR-Seg: boxes in 0..1, logits, and mask logits at a quarter of the input."""
    rng = np.random.default_rng(0)
    x1, y1, x2, y2 = BOX
    boxes = rng.uniform(0.3, 0.7, (1, queries, 4))
    boxes[0, 3] = [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1]
    logits = rng.uniform(-9, -6, (1, queries, columns))
    logits[0, 3, column] = 3.0
    if not masks:
        return {"dets": boxes, "labels": logits}
    cells = side // 4
    grids = rng.uniform(-9, -6, (1, queries, cells, cells))
    grids[0, 3, round(y1 * cells) : round(y2 * cells), round(x1 * cells) : round(x2 * cells)] = 8.0
    return {"dets": boxes, "labels": logits, "masks": grids}


def mask_rcnn(label: int, shape: tuple[int, int], grid: int = 28, count: int = 5) -> dict[str, np.ndarray[Any, Any]]:
    """Return boxes in px, labels, scores and masks (K, 1, G, G) in the boxes; the masks cover their boxes."""
    rng = np.random.default_rng(1)
    first = rng.uniform(0, 0.4, (count, 2)) * shape[::-1]
    boxes = np.concatenate([first, first + rng.uniform(0.2, 0.5, (count, 2)) * shape[::-1]], axis=1)
    boxes[0] = corners_px(*shape)
    scores = np.linspace(0.09, 0.05, count)
    scores[0] = 0.9
    return {
        "boxes": boxes,
        "labels": np.full(count, label),
        "scores": scores,
        "masks": np.full((count, 1, grid, grid), 0.95),
    }


def detectron2(label: int, shape: tuple[int, int]) -> Outputs:
    """Return the outputs of a traced network of Detectron2, with names of torch's exporter."""
    found = mask_rcnn(label, shape)
    return {
        "value": found["boxes"],
        "6897": found["labels"],
        "6903": found["masks"],
        "6899": found["scores"],
        "image_size": np.array(shape),
    }


def yolo26(label: int, side: int = 640, masks: bool = True) -> Outputs:
    """Return the outputs of an end-to-end YOLO: (1, 300, 6 + 32) and prototypes, or (1, 300, 6)."""
    rng = np.random.default_rng(2)
    first = rng.uniform(0, side / 2, (300, 2))
    rows = np.concatenate([first, first + rng.uniform(9, 99, (300, 2)), rng.uniform(0, 0.01, (300, 1))], axis=1)
    labels = rng.integers(0, 80, (300, 1))
    rows[0, :4], rows[0, 4], labels[0] = corners_px(side, side), 0.9, label
    if not masks:
        return {"output0": np.concatenate([rows, labels], axis=1)[None]}
    coefficients = rng.uniform(-0.01, 0.01, (300, 32))
    coefficients[0] = [1.0, *[0.0] * 31]
    prototypes = rng.uniform(-1, 1, (1, 32, side // 4, side // 4))
    prototypes[0, 0] = 8.0
    return {"output0": np.concatenate([rows, labels, coefficients], axis=1)[None], "output1": prototypes}


def detections(label: int, height: int, width: int, count: int = 20) -> tuple[np.ndarray[Any, Any], ...]:
    """Return boxes (K, 4) in px, scores (K,) and labels (K,) of one detection and weak others."""
    found = mask_rcnn(label, (height, width), count=count)
    return found["boxes"], found["scores"], found["labels"]


def tensorflow(label: int, masks: bool = False) -> Outputs:
    """Return outputs of TensorFlow's object detection API, as exported by `exporter_main_v2.py`."""
    boxes, scores, labels = detections(label, 1, 1)
    outputs = {
        "detection_anchor_indices": np.zeros((1, 20)),
        "detection_boxes": boxes[None][..., [1, 0, 3, 2]],
        "detection_classes": labels[None].astype(np.float64),
        "detection_multiclass_scores": np.eye(91)[labels][None] * scores[None, :, None],
        "detection_scores": scores[None],
        "num_detections": np.array([20.0]),
        "raw_detection_boxes": np.zeros((1, 50, 4)),
        "raw_detection_scores": np.zeros((1, 50, 91)),
    }
    return {**outputs, "detection_masks": np.full((1, 20, 33, 33), 0.95)} if masks else outputs


def end2end(label: int, height: int, width: int) -> Outputs:
    """Return outputs of TensorRT's EfficientNMS, which YOLOv6, YOLOv7 and YOLOv9 export with `--end2end`."""
    boxes, scores, labels = detections(label, height, width)
    return {
        "num_dets": np.array([[20]], np.int32),
        "det_boxes": boxes[None],
        "det_scores": scores[None],
        "det_classes": labels[None].astype(np.int32),
    }


def mmdeploy(label: int, height: int, width: int, masks: str) -> Outputs:
    """Return outputs of MMDeploy, with masks "in boxes", "bytes" or "logits" over the input, or none."""
    boxes, scores, labels = detections(label, height, width)
    outputs = {"dets": np.concatenate([boxes, scores[:, None]], axis=1)[None], "labels": labels[None]}
    x1, y1, x2, y2 = corners_px(height, width).astype(int)
    inside = np.zeros((1, 20, height, width), np.bool_)
    inside[0, 0, y1:y2, x1:x2] = True
    found = {
        "in boxes": np.full((1, 20, 28, 28), 0.95),
        "bytes": np.where(inside, np.uint8(255), np.uint8(0)),
        "logits": np.where(inside, 7.0, -7.0),
    }
    return {**outputs, "masks": found[masks]} if masks else outputs


def detr(column: int, masks: bool = False) -> Outputs:
    """Return outputs of DETR: 92 logits, the last of which is "no object", and boxes in 0..1."""
    found = rf_detr(column, columns=92, queries=100, side=480, masks=masks)
    logits = found["labels"].copy()
    logits[..., 91] = 4.0
    logits[0, 3, 91] = -4.0
    names = {"dets": "pred_boxes", "labels": "logits", "masks": "pred_masks"}
    return {names[name]: logits if name == "labels" else array for name, array in found.items()}


def rows(label: int, height: int, width: int, layout: str) -> Outputs:
    """Return one table with suppression: YOLOv7's, YOLO-NAS', EfficientDet's or PaddleDetection's."""
    boxes, scores, labels = detections(label, height, width)
    image, score, number = np.zeros((20, 1)), scores[:, None], labels[:, None]
    if layout == "yolov7":
        return {"output": np.concatenate([image, boxes, number, score], axis=1)}
    if layout == "yolo_nas":
        return {"graph2_flat_predictions": np.concatenate([image, boxes, score, number], axis=1)}
    if layout == "efficientdet":
        return {"detections:0": np.concatenate([image, boxes[:, [1, 0, 3, 2]], score, number], axis=1)[None]}
    table = np.concatenate([number, score, boxes], axis=1)
    return {"multiclass_nms3_0.tmp_0": table, "multiclass_nms3_0.tmp_2": np.array([20], np.int32)}


def cells(label: int, height: int, width: int, columns: str, per_cell: int = 1) -> np.ndarray[Any, Any]:
    """Return a dense table (1, K, 4 + n) of a YOLO: boxes, then the columns "classes" or "objectness classes"."""
    rng = np.random.default_rng(3)
    parts = []
    for stride in (8, 16, 32):
        y, x = np.indices((height // stride, width // stride)).reshape(2, -1)
        sizes = rng.uniform(8, 60, (2, len(x)))
        parts += [np.stack([(x + 0.5) * stride, (y + 0.5) * stride, *sizes], axis=1)] * per_cell
    boxes = np.concatenate(parts)
    scores = rng.uniform(0, 0.005, (len(boxes), 80))
    objectness = np.ones((len(boxes), 1)) if columns == "ones classes" else rng.uniform(0, 0.005, (len(boxes), 1))
    x1, y1, x2, y2 = corners_px(height, width)
    k = len(boxes) // 2
    boxes[k], scores[k, label], objectness[k] = [(x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1], 0.95, 1.0
    return np.concatenate([boxes, *([] if columns == "classes" else [objectness]), scores], axis=1)[None]


def prototypes(table: np.ndarray[Any, Any], height: int, width: int) -> tuple[np.ndarray[Any, Any], ...]:
    """Return a dense table with 32 mask coefficients, and the prototypes; the best candidate has the first one."""
    rng = np.random.default_rng(4)
    coefficients = rng.uniform(-0.01, 0.01, (1, table.shape[1], 32))
    coefficients[0, table.shape[1] // 2] = [1.0, *[0.0] * 31]
    maps = rng.uniform(-1, 1, (1, 32, height // 4, width // 4))
    maps[0, 0] = 8.0
    return np.concatenate([table, coefficients], axis=2), maps
