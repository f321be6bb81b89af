"""A directory that one process writes at a time."""

from __future__ import annotations

import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from framework.errors import DataError

LOCK = ".lock"  # the file that is locked; it stays, since who removes it could take it from under another's lock

log = logging.getLogger(__name__)


@contextmanager
def locked(directory: Path, wait: bool = False) -> Iterator[None]:
    """Keeps out who else asks for `directory` while the body runs. The lock ends with the process, even by `kill -9`.

    While another process has it, waits for that, or raises DataError; both name it. On a file system without locks
    there is a warning, and nobody is kept out.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / LOCK).open("a+") as file:
        try:
            _lock(file, directory, wait)
        except OSError as error:
            log.warning("%s cannot be locked (%s): start nothing else there meanwhile", directory, error.strerror)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


def _lock(file: TextIO, directory: Path, wait: bool) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.seek(0)
        holder = file.read().strip() or "another process"
        if not wait:
            message = f"{directory} is in use by {holder}; wait until it has ended, or end it"
            raise DataError(message) from error
        log.warning("waiting for %s, which is at work in %s", holder, directory)
        fcntl.flock(file, fcntl.LOCK_EX)
