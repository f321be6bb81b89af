"""Populates memory in advance and keeps freed memory.

Reserved memory gets its pages when it is first written. A huge page (2 MiB) takes 0.1 ms, in a virtual machine up to
5 ms. A thread therefore populates the next pages of the map's growing arrays. The C library returns large freed blocks
to the system, and their pages have to be populated again: they are kept instead.
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

from framework.runtime.cpu_budget import lower_priority

PAGE = 2**21  # bytes, of a huge page
SMALL = PAGE // 2  # bytes in use, up to which an array gets no pages in advance
POPULATE_WRITE = 23  # MADV_POPULATE_WRITE of madvise(2), Linux 5.14 and later
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
MOST_KEPT = 2**28  # free bytes at the end of the heap
MOST_SHARED = 2**25  # bytes of an array that reuses freed memory; the maximum of glibc


@cache
def keep_freed_memory() -> None:
    """Keep about MOST_KEPT freed bytes in the process, if its C library is glibc.

    Settings of the environment take precedence.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    configured = {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"} & os.environ.keys()
    if mallopt is not None and not configured:
        mallopt(TRIM_THRESHOLD, MOST_KEPT)
        mallopt(MMAP_THRESHOLD, MOST_SHARED)


class PagesAhead:
    """Populates the next pages of growing arrays, on Linux only."""

    def __init__(self) -> None:
        self._given: dict[int, int] = {}  # end of the populated memory by the address of an array

    def ask(self, arrays: Iterable[npt.NDArray[Any]], count: int) -> None:
        """Request the next page of each array that is within a page of it; the first `count` rows are in use."""
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
    """Return the queue of requests: an array, which is kept alive, and an address in it."""
    asked: queue.SimpleQueue[tuple[npt.NDArray[Any], int]] = queue.SimpleQueue()
    threading.Thread(target=_give, args=(asked,), name="pages", daemon=True).start()
    return asked


def _give(asked: queue.SimpleQueue[tuple[npt.NDArray[Any], int]]) -> None:
    """Populate the requested pages. On failure, they are populated when they are written."""
    lower_priority()
    madvise = ctypes.CDLL(None).madvise
    while True:
        array, address = asked.get()
        madvise(ctypes.c_void_p(address), ctypes.c_size_t(PAGE), POPULATE_WRITE)
        del array


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_asked.cache_clear)  # a child has no such thread
