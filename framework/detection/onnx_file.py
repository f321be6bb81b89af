"""What an ONNX file says about its network, without a library: the inputs, the outputs and the user's own entries.

An ONNX file is one protobuf message (github.com/onnx/onnx, onnx/onnx.proto); of its hundreds of fields a dozen are
read here, and tensors are stepped over.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from framework.errors import DataError

# Field numbers of onnx.proto
MODEL_GRAPH, MODEL_METADATA = 7, 14
GRAPH_NODE, GRAPH_INITIALIZER, GRAPH_INPUT, GRAPH_OUTPUT = 1, 5, 11, 12
TENSOR_NAME, VALUE_NAME, VALUE_TYPE, TYPE_TENSOR, TENSOR_ELEMENT, TENSOR_SHAPE = 8, 1, 2, 1, 1, 2
SHAPE_DIMENSION, DIMENSION_VALUE, ENTRY_KEY, ENTRY_VALUE = 1, 1, 1, 2
DTYPES = {1: "float32", 2: "uint8", 3: "int8", 6: "int32", 7: "int64", 10: "float16", 11: "float64"}

VARINT, EIGHT_BYTES, LENGTH_DELIMITED, FOUR_BYTES = 0, 1, 2, 5  # protobuf's wire types


@dataclass(frozen=True)
class TensorType:
    """One input or output of a network."""

    name: str
    dtype: str  # numpy's name
    shape: tuple[int, ...]  # 0 = any length

    def __str__(self) -> str:
        return f"{self.name} ({', '.join(str(n) if n else 'any' for n in self.shape)}) {self.dtype}"


@dataclass(frozen=True)
class Signature:
    """The inputs and outputs of a network."""

    inputs: tuple[TensorType, ...]
    outputs: tuple[TensorType, ...]
    metadata: Mapping[str, str]  # entries that the exporter left


def read_signature(path: Path, content: bytes) -> Signature:
    """The signature of the network in the ONNX file `path` with this `content`. Raises DataError where it has none."""
    try:
        signature = _signature(memoryview(content))
    except (IndexError, ValueError, UnicodeDecodeError) as error:
        raise DataError(f"{path} is not an ONNX file or is damaged: {error}") from error
    if not signature.inputs or not signature.outputs:
        raise DataError(f"{path} is not an ONNX file or is damaged: it describes no network")
    return signature


def _signature(model: memoryview) -> Signature:
    inputs, outputs, constants, metadata = [], [], set(), {}
    for number, value in _fields(model):
        if number == MODEL_METADATA:
            entry = dict(_fields(_message(value)))
            metadata[_text(entry.get(ENTRY_KEY))] = _text(entry.get(ENTRY_VALUE))
        if number != MODEL_GRAPH:
            continue
        for part, content in _fields(_message(value)):
            if part == GRAPH_INPUT:
                inputs.append(_tensor_type(_message(content)))
            elif part == GRAPH_OUTPUT:
                outputs.append(_tensor_type(_message(content)))
            elif part == GRAPH_INITIALIZER:
                constants.add(_text(dict(_fields(_message(content))).get(TENSOR_NAME)))
    # before version 4 of the format, weights had to be listed among the inputs
    return Signature(tuple(i for i in inputs if i.name not in constants), tuple(outputs), metadata)


def _tensor_type(value_info: memoryview) -> TensorType:
    fields = dict(_fields(value_info))
    tensor = dict(_fields(_message(dict(_fields(_message(fields.get(VALUE_TYPE)))).get(TYPE_TENSOR))))
    shape = [
        dict(_fields(_message(dimension))).get(DIMENSION_VALUE, 0)
        for number, dimension in _fields(_message(tensor.get(TENSOR_SHAPE)))
        if number == SHAPE_DIMENSION
    ]
    element = tensor.get(TENSOR_ELEMENT)
    dtype = DTYPES.get(element, "") if isinstance(element, int) else ""
    return TensorType(_text(fields.get(VALUE_NAME)), dtype or "unknown", tuple(n for n in shape if isinstance(n, int)))


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The fields of a protobuf message in order: number, and the integer or the bytes."""
    place = 0
    while place < len(message):
        key, place = _varint(message, place)
        number, wire_type = key >> 3, key & 7
        if wire_type == VARINT:
            value, place = _varint(message, place)
            yield number, value
            continue
        if wire_type == LENGTH_DELIMITED:
            length, place = _varint(message, place)
        elif wire_type in (EIGHT_BYTES, FOUR_BYTES):
            length = 8 if wire_type == EIGHT_BYTES else 4
        else:
            raise ValueError(f"wire type {wire_type} at byte {place}")
        if place + length > len(message):
            raise ValueError("it ends too early")
        yield number, message[place : place + length]
        place += length


def _varint(message: memoryview, place: int) -> tuple[int, int]:
    """An integer of 7 bits a byte, the low ones first, and the place behind it."""
    value = shift = 0
    while True:
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
        shift += 7
        if shift > 63:
            raise ValueError(f"no integer at byte {place}")


def _message(value: int | memoryview | None) -> memoryview:
    if isinstance(value, int):
        raise ValueError("an integer in place of a message")
    return memoryview(b"") if value is None else value


def _text(value: int | memoryview | None) -> str:
    return bytes(_message(value)).decode()
