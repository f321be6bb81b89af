"""Runtime of ONNX networks."""

from __future__ import annotations

import ast
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from framework.config.validation import LONGEST_SIDE, require
from framework.data import Array, Float32, UInt8
from framework.detection.masks.letterbox import ImageFormat, Letterbox, Placement, network_input
from framework.errors import ConfigError, DataError, import_optional, in_one_line
from framework.files.hashing import path_hash
from framework.files.search_paths import candidates

log = logging.getLogger(__name__)

if TYPE_CHECKING:
    from onnxruntime import InferenceSession, NodeArg

Outputs = dict[str, Float32]
Shape = tuple[int, ...]  # 0 = dynamic
INPUT_DTYPES = {"tensor(float)": "float32", "tensor(float16)": "float16", "tensor(uint8)": "uint8"}  # -> numpy dtype
SIZE_DTYPES = {"tensor(float)": "float32", "tensor(int64)": "int64", "tensor(int32)": "int32"}
PIXEL_MASK = "pixel_mask"  # 1 = pixel of the image, in DETR networks of transformers
SIZE_INPUTS = ("orig_target_sizes", "im_shape", "scale_factor", PIXEL_MASK)  # of RT-DETR, PaddleDetection and DETR
SHOWN_NAMES = 5  # maximum number of class names in messages
CUDA = "CUDAExecutionProvider"


class OnnxNetwork:
    """An ONNX network with one image as input, and optionally the image size.

    The number of threads is that of OpenCV (`threads` in the config). Idle threads sleep, because mapping runs at the
    same time.

    Attributes:
        shape: The size of the input (height, width), px.
        dtype: The NumPy type of the input: float32, float16 or uint8.
        channels_last: True = the input is (1, H, W, 3), False = (1, 3, H, W) or (3, H, W).
        integers: The names of the integer outputs.
    """

    def __init__(self, path: Path, sha256: str, device: str, input_size: int) -> None:
        """Load a network.

        Args:
            path: The ONNX file, see `find_file`.
            sha256: The expected hash; "" = any.
            device: auto, cpu or cuda.
            input_size: The side of the square input of a network with dynamic size, px; 0 = from the metadata.

        Raises:
            DataError: The file is missing or damaged, has another hash, or cannot be run.
            ConfigError: onnxruntime or the device is missing, or `input_size` does not fit the network.
        """
        self.path = find_file(path)
        self.sha256 = checked_hash(self.path, sha256)
        self._session = _loaded(self.path, device)
        self.metadata = ExportMetadata.parse(self._session.get_modelmeta().custom_metadata_map)
        sizes = [one for one in self._session.get_inputs() if one.name in SIZE_INPUTS and one.type in SIZE_DTYPES]
        image, shape = _image_input(self.path, [one for one in self._session.get_inputs() if one not in sizes])
        if image.type not in INPUT_DTYPES:
            wanted = ", ".join(INPUT_DTYPES.values())
            raise DataError(f"{self.path}: expected one of {wanted} as input, got {_described(image)}")
        self._name = image.name
        self.dtype = INPUT_DTYPES[image.type]
        self._batched = len(shape) == 4  # networks of Detectron2 and torchvision have the input (3, H, W)
        self.channels_last = shape[-1] == 3 and shape[-3] != 3  # (1, H, W, 3), as in TensorFlow networks
        self.shape = _input_shape(self.path, image, self.channels_last, input_size, self.metadata)
        self._sizes = {one.name: _size_values(one, self.shape) for one in sizes}
        self.integers = frozenset(one.name for one in self._session.get_outputs() if "int" in one.type)

    def __call__(self, image: Array) -> Outputs:
        """Run the network on an image (H, W, 3) and return the float32 outputs by name.

        Raises:
            DataError: The network fails, or its outputs are not finite.
        """
        blob = image if self.channels_last else image.transpose(2, 0, 1)
        blob = blob[None] if self._batched else blob
        names = [output.name for output in self._session.get_outputs()]
        try:
            arrays = self._session.run(names, {self._name: np.ascontiguousarray(blob), **self._sizes})
        except Exception as error:  # errors of onnxruntime have no common base class
            raise DataError(
                f"{self.path}: expected a successful run in onnxruntime, got an error ({in_one_line(error)})"
            ) from error
        outputs = {name: np.asarray(array, np.float32) for name, array in zip(names, arrays, strict=True)}
        for name, array in outputs.items():
            if not np.isfinite(array).all():
                raise DataError(f"{self.path}: expected finite values in the output {name}, got NaN or infinity")
        return outputs


class ImageNetworkParameters(Protocol):
    """Common parameters of detectors with an ONNX network."""

    weights: Path
    sha256: str
    input_size: int
    placement: Placement
    padding: int
    bgr: bool
    black_level: float
    white_level: float
    device: str


class ImageNetwork:
    """An ONNX network with preprocessing for images of any size.

    Attributes:
        shape: The size of the input (height, width), px.
        format: The image format of the input, from the parameters; may be replaced.
    """

    def __init__(self, detector: ImageNetworkParameters) -> None:
        """Load the network.

        Raises:
            ConfigError: A parameter is out of bounds, or onnxruntime or the device is missing.
            DataError: The file is missing or damaged, has another hash, or cannot be run.
        """
        path, device, black, white = detector.weights, detector.device, detector.black_level, detector.white_level
        digits = "64 hexadecimal digits or an empty string"
        require(len(detector.sha256) in (0, 64), "detector.sha256", detector.sha256, digits)
        allowed = f"0 (size of the network) or a value in [1, {LONGEST_SIDE}] px"
        require(0 <= detector.input_size <= LONGEST_SIDE, "detector.input_size", detector.input_size, allowed)
        require(0 <= detector.padding <= 255, "detector.padding", detector.padding, "a value in [0, 255]")
        finite = bool(np.isfinite([black, white]).all())
        require(
            finite and black != white, "detector.white_level", white, f"a finite value other than black_level={black}"
        )
        require(device in ("auto", "cpu", "cuda"), "detector.device", device, "auto, cpu or cuda")
        onnx = "an ONNX file (converted with tf2onnx, see docs/guides/detectors.md)"
        require(path.suffix.lower() != ".tflite", "detector.weights", path, onnx)
        self._network = OnnxNetwork(path, detector.sha256, device, detector.input_size)
        fits = self._network.dtype != "uint8" or (black, white) in ((0, 255), (0, 1))  # defaults of detectors
        levels, whole = f"{black} and {white}", "0 and 255 for a network with integer input"
        require(fits, "detector.black_level and detector.white_level", levels, whole)
        self.shape = self._network.shape  # (height, width) px
        self.channels_last = self._network.channels_last  # the input is (1, H, W, 3)
        self.metadata = self._network.metadata
        self.integers = self._network.integers
        self.format = ImageFormat(detector.placement, detector.bgr, black, white, detector.padding)

    def __call__(self, color: UInt8) -> tuple[Outputs, Letterbox]:
        """Run the network on an RGB image (h, w, 3) and return the outputs by name and the letterbox."""
        wanted = self.format
        letterbox = Letterbox.fit(color.shape[:2], self.shape, wanted.placement)
        canvas = letterbox.fill(color, wanted.padding)
        image = network_input(canvas, self._network.dtype, wanted.bgr, wanted.black, wanted.white)
        return self._network(image), letterbox

    def check_names(self, labels: Sequence[str], label_space: str) -> None:
        """Compare the class names in the file with the labels, and log a warning if names differ.

        Raises:
            ConfigError: The file has another number of classes.
        """
        names = self.metadata.names
        if names and len(names) != len(labels):
            raise ConfigError(
                f"detector.label_space: expected the class names of {self._network.path.name} ({_listed(names)}), got "
                f"{len(labels)} names of {label_space}; set detector.label_space to a text file with these names, one "
                "per line"
            )
        different = [(k, a, b) for k, (a, b) in enumerate(zip(names, labels, strict=False)) if a != b]
        if different:
            log.warning(
                "%s: %d of its %d classes differ from detector.label_space=%s: class %d is %r, expected %r",
                self._network.path.name, len(different), len(names), label_space, *different[0],
            )  # fmt: skip

    def outputs_for_black(self) -> Outputs:
        """Return the outputs for a black image, for example to check their shapes."""
        outputs, _ = self(np.zeros((*self.shape, 3), np.uint8))
        return outputs


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    return f"{', '.join(names[:SHOWN_NAMES])}{more}"


def _loaded(path: Path, device: str) -> InferenceSession:
    onnxruntime = import_optional("onnxruntime", "runs ONNX files", "onnx")
    cuda = CUDA in onnxruntime.get_available_providers()
    if device == "cuda" and not cuda:
        raise ConfigError("detector.device: expected cpu or auto without onnxruntime-gpu and a GPU, got cuda")
    if cuda and device != "cpu":
        onnxruntime.preload_dlls()  # CUDA libraries of pip packages, which the dynamic linker does not search
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = cv2.getNumThreads()
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers = [CUDA] * (cuda and device != "cpu") + ["CPUExecutionProvider"]
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # errors of onnxruntime have no common base class
        raise DataError(
            f"{path}: expected an ONNX file for onnxruntime, got an error ({in_one_line(error)})"
        ) from error
    if device == "cuda" and CUDA not in session.get_providers():
        raise ConfigError(
            "detector.device: expected a GPU that onnxruntime can initialize, got none; set detector.device=cpu or auto"
        )
    return session


def _image_input(path: Path, inputs: Sequence[NodeArg]) -> tuple[NodeArg, Shape]:
    """Return the single image input of a network and its shape."""
    found = ", ".join(map(_described, inputs))
    wanted = "expected one image (1, 3, H, W), (3, H, W) or (1, H, W, 3)"
    if len(inputs) != 1:
        raise DataError(f"{path}: {wanted}, got {len(inputs)} inputs: {found}")
    shape = _shape(inputs[0])
    one_image = shape[0] == 3 if len(shape) == 3 else len(shape) == 4 and shape[0] <= 1 and 3 in (shape[1], shape[3])
    if not one_image:
        raise DataError(f"{path}: {wanted}, got {found}")
    return inputs[0], shape


def _input_shape(
    path: Path, image: NodeArg, channels_last: bool, input_size: int, metadata: ExportMetadata
) -> tuple[int, int]:
    """Return the size of the input (height, width), px."""
    shape, described = _shape(image), _described(image)
    height, width = shape[1:3] if channels_last else shape[-2:]
    if height and width:
        if input_size and (height, width) != (input_size, input_size):
            raise ConfigError(
                f"detector.input_size: expected 0 or the size of the network ({described}), got {input_size} for {path}"
            )
        return height, width
    open_height, open_width = (input_size, input_size) if input_size else metadata.image_size
    if not (open_height and open_width):
        raise ConfigError(
            f"detector.input_size: expected a size in px, got 0 for {path} with dynamic input size ({described}); set "
            "detector.input_size=640, or the size of the training images"
        )
    return height or open_height, width or open_width


def _size_values(tensor: NodeArg, shape: tuple[int, int]) -> Array:
    """Return the value of an input of the image size (1, 2), for boxes in px of the network's input, or a mask."""
    height, width = shape
    if tensor.name == PIXEL_MASK:
        _, rows, columns = _shape(tensor)
        return np.ones((1, rows or height, columns or width), SIZE_DTYPES[tensor.type])
    values = {"orig_target_sizes": (width, height), "im_shape": (height, width), "scale_factor": (1, 1)}
    return np.array([values[tensor.name]], SIZE_DTYPES[tensor.type])


def _described(tensor: NodeArg) -> str:
    shape = ", ".join(str(n or "any") for n in _shape(tensor))
    return f"{tensor.name} ({shape}) {INPUT_DTYPES.get(tensor.type, tensor.type)}"


def _shape(tensor: NodeArg) -> Shape:
    return tuple(n if isinstance(n, int) else 0 for n in tensor.shape)  # a dynamic dimension is a name or None


def find_file(path: Path) -> Path:
    """Return the path of an existing file.

    A relative path is searched in the working directory, then in the project folder.

    Raises:
        DataError: The file is missing.
    """
    for candidate in candidates(path):
        if candidate.is_file():
            return candidate
    searched = " or ".join(str(candidate.resolve()) for candidate in candidates(path))
    raise DataError(
        f"detector.weights: expected the file {searched}, got none; put the network there or set another path"
    )


def checked_hash(path: Path, sha256: str) -> str:
    """Return the SHA-256 hash of a file.

    Raises:
        DataError: The file is unreadable, or the hash differs from a nonempty `sha256`.
    """
    try:
        found = path_hash(path)
    except OSError as error:
        raise DataError(
            f"detector.weights: {path}: expected a readable file, got an error ({error.strerror})"
        ) from error
    if sha256 and found != sha256.lower():
        raise DataError(f"detector.weights: {path}: expected sha256 {sha256}, got {found}")
    return found


@dataclass(frozen=True)
class ExportMetadata:
    """Metadata that the exporter stored in an ONNX file.

    Missing values are empty or 0.
    """

    names: tuple[str, ...] = ()  # class names, in the order of the scores
    image_size: tuple[int, int] = (0, 0)  # (height, width) px of the exported input; 0 = unknown
    author: str = ""

    @classmethod
    def parse(cls, texts: Mapping[str, str]) -> ExportMetadata:
        """Parse the metadata from key-value pairs with Python or JSON literals."""
        return cls(_names(texts.get("names", "")), _size(texts.get("imgsz", "")), texts.get("author", ""))


def _names(text: str) -> tuple[str, ...]:
    """Parse class names in a text such as {0: "person", ...}."""
    names = _literal(text)
    if not isinstance(names, dict):
        return ()
    by_number = {int(key): str(name) for key, name in names.items() if str(key).isdecimal()}
    return tuple(by_number[k] for k in range(len(names))) if set(by_number) == set(range(len(names))) else ()


def _size(text: str) -> tuple[int, int]:
    """Parse the image size [height, width], px, or a single number for both."""
    sides = _literal(text)
    height, width = sides if isinstance(sides, list) and len(sides) == 2 else (sides, sides)
    if isinstance(height, int) and isinstance(width, int) and height > 0 and width > 0:
        return height, width
    return 0, 0


def _literal(text: str) -> object:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None
