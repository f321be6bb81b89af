"""Contacts between instances in an image."""

from __future__ import annotations

import numpy as np
from numba import njit

CONTACT_DEPTH = 0.1  # m, neighbouring pixels of two instances nearer than this in depth touch


@njit(cache=True, nogil=True)
def contacts(ids, depth):
    """The pairs (M, 2) of neighbouring pixels' instances, the smaller id first, some of them more than once."""
    height, width = ids.shape
    pairs = np.empty((2 * height * width, 2), np.int32)
    n = 0
    for v in range(height):
        for u in range(width):
            own = ids[v, u]
            if own <= 0:
                continue
            for y, x in ((v, u + 1), (v + 1, u)):
                if y == height or x == width or ids[y, x] <= 0 or ids[y, x] == own:
                    continue
                if abs(depth[v, u] - depth[y, x]) < np.float32(CONTACT_DEPTH):
                    pairs[n, 0], pairs[n, 1] = min(own, ids[y, x]), max(own, ids[y, x])
                    n += 1
    return pairs[:n].copy()
