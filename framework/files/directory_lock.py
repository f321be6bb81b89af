"""A directory that one process writes at a time, and one that nobody has written yet."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from framework.errors import DataError
from framework.files.atomic_write import read_text, written_whole

LOCK, HOLDER = ".lock", ".lock_holder"  # what is locked, and who has it: on Windows a locked file cannot be read

log = logging.getLogger(__name__)


def new_directory(wanted: str) -> str:
    """Makes a directory that was not there: `wanted`, or where others were faster `wanted`_2, _3 ...

    Raises DataError when the disk does not take it.
    """
    path, number = Path(wanted), 1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                path.mkdir()  # of several processes that try, one succeeds
                return str(path)
            except FileExistsError:
                number += 1
                path = Path(f"{wanted}_{number}")
    except OSError as error:
        raise DataError(f"the directory {path} could not be made: {error.strerror}") from error


@contextmanager
def locked(directory: Path, wait: bool = False) -> Iterator[None]:
    """Keeps out who else asks for `directory` while the body runs. The lock ends with the process, even by `kill -9`.

    While another process has it, waits for that, or raises DataError; both name it. On a file system without locks
    there is a warning, and nobody is kept out.
    """
    directory.mkdir(parents=True, exist_ok=True)
    lock = FileLock(directory / LOCK, fallback_to_soft=False)
    try:
        _acquire(lock, directory, wait)
    except OSError as error:
        log.warning("%s cannot be locked (%s): start nothing else there meanwhile", directory, error.strerror)
    try:
        with written_whole(directory / HOLDER) as temporary:
            temporary.write_text(f"{holder_name(os.getpid())}\n")
        yield
    finally:
        lock.release()


def is_locked(directory: Path) -> bool:
    """Whether a process has `directory` to itself at this moment."""
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
    """Who has `directory` to itself, or had it last, in words; "" = that is not known."""
    try:
        return read_text(directory / HOLDER).strip()
    except DataError:
        return ""


def holder_name(process: int | None) -> str:
    """A process of this machine as `holder` names it."""
    return f"process {process} on {socket.gethostname()}"


def _acquire(lock: FileLock, directory: Path, wait: bool) -> None:
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        who = holder(directory) or "another process"
        if not wait:
            message = f"{directory} is in use by {who}; wait until it has ended, or end it"
            raise DataError(message) from error
        log.warning("waiting for %s, which is at work in %s", who, directory)
        lock.acquire()
