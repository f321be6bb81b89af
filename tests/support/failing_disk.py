"""Faults of a disk, injected into the file operations of this process."""

from __future__ import annotations

import builtins
import errno
import io
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Any
from unittest import mock

PATCHED = ("replace", "rename", "unlink", "remove", "mkdir", "rmdir", "fsync", "utime", "truncate")
"""Functions of `os` that change files."""


class Fault(Enum):
    """Faults of one operation that changes files."""

    FAILS = "nothing is written, and the operation fails"
    CUT = "half of the data is written, and the operation fails; other operations than writing data are completed"
    KILLED_BEFORE = "the process is killed before the operation"
    KILLED_AFTER = "the process is killed after the operation"


class FailingDisk:
    """Disk with a fault at one operation. Operations after this operation succeed.

    Reading is not affected. Data in buffers of Python is lost when the process is killed, as in a real process.

    Attributes:
        operations: The names of the operations so far.
    """

    def __init__(self, at: int, fault: Fault) -> None:
        self.at, self.fault = at, fault
        self.operations: list[str] = []

    @contextmanager
    def active(self) -> Iterator[None]:
        """Inject the fault within a context."""
        patched = {name: self._patched(name, getattr(os, name)) for name in PATCHED}
        with (
            mock.patch.multiple(os, **patched),
            mock.patch.object(io, "open", self._open),
            mock.patch.object(builtins, "open", self._open),
        ):
            yield

    def operate(self, name: str, whole: Callable[[], Any], part: Callable[[], Any] | None = None) -> Any:
        """Call `whole`, unless this operation has the fault. `part` is the operation with half of the data."""
        self.operations.append(name)
        if len(self.operations) - 1 != self.at:
            return whole()
        match self.fault:
            case Fault.KILLED_BEFORE:
                os.kill(os.getpid(), signal.SIGKILL)
            case Fault.KILLED_AFTER:
                whole()
                os.kill(os.getpid(), signal.SIGKILL)
            case Fault.CUT:
                (part or whole)()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _patched(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments, **named: self.operate(name, lambda: function(*arguments, **named))

    def _open(
        self, file: Any, mode: str = "r", buffering: int = -1, encoding: Any = None, errors: Any = None,
        newline: Any = None, closefd: bool = True, opener: Any = None,
    ) -> Any:  # fmt: skip
        if set(mode).isdisjoint("wax+"):
            return _original(file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw_mode = mode.replace("b", "").replace("t", "")
        raw = self.operate("open", lambda: _CountedFile(self, file, raw_mode, closefd, opener))
        if buffering == 0:
            return raw
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)


class _CountedFile(io.FileIO):
    """Unbuffered file whose writes are operations of a disk."""

    def __init__(self, disk: FailingDisk, file: Any, mode: str, closefd: bool, opener: Any) -> None:
        super().__init__(os.fspath(file) if isinstance(file, Path) else file, mode, closefd, opener)
        self._disk = disk

    def write(self, data: Any) -> int:
        half = memoryview(data).cast("B")[: memoryview(data).nbytes // 2]
        write = super().write
        written: int = self._disk.operate("write", lambda: write(data), lambda: write(half))
        return written


_original = builtins.open
