"""Output of a process to a terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def terminal_stderr(columns: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Connect stderr to a terminal of `columns` characters. Afterwards, the yielded list contains the text."""
    shown: list[str] = []
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    with os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        yield shown
    parts = []
    try:
        while part := os.read(ours, 4096):
            parts.append(part)
    except OSError:  # on Linux, the closed side of a pseudoterminal causes an input/output error
        pass
    os.close(ours)
    shown.append(b"".join(parts).decode())
