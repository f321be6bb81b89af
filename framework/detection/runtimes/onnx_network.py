"""A network in an ONNX file, run by onnxruntime."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from framework.data import Array, Float32
from framework.errors import ConfigError, DataError, in_one_line
from framework.files.hashing import path_hash
from framework.files.search_paths import candidates

if TYPE_CHECKING:
    from onnxruntime import InferenceSession, NodeArg

Shape = tuple[int, ...]  # 0 = any
INPUT_DTYPES = {"tensor(float)": "float32", "tensor(float16)": "float16", "tensor(uint8)": "uint8"}  # numpy's names


class OnnxNetwork:
    """A network from one image to named arrays, on the CPU or with CUDA.

    It takes as many threads as OpenCV, which `threads` of the config sets: onnxruntime would take all cores. Its idle
    threads sleep, because the map is built at the same time.
    """

    def __init__(self, path: Path, sha256: str, device: str, input_size: int) -> None:
        """Loads the network of the file `path`; see `find_file` for a relative one.

        sha256: what the file must have, "" = whatever it is. device: auto, cpu or cuda. input_size: px, the side of
        the square input of a network that takes any size, 0 for one with a size of its own.

        Raises:
            DataError: the file is missing, damaged, not the expected one, or cannot be run.
            ConfigError: onnxruntime or the device is not there, or `input_size` does not fit the network.
        """
        self.path = find_file(path)
        self.sha256 = checked_hash(self.path, sha256)
        self._session = _loaded(self.path, device)
        self.metadata = ExportMetadata.parse(self._session.get_modelmeta().custom_metadata_map)
        image, shape = _image_input(self.path, self._session.get_inputs())
        if image.type not in INPUT_DTYPES:
            wanted = ", ".join(INPUT_DTYPES.values())
            raise DataError(f"{self.path}: the input must be one of {wanted}, found {_described(image)}")
        self._name = image.name
        self.dtype = INPUT_DTYPES[image.type]
        self.channels_last = shape[3] == 3 and shape[1] != 3  # (1, H, W, 3), as in networks from TensorFlow
        self.shape = _input_shape(self.path, image, self.channels_last, input_size, self.metadata)

    def __call__(self, image: Array) -> Outputs:
        """The outputs by name, in float32, for an image (H, W, 3) of the network's `shape` and dtype.

        Raises DataError when the network fails or computes numbers that are not finite.
        """
        blob = image[None] if self.channels_last else image.transpose(2, 0, 1)[None]
        names = [output.name for output in self._session.get_outputs()]
        try:
            outputs = self._session.run(names, {self._name: np.ascontiguousarray(blob)})
        except Exception as error:  # onnxruntime has no base of its own
            raise DataError(f"{self.path} failed in onnxruntime: {one_line(error)}") from error
        return finite_outputs(self.path, zip(names, outputs, strict=True))


def _loaded(path: Path, device: str) -> InferenceSession:
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError("onnxruntime, which runs ONNX files, is not there: pip install instancemap[onnx]") from error
    cuda = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    if device == "cuda" and not cuda:
        raise ConfigError("detector.device must be cpu or auto without onnxruntime-gpu and a GPU, found cuda")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = cv2.getNumThreads()
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers = ["CUDAExecutionProvider"] * (cuda and device != "cpu") + ["CPUExecutionProvider"]
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime has no base of its own
        raise DataError(f"{path} is not an ONNX file that onnxruntime can load: {one_line(error)}") from error
    if device == "cuda" and "CUDAExecutionProvider" not in session.get_providers():
        raise ConfigError("detector.device must be cpu or auto where CUDA cannot be started, found cuda")
    return session


def _image_input(path: Path, inputs: Sequence[NodeArg]) -> tuple[NodeArg, Shape]:
    """The only input, an image, and its shape. Raises DataError for a network with other inputs."""
    found = ", ".join(map(_described, inputs))
    wanted = "expected one image (1, 3, H, W) or (1, H, W, 3)"
    if len(inputs) != 1:
        raise DataError(f"{path}: {wanted}, found {len(inputs)} inputs: {found}")
    shape = _shape(inputs[0])
    if len(shape) != 4 or shape[0] > 1 or 3 not in (shape[1], shape[3]):
        raise DataError(f"{path}: {wanted}, found {found}")
    return inputs[0], shape


def _input_shape(
    path: Path, image: NodeArg, channels_last: bool, input_size: int, metadata: ExportMetadata
) -> tuple[int, int]:
    """(height, width) in px of a network's input of this shape, 0 = any.

    What is open comes from `input_size`, else from what the file says that it was exported for.
    """
    shape, described = _shape(image), _described(image)
    height, width = shape[1:3] if channels_last else shape[2:]
    if height and width:
        if input_size and (height, width) != (input_size, input_size):
            raise ConfigError(
                f"detector.input_size must be 0 or the network's own, found {input_size}: {path} takes {described}"
            )
        return height, width
    open_height, open_width = (input_size, input_size) if input_size else metadata.image_size
    if not (open_height and open_width):
        raise ConfigError(f"detector.input_size must be given in px: {path} takes any size: {described}")
    return height or open_height, width or open_width


def _described(tensor: NodeArg) -> str:
    shape = ", ".join(str(n or "any") for n in _shape(tensor))
    return f"{tensor.name} ({shape}) {INPUT_DTYPES.get(tensor.type, tensor.type)}"


def _shape(tensor: NodeArg) -> Shape:
    """With 0 for any: such a dimension has a name, or none."""
    return tuple(n if isinstance(n, int) else 0 for n in tensor.shape)


def find_file(path: Path, parameter: str = "detector.weights") -> Path:
    """The file `path` of a parameter. A relative one is tried from the working folder, then from the project's."""
    for candidate in candidates(path):
        if candidate.is_file():
            return candidate
    looked = " or ".join(str(candidate.resolve()) for candidate in candidates(path))
    raise DataError(f"{parameter}: there is no file {looked}; put the network there, or name another")


def checked_hash(path: Path, sha256: str) -> str:
    """The SHA-256 (hex) of a file. Raises DataError when it cannot be read, or is not `sha256`; "" = whatever it is."""
    try:
        found = path_hash(path)
    except OSError as error:
        raise DataError(f"detector.weights: {path} could not be read: {error.strerror}") from error
    if sha256 and found != sha256.lower():
        raise DataError(f"detector.weights: {path} has the sha256 {found}, expected {sha256}")
    return found


@dataclass(frozen=True)
class ExportMetadata:
    """Of a file that says nothing, or says it otherwise, all is empty."""

    names: tuple[str, ...] = ()  # of the classes, in the order of the scores
    image_size: tuple[int, int] = (0, 0)  # (height, width) px that it was exported for, 0 = not said
    author: str = ""

    @classmethod
    def parse(cls, texts: Mapping[str, str]) -> ExportMetadata:
        """From the file's own pairs, whose values are Python's or JSON's literals."""
        return cls(_names(texts.get("names", "")), _size(texts.get("imgsz", "")), texts.get("author", ""))


def _names(text: str) -> tuple[str, ...]:
    """{0: "person", ...}, with numbers or numerals as keys."""
    names = _literal(text)
    if not isinstance(names, dict):
        return ()
    by_number = {int(key): str(name) for key, name in names.items() if str(key).isdecimal()}
    return tuple(by_number[k] for k in range(len(names))) if set(by_number) == set(range(len(names))) else ()


def _size(text: str) -> tuple[int, int]:
    """[height, width], or one number for both."""
    sides = _literal(text)
    height, width = sides if isinstance(sides, list) and len(sides) == 2 else (sides, sides)
    if isinstance(height, int) and isinstance(width, int) and height > 0 and width > 0:
        return height, width
    return 0, 0


def _literal(text: str) -> object:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None


Outputs = dict[str, Float32]


def finite_outputs(path: Path, named: Iterable[tuple[str, Array]]) -> Outputs:
    """The outputs by name in float32. Raises DataError when one holds numbers that are not finite."""
    outputs = {name: np.asarray(array, np.float32) for name, array in named}
    for name, array in outputs.items():
        if not np.isfinite(array).all():
            raise DataError(f"{path}: the output {name} holds values that are not finite")
    return outputs


def one_line(error: Exception) -> str:
    """The beginning of what a library's exception says, for a message: some add a whole trace."""
    return in_one_line(error)[:300]
