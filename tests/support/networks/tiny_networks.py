"""ONNX networks with known outputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def save(path: Path, nodes: list[Any], inputs: list[Any], outputs: list[Any], constants: list[Any]) -> Path:
    """Write a network of these nodes to `path` and return the path."""
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def constant_network(path: Path, shape: tuple[int | str, ...], outputs: Mapping[str, np.ndarray[Any, Any]]) -> Path:
    """Write a network with an image input of `shape` and constant `outputs`."""
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["largest"], keepdims=0),
        helper.make_node("Mul", ["largest", "zero"], ["nothing"]),
    ]
    constants = [numpy_helper.from_array(np.zeros(1, np.float32), "zero")]
    for name, value in outputs.items():
        constants.append(numpy_helper.from_array(value.astype(np.float32), f"{name}_value"))
        nodes.append(helper.make_node("Add", [f"{name}_value", "nothing"], [name]))
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, shape)
    described = [helper.make_tensor_value_info(name, TensorProto.FLOAT, v.shape) for name, v in outputs.items()]
    return save(path, nodes, [image], described, constants)


def doubling_network(path: Path, shape: tuple[int | str, ...], element: int = TensorProto.FLOAT) -> Path:
    """Write a network that returns twice the image as float32."""
    nodes = [
        helper.make_node("Cast", ["images"], ["real"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["real", "two"], ["doubled"]),
    ]
    image = helper.make_tensor_value_info("images", element, shape)
    doubled = helper.make_tensor_value_info("doubled", TensorProto.FLOAT, shape)
    return save(path, nodes, [image], [doubled], [numpy_helper.from_array(np.full(1, 2, np.float32), "two")])
