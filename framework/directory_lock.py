"""A directory that one process writes at a time."""

from __future__ import annotations

import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from framework.errors import DataError

LOCK = ".lock"  # the file that is locked; it stays, since who removes it could take it from under another's lock

log = logging.getLogger(__name__)


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keeps out who else asks for `directory` while the body runs. The lock ends with the process, even by `kill -9`.

    Raises DataError, naming who has it, when another process does. On a file system without locks there is a warning
    and nothing is kept out.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise DataError(f"{directory} is in use by {holder}; wait for it, end it, or choose another place") from error
        except OSError as error:
            log.warning("%s cannot be locked (%s): run nothing else there at the same time", directory, error.strerror)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
