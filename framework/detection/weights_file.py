"""The file that `detector.weights` names: where it is, whether it is the expected one, and what size it takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from framework.detection.export_metadata import ExportMetadata
from framework.errors import ConfigError, DataError
from framework.files.hashing import path_hash
from framework.files.search_paths import candidates


def find_file(path: Path) -> Path:
    """The file `path`. A relative one is tried from the working folder, then from the project's."""
    path = path.expanduser()
    for candidate in candidates(path):
        if candidate.is_file():
            return candidate
    looked = " or ".join(str(candidate.resolve()) for candidate in candidates(path))
    raise DataError(f"detector.weights: there is no file {looked}; put the network there, or name another")


def checked_hash(path: Path, sha256: str) -> str:
    """The SHA-256 (hex) of a file. Raises DataError when it cannot be read, or is not `sha256`; "" = whatever it is."""
    try:
        found = path_hash(path)
    except OSError as error:
        raise DataError(f"detector.weights: {path} could not be read: {error.strerror}") from error
    if sha256 and found != sha256.lower():
        raise DataError(f"detector.weights: {path} has the sha256 {found}, expected {sha256}")
    return found


def input_shape(
    path: Path, described: str, sides: Sequence[int], input_size: int, metadata: ExportMetadata
) -> tuple[int, int]:
    """(height, width) in px of a network's input with the `sides` height and width, 0 = any.

    What is open comes from `input_size`, else from what the file says that it was exported for.
    """
    height, width = sides
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
