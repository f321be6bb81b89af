"""The file of a parameter such as `detector.weights`: its path and its checksum."""

from __future__ import annotations

from pathlib import Path

from framework.errors import DataError
from framework.files.hashing import path_hash
from framework.files.search_paths import candidates


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
