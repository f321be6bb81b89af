"""Detection of storage that is no longer available, such as an unplugged disk."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from framework.errors import StorageError

_NAMES = (
    *("EIO", "ESTALE", "ENODEV", "ENXIO", "ENOMEDIUM", "EREMOTEIO", "ENOTCONN", "ETIMEDOUT"),
    *("EHOSTDOWN", "EHOSTUNREACH", "ENETDOWN", "ENETUNREACH", "ECONNRESET"),
)
DEVICE_ERRORS = frozenset(getattr(errno, name) for name in _NAMES if hasattr(errno, name))
"""Numbers of operating system errors of a disk or file server, not of a single file."""


def check_storage(error: BaseException, recording: Path | None = None) -> None:
    """Raise StorageError if an error is caused by storage that is no longer available.

    This is an input/output error, a folder that is missing, empty or not readable, or a missing recording. Otherwise,
    the error is one of a single file.

    Args:
        error: The error of a frame, with its causes.
        recording: File or folder of the recording; None = unknown.

    Raises:
        StorageError: The storage is not available.
    """
    if isinstance(error, StorageError):
        raise error
    for cause in _causes(error):
        if (
            isinstance(cause, sqlite3.Error)
            and cause.__dict__.get("sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_IOERR
        ):
            raise _lost(recording, cause) from error
        if not isinstance(cause, OSError):
            continue
        if cause.errno in DEVICE_ERRORS:
            raise _lost(cause.filename or recording, cause) from error
        if isinstance(cause.filename, str | Path):
            _check_available(Path(cause.filename).parent, error)
    if recording is not None:
        _check_available(recording, error)


def _check_available(path: Path, error: BaseException) -> None:
    try:
        if path.is_dir() or not path.exists():
            with os.scandir(path) as entries:
                if next(entries, None) is None:
                    raise FileNotFoundError(errno.ENOENT, "empty folder", str(path))
        else:
            with path.open("rb") as file:
                file.read(1)
    except OSError as found:
        raise _lost(path, found) from error


def _lost(path: object, cause: Exception) -> StorageError:
    reason = getattr(cause, "strerror", None) or cause
    where = path or "recording"
    return StorageError(
        f"{where}: expected available storage, got an error ({reason}); reconnect it and repeat the command"
    )


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception and its causes."""
    while error is not None:
        yield error
        error = error.__cause__
