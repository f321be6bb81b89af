"""Files that are read whole, up to the size that files of their kind can have."""

from __future__ import annotations

import hashlib
from pathlib import Path

from framework.errors import DataError

MOST_TEXT = 2**28  # bytes, of text and JSON; an hour of poses has 10 MB


def read_bytes(path: Path, most: int) -> bytes:
    """What a file holds. Raises DataError, naming it, when it cannot be read or has more than `most` bytes."""
    try:
        size = path.stat().st_size
        if size > most:
            raise DataError(f"{path} has {size} bytes, more than the {most} that such a file can have")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} could not be read: {error.strerror or error}") from error


def file_hash(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Likewise of UTF-8, with or without a byte order mark, which is left out."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} could not be read as text: {error}") from error
