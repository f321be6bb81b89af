"""Creation and locking of directories."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from framework.errors import DataError
from framework.files.atomic_write import atomic_write, make_folder, read_text, sync_folder

# the name of the owner has its own file, because locked files cannot be read on Windows
LOCK, HOLDER = ".lock", ".lock_holder"

log = logging.getLogger(__name__)


def new_directory(wanted: str) -> str:
    """Create a new directory and return its path.

    The path is `wanted` if unused, otherwise `wanted`_2, `wanted`_3, and so on.

    Raises:
        DataError: The directory cannot be created.
    """
    path, number = Path(wanted), 1
    try:
        make_folder(path.parent)
        while True:
            try:
                path.mkdir()  # atomic: succeeds in only one process
                sync_folder(path.parent)
                return str(path)
            except FileExistsError:
                number += 1
                path = Path(f"{wanted}_{number}")
    except OSError as error:
        raise DataError(f"{path}: expected a writable parent folder, got an error ({error.strerror})") from error


@contextmanager
def locked(directory: Path, wait: bool = False) -> Iterator[None]:
    """Lock a directory within a context.

    The lock is released when the process ends, even if the process is killed. On file systems without locks, a warning
    is logged instead.

    Args:
        directory: The directory.
        wait: True = wait until other processes release the lock.

    Raises:
        DataError: Another process holds the lock, and `wait` is False, or the directory cannot be created.
    """
    try:
        make_folder(directory)
    except OSError as error:
        raise DataError(f"{directory}: expected a writable folder, got an error ({error.strerror})") from error
    lock = FileLock(directory / LOCK, fallback_to_soft=False)
    try:
        try:
            lock.acquire(blocking=False)
        except Timeout as error:
            owner = holder(directory) or "another process"
            if not wait:
                raise DataError(
                    f"{directory}: expected an unlocked directory, got a directory in use by {owner}; wait for it to "
                    "exit, or stop it"
                ) from error
            log.warning("%s: in use by %s; waiting for it to exit", directory, owner)
            lock.acquire()
    except OSError as error:
        log.warning(
            "%s: expected a file system with locks, got an error (%s); do not start other runs in this directory",
            directory,
            error.strerror,
        )
    try:
        with atomic_write(directory / HOLDER) as temporary:
            temporary.write_text(f"{holder_name(os.getpid())}\n")
        yield
    finally:
        lock.release()


def is_locked(directory: Path) -> bool:
    """Return True if a process has locked the directory."""
    if not (directory / LOCK).exists():
        return False
    lock = FileLock(directory / LOCK, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        return True
    except OSError:  # a file system without locks
        return False
    lock.release()
    return False


def holder(directory: Path) -> str:
    """Return the name of the process that holds the lock or held it last, or "" if unknown."""
    try:
        return read_text(directory / HOLDER).strip()
    except DataError:
        return ""


def holder_name(process: int | None) -> str:
    """Return the name of a process, in the format of `holder`."""
    return f"process {process} on {socket.gethostname()}"
