"""Detection of depth images that were scaled frame by frame.

Programs for display, and networks for relative depth, map the nearest and farthest readings of each image to the limits
of the pixel type. Such values are no distances: their unit differs from frame to frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.checking import Finding, Verdict
from framework.data import Array, UInt16
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import FrameError
from framework.interfaces import RGBDSequence

MIN_FRAMES = 3  # minimum number of readable depth images
MIN_FRACTION = 0.9  # minimum fraction of frames with the same largest value
TYPE_LIMITS = (255, 255 * 256, 255 * 257, 65535)  # largest values of normalized images of 8 or 16 bits
# maximum fraction of readings at the largest value; clipped images have more, at least in some frames
MAX_AT_LIMIT = 0.03
MAX_STEP = 0.1  # maximum relative step to the next value; 65535 = no reading has a large step
MAX_NEAREST = 0.01  # maximum ratio of the smallest to the largest value, if zero is the nearest reading


@dataclass(frozen=True)
class _Range:
    """Range of the values in a depth image."""

    largest: int
    nearest: float  # ratio of the smallest value to the largest value
    step: float  # relative step from the second-largest to the largest value
    at_limit: float  # fraction of readings with the largest value

    @classmethod
    def of(cls, raw: Array) -> _Range | None:
        """Return the range of a uint16 image, or None for another type or with fewer than two values."""
        if raw.dtype != np.uint16:
            return None
        pixels: UInt16 = raw.astype(np.uint16)
        values, counts = np.unique(pixels[pixels > 0], return_counts=True)
        if len(values) < 2:
            return None
        largest = int(values[-1])
        second, first = float(values[-2]), float(values[0])
        return cls(largest, first / largest, 1 - second / largest, float(counts[-1] / counts.sum()))


def check_normalization(sequence: RGBDSequence, chosen: Sequence[int]) -> Finding | None:
    """Return an error if each depth image has its own scale, or None.

    Args:
        sequence: The sequence.
        chosen: Indices of the checked frames.
    """
    if not isinstance(sequence, Recording):
        return None
    found = []
    for k in chosen:
        try:
            one = _Range.of(sequence.contents.frames[sequence.chosen[k]].images.depth())
        except FrameError:
            continue
        if one is not None:
            found.append(one)
    if len(found) < MIN_FRAMES:
        return None
    limit = int(np.median([one.largest for one in found]))
    alike = [one for one in found if one.largest == limit and one.step <= MAX_STEP and one.at_limit <= MAX_AT_LIMIT]
    from_zero = sum(one.nearest <= MAX_NEAREST for one in alike) >= MIN_FRACTION * len(found)
    if len(alike) < MIN_FRACTION * len(found) or not (from_zero or limit in TYPE_LIMITS):
        return None
    text = (
        f"normalized frame by frame: the largest value is {limit} in {len(alike)} of {len(found)} images"
        f"{', and the smallest values are near 0' * from_zero}; expected distances in a fixed unit, which no setting "
        "can restore: export depth again, for example as uint16 in mm"
    )
    return Finding(Verdict.ERROR, "depth", text)
