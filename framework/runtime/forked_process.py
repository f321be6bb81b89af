"""Forked processes, in which the kernels of their parent process cannot run.

GNU OpenMP terminates a process that runs a parallel kernel if its parent did so before the fork.
"""

from __future__ import annotations

import os
import threading
from types import TracebackType

import numba

from framework.errors import ConfigError

_forked = False  # True if this process was forked after its parent started the threads of OpenMP


def _note_fork() -> None:
    global _forked
    try:
        _forked = _forked or numba.threading_layer() == "omp"
    except ValueError:  # no threads
        return


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_note_fork)


def check_not_forked() -> None:
    """Raise ConfigError in a process that was forked after its parent started the threads of the kernels."""
    if _forked:
        raise ConfigError(
            f"process {os.getpid()}: expected a process that was not forked after mapping began, got a forked process, "
            'in which OpenMP cannot run; start it with multiprocessing.get_context("spawn")'
        )


class ProcessLock:
    """Reentrant lock that raises ConfigError in a forked process, where its owner may not exist."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        check_not_forked()
        self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()
