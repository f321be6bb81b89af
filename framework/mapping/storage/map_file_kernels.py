"""Kernels of map_file.py."""

from __future__ import annotations

from framework.compilation.kernel_cache import njit


@njit(cache=True, nogil=True)
def find_unknown(ids, is_known):
    """Return the index of the first id without `is_known[id]` True, -1 = none."""
    for k in range(len(ids)):
        if ids[k] < 0 or ids[k] >= len(is_known) or not is_known[ids[k]]:
            return k
    return -1
