"""Detection of depth images that are constant, rounded, or scaled frame by frame.

Programs for display, and networks for relative depth, map the nearest and farthest readings of each image to the limits
of the pixel type. Such values are no distances: their unit differs from frame to frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.checking import Finding, Verdict
from framework.data import Array
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import FrameError
from framework.interfaces import RGBDSequence

MIN_FRAMES = 3  # minimum number of readable depth images
MIN_FRACTION = 0.9  # minimum fraction of frames with the same largest value
MIN_FULL_FRACTION = 0.25  # minimum fraction of frames that use the full range of the pixel type
MIN_VALUES = 32  # minimum number of different values in an image; depth in m or dm as integers has fewer
TYPE_LIMITS = (1.0, 255, 255 * 256, 255 * 257, 65535)  # largest values of normalized images of floats, 8 or 16 bits
# maximum fraction of readings at the largest value; clipped images have more, at least in some frames
MAX_AT_LIMIT = 0.03
MAX_STEP = 0.1  # maximum relative step to the next value; 65535 = no reading has a large step
MAX_NEAREST = 0.01  # maximum ratio of the smallest to the largest value, if zero is the nearest reading


@dataclass(frozen=True)
class _Range:
    """Range of the values in a depth image."""

    largest: float
    count: int  # number of different values
    nearest: float  # ratio of the smallest value to the largest value; 1 = a constant image
    step: float  # relative step from the second-largest to the largest value
    at_limit: float  # fraction of readings with the largest value

    @classmethod
    def of(cls, raw: Array) -> _Range | None:
        """Return the range of the readings in a depth image, or None without readings."""
        depth = np.asarray(raw, np.float64)
        values, counts = np.unique(depth[np.isfinite(depth) & (depth > 0)], return_counts=True)
        if not len(values):
            return None
        first, second, largest = float(values[0]), float(values[-min(2, len(values))]), float(values[-1])
        return cls(largest, len(values), first / largest, 1 - second / largest, float(counts[-1] / counts.sum()))

    @property
    def is_full(self) -> bool:
        """True if the image has the full range of its pixel type, and few readings at the limit."""
        return self.largest in TYPE_LIMITS and self.nearest <= MAX_NEAREST and self.ends_smoothly

    @property
    def ends_smoothly(self) -> bool:
        """True if the readings extend to the largest value and are not clipped."""
        return self.step <= MAX_STEP and self.at_limit <= MAX_AT_LIMIT


def check_normalization(sequence: RGBDSequence, chosen: Sequence[int]) -> Finding | None:
    """Return an error if depth images are constant or have their own scale, or None.

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
    count = int(np.median([one.count for one in found]))
    if 1 < count < MIN_VALUES:
        text = f"rounded to {count} different values per image; export depth again, for example as uint16 in mm"
        return Finding(Verdict.ERROR, "depth", text)
    if all(one.nearest == 1 for one in found):
        text = f"constant: all readings of an image are equal, in all {len(found)} checked images; export depth again"
        return Finding(Verdict.ERROR, "depth", text)
    full = [one for one in found if one.is_full]
    limit = full[0].largest if full else float(np.median([one.largest for one in found]))
    alike = [one for one in found if one.largest == limit and one.ends_smoothly]
    from_zero = sum(one.nearest <= MAX_NEAREST for one in alike) >= MIN_FRACTION * len(found)
    is_normalized = len(alike) >= MIN_FRACTION * len(found) and (from_zero or limit in TYPE_LIMITS)
    if not is_normalized and len(full) < max(MIN_FRAMES, MIN_FULL_FRACTION * len(found)):
        return None
    text = (
        f"normalized frame by frame: expected distances in a fixed unit, got the largest value {limit:g} in "
        f"{len(alike)} of {len(found)} images{', and smallest values near 0' * from_zero}; no setting can restore the "
        "unit, so export depth again, for example as uint16 in mm"
    )
    return Finding(Verdict.ERROR, "depth", text)
