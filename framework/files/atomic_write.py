"""Atomic file writing, and reading of files with limited size."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from framework.errors import DataError

MAX_TEXT = 2**28  # maximum size of text and JSON files, bytes; one hour of poses takes 10 MB
UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EBADF, errno.EACCES)
"""Error numbers of file systems that cannot sync folders, and of folders without read permission."""

_TEMPORARY = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.partial(\..*)?")  # names of temporary files of `atomic_write`


@contextmanager
def atomic_write(path: Path, sync_entry: bool = True) -> Iterator[Path]:
    """Write a file atomically.

    The context manager yields a temporary path with the same suffix. At the end of the block, the temporary file
    replaces `path`. If an exception is raised, the temporary file is deleted. If `path` is a symbolic link, the target
    of the link is replaced. The new file survives a power cut.

    Args:
        path: The file.
        sync_entry: Write the entry of the folder to disk. Otherwise, a power cut can undo the replacement. Writers of
            many files sync the folder once.

    Raises:
        DataError: Writing fails, the text is not valid Unicode, or `path` exists and is not a regular file.
    """
    try:
        path = Path(os.path.realpath(path))
        exists = path.exists()
    except (OSError, ValueError) as error:  # the name is too long or contains NUL
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{path}: expected a writable file, got an error ({reason})") from error
    if exists:
        check_regular(path)
    # processes in containers that share a folder may have the same process id
    temporary = path.with_name(f".{path.stem[:50]}.{os.getpid()}-{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        sync_file(temporary)
        temporary.replace(path)
        if sync_entry:
            sync_folder(path.parent)
    except OSError as error:
        reason = error.strerror or f"{error}; the disk may be full"  # NumPy reports only the number of items
        raise DataError(f"{path}: expected a writable file, got an error ({reason})") from error
    except UnicodeEncodeError as error:
        found = error.object[error.start : error.end]
        raise DataError(f"{path}: expected text that is valid Unicode, got {found!r:.40}; rename it") from error
    finally:
        with suppress(OSError):  # the disk may be read-only
            temporary.unlink(missing_ok=True)


def sync_file(path: Path) -> None:
    """Write the contents of a file to disk.

    Raises:
        OSError: Writing fails.
    """
    with path.open("rb+") as file:  # Windows syncs only writable files
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Write the entries of a folder to disk, so that new and renamed files survive a power cut.

    Raises:
        OSError: Writing fails.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, if missing, so that they survive a power cut.

    Raises:
        OSError: A folder cannot be created.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync_folder(path.parent)


def path_exists(path: Path) -> bool:
    """Return True if a path exists, including broken symbolic links."""
    return os.path.lexists(path)


def remove_left_over(directory: Path) -> None:
    """Remove the temporary files of killed processes.

    No other process may write to the directory.
    """
    for path in directory.glob(".*.partial*"):
        if is_temporary(path.name):
            path.unlink(missing_ok=True)


def is_temporary(name: str) -> bool:
    """Return True for the name of a temporary file of `atomic_write`."""
    return _TEMPORARY.fullmatch(name) is not None


def check_regular(path: Path) -> os.stat_result:
    """Return the status of a regular file.

    Raises:
        DataError: The path does not exist, or it is a folder, a pipe or a device.
    """
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
    """Read a file.

    Raises:
        DataError: The file is larger than `most` bytes or cannot be read.
    """
    size = check_regular(path).st_size
    if size > most:
        raise DataError(f"{path}: expected at most {most} bytes, got {size}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: expected a readable file, got an error ({error.strerror or error})") from error


def read_text(path: Path, most: int = MAX_TEXT) -> str:
    """Read a UTF-8 text file, without the byte order mark.

    Raises:
        DataError: The file is larger than `most` bytes, is not UTF-8, or cannot be read.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        found = f"got byte {error.object[error.start]:#04x} on line {line}"
        raise DataError(f"{path}: expected UTF-8 text, {found}") from error
