"""Conversion of a YOLO segmentation network to the output layouts of other exporters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

MOST = 300  # maximum number of detections of networks with suppression


class NetworkEditor:
    """Editor for the two outputs of a YOLO segmentation network, whose boxes are center and size, px."""

    def __init__(self, source: Path) -> None:
        self.model = onnx.load(source)
        self.graph = self.model.graph
        self.table, self.prototypes = (output.name for output in self.graph.output)
        self.columns = self.graph.output[0].type.tensor_type.shape.dim[1].dim_value
        self.side = self.graph.input[0].type.tensor_type.shape.dim[2].dim_value
        self._names = 0

    def add(self, kind: str, *inputs: str | np.ndarray[Any, Any], outputs: int = 1, **attributes: Any) -> Any:
        """Add a node and return the names of its outputs. Array inputs become constants."""
        names = [self._constant(one) if isinstance(one, np.ndarray) else one for one in inputs]
        made = [self._name() for _ in range(outputs)]
        self.graph.node.append(helper.make_node(kind, names, made, **attributes))
        return made[0] if outputs == 1 else made

    def columns_of(self, start: int, stop: int) -> str:
        """Slice the columns [start, stop) of the table (1, columns, K) and return the output."""
        return self.add("Slice", self.table, np.array([start]), np.array([stop]), np.array([1]))

    def save(self, path: Path) -> Path:
        """Save the network. Its outputs are the current table and prototypes, with dynamic shape."""
        del self.graph.output[:]
        for name, axes in ((self.table, 3), (self.prototypes, 4)):
            shape = [f"{name}_{k}" for k in range(axes)]
            self.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        onnx.save(self.model, path)
        return path

    def _constant(self, value: np.ndarray[Any, Any]) -> str:
        name = self._name()
        self.graph.initializer.append(numpy_helper.from_array(value, name))
        return name

    def _name(self) -> str:
        self._names += 1
        return f"rewritten_{self._names}"


def transposed(net: NetworkEditor) -> None:
    net.table = net.add("Transpose", net.table, perm=[0, 2, 1])


def channels_last(net: NetworkEditor) -> None:
    net.prototypes = net.add("Transpose", net.prototypes, perm=[0, 2, 3, 1])


def unit(net: NetworkEditor) -> None:
    scale = np.ones((1, net.columns, 1), np.float32)
    scale[:, :4] = 1 / net.side
    net.table = net.add("Mul", net.table, scale)


def corners(net: NetworkEditor) -> None:
    center, half = net.columns_of(0, 2), net.add("Mul", net.columns_of(2, 4), np.array(0.5, np.float32))
    first, second = net.add("Sub", center, half), net.add("Add", center, half)
    net.table = net.add("Concat", first, second, net.columns_of(4, net.columns), axis=1)


def any_size(net: NetworkEditor) -> None:
    for dimension, name in zip(net.graph.input[0].type.tensor_type.shape.dim, ("n", "", "h", "w"), strict=True):
        if name:
            dimension.dim_param = name


def best_rows(net: NetworkEditor) -> None:
    """Select the cells with the best scores as detections, like networks without suppression."""
    corners(net)
    scores = net.columns_of(4, net.columns - 32)
    best = net.add("ReduceMax", scores, axes=[1], keepdims=0)  # (1, K)
    _, index = net.add("TopK", best, np.array([MOST]), outputs=2, axis=1)
    _finish(net, scores, net.add("Squeeze", index, np.array([0])))


def suppressed(net: NetworkEditor) -> None:
    """Suppress duplicates by the best class of each cell, and pad the detections with zeros."""
    corners(net)
    scores = net.columns_of(4, net.columns - 32)
    best = net.add("ReduceMax", scores, axes=[1], keepdims=1)
    own = net.add("Cast", net.add("Equal", scores, best), to=TensorProto.FLOAT)
    boxes = net.add("Transpose", net.columns_of(0, 4), perm=[0, 2, 1])
    limits = np.array([MOST]), np.array([0.45], np.float32), np.array([0.1], np.float32)
    chosen = net.add(
        "NonMaxSuppression", boxes, net.add("Mul", scores, own), *limits
    )  # (n, 3), the last column is the row
    _finish(net, scores, net.add("Gather", chosen, np.array(2), axis=1))
    padded = net.add("Concat", net.table, np.zeros((1, MOST, 38), np.float32), axis=1)
    net.table = net.add("Slice", padded, np.array([0]), np.array([MOST]), np.array([1]))


def _finish(net: NetworkEditor, scores: str, index: str) -> None:
    """Set the table (1, n, 38) to the rows `index` (n,)."""
    best = net.add("ReduceMax", scores, axes=[1], keepdims=1)
    label = net.add("Cast", net.add("ArgMax", scores, axis=1, keepdims=1), to=TensorProto.FLOAT)
    coefficients = net.columns_of(net.columns - 32, net.columns)
    rows = net.add("Concat", net.columns_of(0, 4), best, label, coefficients, axis=1)
    net.columns = 38
    net.table = net.add("Transpose", net.add("Gather", rows, index, axis=2), perm=[0, 2, 1])


def unit_rows(net: NetworkEditor) -> None:
    """Convert the boxes of the detections from px to fractions of the image size."""
    scale = np.ones((1, 1, 38), np.float32)
    scale[..., :4] = 1 / net.side
    net.table = net.add("Mul", net.table, scale)


LAYOUTS: dict[str, tuple[Callable[[NetworkEditor], None], ...]] = {
    "transposed": (transposed,),
    "in 0..1, channels last, as in TensorFlow": (unit, channels_last),
    "corners": (corners,),
    "corners in 0..1, transposed": (corners, unit, transposed),
    "any size": (any_size,),
    "suppressed": (suppressed,),
    "suppressed in 0..1, channels last": (suppressed, unit_rows, channels_last),
    "the best rows": (best_rows,),
}


def rewritten(source: Path, name: str, path: Path) -> Path:
    """Write the network `source` in the layout `name` to `path`."""
    net = NetworkEditor(source)
    for step in LAYOUTS[name]:
        step(net)
    return net.save(path)
