"""A network in a .tflite file, run by LiteRT (TensorFlow Lite, as it was called)."""

from __future__ import annotations

import ast
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from framework.data import Array
from framework.detection.hub.weights_file import (
    Shape,
    checked_hash,
    find_file,
    image_input,
    input_shape,
    is_channels_last,
)
from framework.detection.runtimes.export_metadata import ExportMetadata
from framework.detection.runtimes.network_outputs import Outputs, finite_outputs, one_line
from framework.errors import ConfigError, DataError

if TYPE_CHECKING:
    from ai_edge_litert.interpreter import Interpreter

Tensor = Mapping[str, Any]  # what the interpreter tells of an input or output
INPUT_DTYPES = ("float32", "uint8")  # of images; int8 and uint8 with a scale are made from float32 here
METADATA_FILES = ("metadata.json", "temp_meta.txt", "TFLITE_ASSOCIATED_FILE/metadata.json")  # Ultralytics'
LARGEST_METADATA = 2**20  # bytes
NO_METADATA = (
    zipfile.BadZipFile,
    zlib.error,
    RuntimeError,
    OSError,
    ValueError,
    SyntaxError,
    AttributeError,
    MemoryError,
)
"""What Python's readers raise on an archive that is none, is damaged, or holds something else."""


class LitertNetwork:
    """A network from one image to named arrays, on the CPU; it is used as an `OnnxNetwork` is.

    Inputs and outputs of a quantised network are real numbers here. It takes as many threads as OpenCV, which `threads`
    of the config sets.
    """

    def __init__(self, path: Path, sha256: str, device: str, input_size: int) -> None:
        """Loads the network of the file `path`; see `OnnxNetwork`."""
        self.path = find_file(path)
        self.sha256 = checked_hash(self.path, sha256)
        self.metadata = _read_metadata(self.path)
        self._interpreter = _loaded(self.path, device)
        image, shape = image_input(self.path, self._interpreter.get_input_details(), _signature, _described)
        dtype = np.dtype(image["dtype"]).name
        if not (dtype in INPUT_DTYPES or (dtype == "int8" and _scale(image))):
            wanted = f"{', '.join(INPUT_DTYPES)} or int8 with a scale"
            raise DataError(f"{self.path}: the input must be {wanted}, found {_described(image)}")
        self.channels_last = is_channels_last(shape)
        self.shape = input_shape(self.path, _described(image), shape, input_size, self.metadata)
        whole = (1, *self.shape, 3) if self.channels_last else (1, 3, *self.shape)
        try:
            self._interpreter.resize_tensor_input(image["index"], whole, strict=True)
            self._interpreter.allocate_tensors()
        except (RuntimeError, ValueError) as error:
            raise DataError(f"{self.path} failed in LiteRT: {one_line(error)}") from error
        self._input = image
        self.dtype = "float32" if _scale(image) else dtype

    def __call__(self, image: Array) -> Outputs:
        """The outputs by name, in float32, for an image (H, W, 3) of the network's `shape` and dtype.

        Raises DataError when the network fails or computes numbers that are not finite.
        """
        blob = image[None] if self.channels_last else image.transpose(2, 0, 1)[None]
        try:
            self._interpreter.set_tensor(self._input["index"], np.ascontiguousarray(_quantised(blob, self._input)))
            self._interpreter.invoke()
            details = self._interpreter.get_output_details()
            outputs = [_real(self._interpreter.get_tensor(detail["index"]), detail) for detail in details]
        except (RuntimeError, ValueError) as error:
            raise DataError(f"{self.path} failed in LiteRT: {one_line(error)}") from error
        names = [detail["name"] for detail in details]
        if len(set(names)) < len(names):
            names = [f"{name} {k}" for k, name in enumerate(names)]
        return finite_outputs(self.path, zip(names, outputs, strict=True))


def _loaded(path: Path, device: str) -> Interpreter:
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        raise ConfigError("LiteRT, which runs .tflite files, is not there: pip install instancemap[litert]") from error
    if device == "cuda":
        raise ConfigError(f"detector.device must be cpu or auto for a .tflite file, found cuda: {path}")
    try:
        return Interpreter(str(path), num_threads=cv2.getNumThreads())
    except (RuntimeError, ValueError) as error:
        raise DataError(f"{path} is not a .tflite file that LiteRT can load: {one_line(error)}") from error


def _signature(tensor: Tensor) -> Shape:
    """The shape, with 0 for any."""
    signature = tensor.get("shape_signature")
    shape = tensor["shape"] if signature is None or len(signature) == 0 else signature
    return tuple(max(0, int(side)) for side in shape)


def _scale(tensor: Tensor) -> float:
    """Of a quantised tensor: real = scale * (stored - zero point). 0 = it is none."""
    return float(tensor["quantization"][0])


def _quantised(values: Array, tensor: Tensor) -> Array:
    scale, zero_point = tensor["quantization"]
    if not scale:
        return values
    limits = np.iinfo(tensor["dtype"])
    stored = np.rint(values.astype(np.float32) / np.float32(scale)) + zero_point
    return np.asarray(stored.clip(limits.min, limits.max), tensor["dtype"])


def _real(values: Array, tensor: Tensor) -> Array:
    scale, zero_point = tensor["quantization"]
    return np.asarray((values.astype(np.float32) - zero_point) * np.float32(scale)) if scale else values


def _described(tensor: Tensor) -> str:
    shape = ", ".join(str(side or "any") for side in _signature(tensor))
    return f"{tensor['name']} ({shape}) {np.dtype(tensor['dtype']).name}"


def _read_metadata(path: Path) -> ExportMetadata:
    """Of the ZIP archive that may stand behind the network in its file."""
    try:
        with zipfile.ZipFile(path) as archive:
            name = next(name for name in METADATA_FILES if name in archive.namelist())
            with archive.open(name) as file:
                text = file.read(LARGEST_METADATA).decode("utf-8")
        content = json.loads(text) if name.endswith(".json") else ast.literal_eval(text)
        texts = {key: value if isinstance(value, str) else repr(value) for key, value in content.items()}
    except (StopIteration, *NO_METADATA):
        return ExportMetadata()  # no archive, or another one: nothing in it is needed
    return ExportMetadata.parse(texts)
