"""Files that are written whole or not at all, and read whole, up to the size that files of their kind can have."""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from framework.errors import DataError

MOST_TEXT = 2**28  # bytes, of text and JSON; an hour of poses has 10 MB
_TEMPORARY = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.partial(\..*)?")  # the names that `written_whole` makes


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path` to write to; on success it becomes `path`, else nothing is left behind.

    The temporary name keeps the suffix, because image and mesh writers choose their format by it. A link is followed.
    Raises DataError when the disk does not take the file, and before anything is written where there is something else
    than a file, such as a device.
    """
    path = Path(os.path.realpath(path))
    if path.exists():
        check_regular(path)
    # a process id is not enough: containers that share a folder have the same ones
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:  # to be written to, else Windows does not let it be synced
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        why = error.strerror or f"{error}; the disk may be full"  # NumPy only counts what it could write
        raise DataError(f"{path} could not be written: {why}") from error
    finally:
        with suppress(OSError):  # where nothing can be written, nothing can be removed either
            temporary.unlink(missing_ok=True)


def is_there(path: Path) -> bool:
    """Whether a file that may be missing was given: a link to nothing, or a folder of its name, is to be complained of
    by who reads it.
    """
    return os.path.lexists(path)


def remove_left_over(directory: Path) -> None:
    """Removes what `kill -9` left behind of files that were being written; nobody else may write in `directory`."""
    for path in directory.glob(".*.partial*"):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def check_regular(path: Path) -> os.stat_result:
    """What the system says of a file. Raises DataError, naming it, when it is none: a pipe may never end."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        raise DataError(f"{path} could not be read: {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device, a pipe or a socket"
        raise DataError(f"{path} is no file but {kind}")
    return found


def read_bytes(path: Path, most: int) -> bytes:
    """What a file holds. Raises DataError, naming it, when it cannot be read or has more than `most` bytes."""
    size = check_regular(path).st_size
    if size > most:
        raise DataError(f"{path} has {size} bytes, more than the {most} that such a file can have")
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} could not be read: {error.strerror or error}") from error


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Likewise of UTF-8, with or without a byte order mark, which is left out."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} could not be read as text: {error}") from error
