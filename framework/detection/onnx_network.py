"""A network in an ONNX file, run by onnxruntime or by OpenCV."""

from __future__ import annotations

import hashlib
import importlib.util
import logging
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from framework.data import Float32
from framework.detection.onnx_file import Signature, TensorType, read_signature
from framework.errors import ConfigError, DataError
from framework.files.search_paths import candidates

INPUT_DTYPES = ("float32", "float16", "uint8")

log = logging.getLogger(__name__)

Array = np.ndarray[Any, Any]
Outputs = dict[str, Float32]


class Runtime(Enum):
    """What runs a network."""

    auto = "auto"  # onnxruntime where it is installed, else OpenCV
    onnxruntime = "onnxruntime"
    opencv = "opencv"


class OnnxNetwork:
    """A network from one image to named arrays, on the CPU or with CUDA.

    It takes as many threads as OpenCV, which `threads` of the config sets: onnxruntime would take all cores. Its idle
    threads sleep, because the map is built at the same time.
    """

    def __init__(self, path: Path, sha256: str, runtime: Runtime, device: str, input_size: int) -> None:
        """Loads the network of the file `path`; see `find_file` for a relative one.

        sha256: what the file must have, "" = whatever it is. device: auto, cpu or cuda. input_size: px, the side of
        the square input of a network that takes any size, 0 for one with a size of its own.

        Raises:
            DataError: the file is missing, damaged, not the expected one, or cannot be run.
            ConfigError: the runtime or the device is not there, or `input_size` does not fit the network.
        """
        self.path = find_file(path)
        self.sha256, self.signature = _read_checked(self.path, sha256)
        self.input = _image_input(self.path, self.signature)
        self.shape = _input_shape(self.path, self.input, self.channels_last, input_size)
        chosen = _choose(runtime)
        load = _with_onnxruntime if chosen is Runtime.onnxruntime else _with_opencv
        try:
            self._run = load(self.path, self.signature, device)
        except ConfigError:
            raise
        except Exception as error:  # each runtime has its own
            raise DataError(f"{self.path} cannot be loaded by {chosen.value}: {_one_line(error)}") from error
        self.runtime = chosen

    @property
    def channels_last(self) -> bool:
        """Whether the input is (1, H, W, 3), as in networks from TensorFlow, and not (1, 3, H, W)."""
        return self.input.shape[3] == 3 and self.input.shape[1] != 3

    def __call__(self, image: Array) -> Outputs:
        """The outputs by name, in float32, for an image (H, W, 3) of the network's `shape` and dtype.

        Raises DataError when the network fails or computes numbers that are not finite.
        """
        blob = image[None] if self.channels_last else image.transpose(2, 0, 1)[None]
        try:
            outputs = self._run(np.ascontiguousarray(blob))
        except Exception as error:  # each runtime has its own
            raise DataError(f"{self.path} failed in {self.runtime.value}: {_one_line(error)}") from error
        arrays = {name: np.asarray(output, np.float32) for name, output in outputs.items()}
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise DataError(f"{self.path}: the output {name} holds values that are not finite")
        return arrays


def find_file(path: Path) -> Path:
    """The file `path`. A relative one is tried from the working folder, then from the project's."""
    path = path.expanduser()
    for candidate in candidates(path):
        if candidate.is_file():
            return candidate
    looked = " or ".join(str(candidate.resolve()) for candidate in candidates(path))
    raise DataError(f"detector.weights: there is no file {looked}; put the network there, or name another")


def _read_checked(path: Path, sha256: str) -> tuple[str, Signature]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"detector.weights: {path} could not be read: {error.strerror}") from error
    found = hashlib.sha256(content).hexdigest()
    if sha256 and found != sha256.lower():
        raise DataError(f"detector.weights: {path} has the sha256 {found}, expected {sha256}")
    return found, read_signature(path, content)


def _image_input(path: Path, signature: Signature) -> TensorType:
    described = ", ".join(str(tensor) for tensor in signature.inputs)
    wanted = "expected one image (1, 3, H, W) or (1, H, W, 3)"
    if len(signature.inputs) != 1:
        raise DataError(f"{path}: {wanted}, found {len(signature.inputs)} inputs: {described}")
    (image,) = signature.inputs
    if len(image.shape) != 4 or image.shape[0] > 1 or 3 not in (image.shape[1], image.shape[3]):
        raise DataError(f"{path}: {wanted}, found {described}")
    if image.dtype not in INPUT_DTYPES:
        raise DataError(f"{path}: the input must be one of {', '.join(INPUT_DTYPES)}, found {described}")
    return image


def _input_shape(path: Path, image: TensorType, channels_last: bool, input_size: int) -> tuple[int, int]:
    """(height, width) in px."""
    height, width = image.shape[1:3] if channels_last else image.shape[2:]
    if height and width:
        if input_size and (height, width) != (input_size, input_size):
            raise ConfigError(
                f"detector.input_size must be 0 or the network's own, found {input_size}: {path} takes {image}"
            )
        return height, width
    if not input_size:
        raise ConfigError(f"detector.input_size must be given in px: {path} takes any size: {image}")
    return height or input_size, width or input_size


def _choose(runtime: Runtime) -> Runtime:
    installed = importlib.util.find_spec("onnxruntime") is not None
    if runtime is Runtime.onnxruntime and not installed:
        raise ConfigError(
            "detector.runtime: onnxruntime is not installed: pip install instancemap[onnx], or choose opencv"
        )
    if runtime is not Runtime.auto:
        return runtime
    chosen = Runtime.onnxruntime if installed else Runtime.opencv
    log.info("runtime: %s%s", chosen.value, "" if installed else ", for onnxruntime is not installed")
    return chosen


def _with_onnxruntime(path: Path, signature: Signature, device: str) -> Callable[[Array], dict[str, Array]]:
    import onnxruntime

    cuda = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    if device == "cuda" and not cuda:
        raise ConfigError("detector.device must be cpu or auto without onnxruntime-gpu and a GPU, found cuda")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = cv2.getNumThreads()
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers = ["CUDAExecutionProvider"] * (cuda and device != "cpu") + ["CPUExecutionProvider"]
    session = onnxruntime.InferenceSession(str(path), options, providers=providers)
    if device == "cuda" and "CUDAExecutionProvider" not in session.get_providers():
        raise ConfigError("detector.device must be cpu or auto where CUDA cannot be started, found cuda")
    (image,) = signature.inputs
    names = [output.name for output in signature.outputs]
    return lambda blob: dict(zip(names, session.run(names, {image.name: blob}), strict=True))


def _with_opencv(path: Path, signature: Signature, device: str) -> Callable[[Array], dict[str, Array]]:
    if device == "cuda":
        raise ConfigError("detector.device must be cpu or auto with the runtime opencv, found cuda")
    network = cv2.dnn.readNetFromONNX(str(path))
    (image,) = signature.inputs
    names = [output.name for output in signature.outputs]

    def run(blob: Array) -> dict[str, Array]:
        network.setInput(blob, image.name)
        return dict(zip(names, network.forward(names), strict=True))

    return run


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
