"""Atomic writes and size-limited reads."""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from framework.errors import DataError

MAX_TEXT = 2**28  # maximum size of text and JSON files, bytes; one hour of poses takes 10 MB
_TEMPORARY = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.partial(\..*)?")  # names of temporary files of `atomic_write`


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`. The file replaces `path` on success and is deleted on failure.

    The temporary name has the same suffix, because image and mesh writers derive the format from the suffix. If `path`
    is a symbolic link, its target is replaced. Raises DataError if writing fails or `path` is not a regular file.
    """
    path = Path(os.path.realpath(path))
    if path.exists():
        check_regular(path)
    # processes in containers that share a folder may have the same process id
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:  # Windows syncs only writable files
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        reason = error.strerror or f"{error}; the disk may be full"  # NumPy reports only the number of items
        raise DataError(f"{path}: expected a writable file, got an error ({reason})") from error
    finally:
        with suppress(OSError):  # the disk may be read-only
            temporary.unlink(missing_ok=True)


def path_exists(path: Path) -> bool:
    """Return True if an optional file exists, or if it is a broken symbolic link, so that reading it then fails."""
    return os.path.lexists(path)


def remove_left_over(directory: Path) -> None:
    """Remove the temporary files of killed processes. No other process may write to `directory`."""
    for path in directory.glob(".*.partial*"):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def check_regular(path: Path) -> os.stat_result:
    """Return the status of a regular file. Raises DataError for other types, because reading a pipe may block."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{path}: expected a readable file, got an error ({reason})") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device, a pipe or a socket"
        raise DataError(f"{path}: expected a regular file, got {kind}")
    return found


def read_bytes(path: Path, most: int) -> bytes:
    """Read a file of at most `most` bytes. Raises DataError if it is larger or cannot be read."""
    size = check_regular(path).st_size
    if size > most:
        raise DataError(f"{path}: expected at most {most} bytes, got {size}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: expected a readable file, got an error ({error.strerror or error})") from error


def read_text(path: Path, most: int = MAX_TEXT) -> str:
    """Read UTF-8 text of at most `most` bytes without its byte order mark. Raises a DataError that names the file."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        found = f"got byte {error.object[error.start]:#04x} on line {line}"
        raise DataError(f"{path}: expected UTF-8 text, {found}") from error
