"""The networks of `tiny_networks` as .tflite files, written with the format's own schema; no TensorFlow is needed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import flatbuffers
import numpy as np
from ai_edge_litert import schema_py_generated as schema

TYPES = {
    "float32": schema.TensorType.FLOAT32,
    "uint8": schema.TensorType.UINT8,
    "int8": schema.TensorType.INT8,
    "int32": schema.TensorType.INT32,
}
OPTIONS = {
    schema.BuiltinOperator.REDUCE_MAX: (schema.BuiltinOptions.ReducerOptions, schema.ReducerOptionsT),
    schema.BuiltinOperator.MUL: (schema.BuiltinOptions.MulOptions, schema.MulOptionsT),
    schema.BuiltinOperator.ADD: (schema.BuiltinOptions.AddOptions, schema.AddOptionsT),
}


class Graph:
    """A network that is put together node by node."""

    def __init__(self) -> None:
        self._model = schema.ModelT()
        self._model.version = 3
        self._model.buffers = [schema.BufferT()]  # the first one stands for none
        self._model.operatorCodes = []
        self._graph = schema.SubGraphT()
        self._graph.tensors, self._graph.operators = [], []
        self._model.subgraphs = [self._graph]

    def tensor(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: str = "float32",
        value: np.ndarray[Any, Any] | None = None,
        quantisation: tuple[float, int] | None = None,
        signature: tuple[int, ...] | None = None,
    ) -> int:
        """Its number. quantisation: scale and zero point; signature: the shape with -1 for any."""
        made = schema.TensorT()
        made.name, made.shape, made.type, made.buffer = name.encode(), list(shape), TYPES[dtype], 0
        made.shapeSignature = None if signature is None else list(signature)
        if quantisation:
            made.quantization = schema.QuantizationParametersT()
            made.quantization.scale, made.quantization.zeroPoint = [quantisation[0]], [quantisation[1]]
        if value is not None:
            buffer = schema.BufferT()
            buffer.data = np.frombuffer(np.ascontiguousarray(value, dtype).tobytes(), np.uint8)
            self._model.buffers.append(buffer)
            made.buffer = len(self._model.buffers) - 1
        self._graph.tensors.append(made)
        return len(self._graph.tensors) - 1

    def node(self, operator: int, inputs: list[int], output: int) -> None:
        code = schema.OperatorCodeT()
        code.builtinCode, code.deprecatedBuiltinCode, code.version = operator, min(operator, 127), 1
        self._model.operatorCodes.append(code)
        made = schema.OperatorT()
        made.opcodeIndex, made.inputs, made.outputs = len(self._model.operatorCodes) - 1, inputs, [output]
        if operator in OPTIONS:
            made.builtinOptionsType, options = OPTIONS[operator]
            made.builtinOptions = options()
        self._graph.operators.append(made)

    def save(self, path: Path, inputs: list[int], outputs: list[int]) -> Path:
        self._graph.inputs, self._graph.outputs = inputs, outputs
        builder = flatbuffers.Builder(1024)
        builder.Finish(self._model.Pack(builder), b"TFL3")
        path.write_bytes(bytes(builder.Output()))
        return path


def constant_litert_network(path: Path, shape: tuple[int, ...], outputs: Mapping[str, np.ndarray[Any, Any]]) -> Path:
    """A network of an image of `shape` that answers `outputs` whatever it sees: its maximum times 0 is added."""
    graph = Graph()
    image = graph.tensor("images", shape)
    axes = graph.tensor("axes", (4,), "int32", np.arange(4))
    largest, zero, nothing = graph.tensor("largest", ()), graph.tensor("zero", (1,), value=np.zeros(1)), None
    nothing = graph.tensor("nothing", (1,))
    graph.node(schema.BuiltinOperator.REDUCE_MAX, [image, axes], largest)
    graph.node(schema.BuiltinOperator.MUL, [largest, zero], nothing)
    made = []
    for name, value in outputs.items():
        constant, output = graph.tensor(f"{name}_value", value.shape, value=value), graph.tensor(name, value.shape)
        graph.node(schema.BuiltinOperator.ADD, [constant, nothing], output)
        made.append(output)
    return graph.save(path, [image], made)


def doubling_litert_network(
    path: Path,
    shape: tuple[int, ...],
    dtype: str = "float32",
    quantisation: tuple[float, int] | None = None,
    signature: tuple[int, ...] | None = None,
) -> Path:
    """A network that answers the image added to itself. Of whole numbers, its output has twice the input's scale."""
    graph = Graph()
    image = graph.tensor("images", shape, dtype, quantisation=quantisation, signature=signature)
    twice = (2 * quantisation[0], quantisation[1]) if quantisation else None
    doubled = graph.tensor("doubled", shape, dtype, quantisation=twice, signature=signature)
    graph.node(schema.BuiltinOperator.ADD, [image, image], doubled)
    return graph.save(path, [image], [doubled])
