"""The file that `detector.weights` names: where it is, whether it is the expected one, and what size it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from framework.detection.runtimes.export_metadata import ExportMetadata
from framework.errors import ConfigError, DataError
from framework.files.hashing import path_hash
from framework.files.search_paths import candidates

Tensor = TypeVar("Tensor")  # what a library tells of an input
Shape = tuple[int, ...]


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


def image_input(
    path: Path, inputs: Sequence[Tensor], shape_of: Callable[[Tensor], Shape], described: Callable[[Tensor], str]
) -> tuple[Tensor, Shape]:
    """A network's only input, an image, and its shape, 0 = any. Raises DataError for a network with another input."""
    shapes = [shape_of(tensor) for tensor in inputs]
    found = ", ".join(map(described, inputs))
    wanted = "expected one image (1, 3, H, W) or (1, H, W, 3)"
    if len(inputs) != 1:
        raise DataError(f"{path}: {wanted}, found {len(inputs)} inputs: {found}")
    (image,), (shape,) = inputs, shapes
    if len(shape) != 4 or shape[0] > 1 or 3 not in (shape[1], shape[3]):
        raise DataError(f"{path}: {wanted}, found {found}")
    return image, shape


def is_channels_last(shape: Shape) -> bool:
    """Whether an image is (1, H, W, 3), as in networks from TensorFlow."""
    return shape[3] == 3 and shape[1] != 3


def input_shape(path: Path, described: str, shape: Shape, input_size: int, metadata: ExportMetadata) -> tuple[int, int]:
    """(height, width) in px of a network's input of this shape, 0 = any.

    What is open comes from `input_size`, else from what the file says that it was exported for.
    """
    height, width = shape[1:3] if is_channels_last(shape) else shape[2:]
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
