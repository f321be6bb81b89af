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
    path: Path, shape: tuple[int | str, ...], outputs: Outputs, dynamic: bool = False, empty: bool = False
) -> Path:
    """Write a network with constant outputs.

    Args:
        path: The file.
        shape: The shape of the image input.
        outputs: The outputs by name; integers stay integers.
        dynamic: True = the first dimension of every output is dynamic.
        empty: True = the outputs have no rows for a black image, as after suppression.
    """
    nodes = [
        helper.make_node("ReduceMax", ["image"], ["largest"], keepdims=0),
        helper.make_node("Greater", ["largest", "zero"], ["bright"]),
        helper.make_node("Or", ["bright", "always"], ["kept"]),
    ]
    constants = [
        numpy_helper.from_array(np.zeros(1, np.float32), "zero"),
        numpy_helper.from_array(np.array([not empty]), "always"),
    ]
    described = []
    for name, value in outputs.items():
        is_integer = np.issubdtype(value.dtype, np.integer)
        array = value.astype(np.int64 if is_integer else np.float32)
        element = TensorProto.INT64 if is_integer else TensorProto.FLOAT
        constants.append(numpy_helper.from_array(array, f"{name}_value"))
        if dynamic and empty and not name.endswith("size"):
            constants.append(numpy_helper.from_array(np.array([len(array)], np.int64), f"{name}_rows"))
            nodes.append(helper.make_node("Expand", ["kept", f"{name}_rows"], [f"{name}_kept"]))
            nodes.append(helper.make_node("Compress", [f"{name}_value", f"{name}_kept"], [name], axis=0))
        else:
            nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
        sizes = [None if dynamic and k == 0 else n for k, n in enumerate(array.shape)]
        described.append(helper.make_tensor_value_info(name, element, sizes))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
    return save(path, nodes, [image], described, constants)


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
