"""Reuse of freed memory.

The C library returns large freed blocks to the system. The next large array then needs new pages. Allocating a huge
page (2 MiB) takes 0.1 ms, or up to 5 ms in a virtual machine.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3)
MAX_KEPT = 2**28  # maximum free memory kept at the end of the heap, bytes
MAX_SHARED = 2**25  # maximum size of an array that reuses freed memory, bytes; the largest value that glibc accepts


@cache
def keep_freed_memory() -> None:
    """Keep up to MAX_KEPT bytes of freed memory in the process, if its C library is glibc.

    Existing environment variables for malloc take precedence.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    configured = {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"} & os.environ.keys()
    if mallopt is not None and not configured:
        mallopt(TRIM_THRESHOLD, MAX_KEPT)
        mallopt(MMAP_THRESHOLD, MAX_SHARED)
