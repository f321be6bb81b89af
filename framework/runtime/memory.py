"""Memory that is only reserved is given page by page when it is first written, and a huge page is worth a wait.

Measured for 2 MiB: 0.1 ms, and 5 ms in a virtual machine whose host has to find them first. So a thread of its own has
the system give the next pages of a map's growing arrays, while the map is at work on those that it has.

What a frame needs for itself is megabytes, too. The C library gives such memory back to the system when it is freed, if
not always, and the frame that gets it again waits for its pages: one in a hundred for 1300 of 4 KiB, 3 to 7 ms. So what
is freed is kept.
"""

from __future__ import annotations

import ctypes
import os
import queue
import sys
import threading
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy.typing as npt

from framework.runtime.cpu_budget import stand_back

PAGE = 2**21  # bytes, of a huge page
SMALL = PAGE // 2  # bytes: what has no more in use, as the many maps of single objects, is given no page ahead
POPULATE_WRITE = 23  # of madvise(2), Linux 5.14 and later: gives pages as if they were written, and writes nothing
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
MOST_KEPT = 2**28  # bytes at the end of a heap that are free and stay
MOST_SHARED = 2**25  # bytes of an array that is made of what was freed, and not of new pages; glibc takes no more


@cache
def keep_freed_memory() -> None:
    """Has the process keep what it frees, about MOST_KEPT bytes, where glibc is its C library.

    Who has set that by the environment is left alone.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    said = {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"} & os.environ.keys()
    if mallopt is not None and not said:
        mallopt(TRIM_THRESHOLD, MOST_KEPT)
        mallopt(MMAP_THRESHOLD, MOST_SHARED)


class PagesAhead:
    """Has growing arrays come to their new pages before they need them, on Linux; elsewhere this does nothing."""

    def __init__(self) -> None:
        self._given: dict[int, int] = {}  # by the address of an array: the one up to which it has memory

    def ask(self, arrays: Iterable[npt.NDArray[Any]], count: int) -> None:
        """Asks for the next page of each array that comes to it within a page; the first `count` rows are in use."""
        if sys.platform != "linux":
            return
        for array in arrays:
            begin: int = array.__array_interface__["data"][0]
            used = begin + count * array.strides[0]
            given = max(self._given.get(begin, 0), -(-used // PAGE) * PAGE)
            if used - begin > SMALL and given < used + PAGE and given + PAGE <= begin + array.nbytes:
                _asked().put((array, given))
                given += PAGE
            self._given[begin] = given


@cache
def _asked() -> queue.SimpleQueue[tuple[npt.NDArray[Any], int]]:
    """Where pages are asked for, by an array, which lives until it has the page, and an address in it."""
    asked: queue.SimpleQueue[tuple[npt.NDArray[Any], int]] = queue.SimpleQueue()
    threading.Thread(target=_give, args=(asked,), name="pages", daemon=True).start()
    return asked


def _give(asked: queue.SimpleQueue[tuple[npt.NDArray[Any], int]]) -> None:
    """What the thread does. A system that cannot give pages ahead gives them when they are written."""
    stand_back()
    madvise = ctypes.CDLL(None).madvise
    while True:
        array, address = asked.get()
        madvise(ctypes.c_void_p(address), ctypes.c_size_t(PAGE), POPULATE_WRITE)
        del array


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_asked.cache_clear)  # a child has no such thread
