"""Writer of depth images in RVL.

Source: the algorithm in A. D. Wilson, Fast lossless depth image compression, ISS 2017.
"""

from __future__ import annotations

import struct
from itertools import groupby

import numpy as np


def rvl(depth: np.ndarray) -> bytes:
    """Return the width, the height and the code of a uint16 image."""
    groups: list[int] = []

    def write(number: int) -> None:
        while number > 7:
            groups.append(8 | number & 7)
            number >>= 3
        groups.append(number)

    runs = [(empty, list(pixels)) for empty, pixels in groupby(depth.ravel().tolist(), lambda value: value == 0)]
    if runs and not runs[0][0]:
        write(0)  # the image begins with readings
    previous = 0
    for empty, pixels in runs:
        write(len(pixels))
        for value in [] if empty else pixels:
            difference = value - previous
            write(2 * difference if difference >= 0 else -2 * difference - 1)
            previous = value
    if runs and runs[-1][0]:
        write(0)  # the image ends without readings
    groups += [0] * (-len(groups) % 8)
    words = [int("".join(f"{group:x}" for group in groups[k : k + 8]), 16) for k in range(0, len(groups), 8)]
    height, width = depth.shape
    return struct.pack(f"<{2 + len(words)}I", width, height, *words)
