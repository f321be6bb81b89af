"""Memory of this process."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from pathlib import Path
from typing import NamedTuple

from framework.errors import ConfigError

ALLOCATOR = "PYTHONMALLOC"  # environment variable that Python reads when it starts


class _Mallinfo2(ctypes.Structure):
    """Statistics of glibc's malloc, see mallinfo2(3)."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    ]  # fmt: skip


class Memory(NamedTuple):
    """Memory of this process, bytes."""

    heap: int  # allocated by malloc and not freed, in all threads
    unique: int  # unique set size: resident pages that no other process shares


def restart_with_malloc() -> None:
    """Restart this program with Python's small objects in the heap of malloc, so that `memory` counts them."""
    if os.environ.get(ALLOCATOR) != "malloc":
        os.execve(sys.executable, sys.orig_argv, os.environ | {ALLOCATOR: "malloc"})


def memory() -> Memory:
    """Return the memory of this process after garbage collection.

    Raises:
        ConfigError: The C library does not report the size of its heap.
    """
    mallinfo2 = getattr(ctypes.CDLL(None), "mallinfo2", None) if sys.platform == "linux" else None
    if mallinfo2 is None:
        raise ConfigError("make endurance: expected Linux with glibc >= 2.33, got another C library; run it there")
    mallinfo2.restype = _Mallinfo2
    gc.collect()
    heap = mallinfo2()
    pages = dict(line.split()[:2] for line in Path("/proc/self/smaps_rollup").read_text().splitlines()[1:])
    unique = 1024 * (int(pages["Private_Clean:"]) + int(pages["Private_Dirty:"]))
    return Memory(heap.uordblks + heap.hblkhd, unique)
