"""Detection of images that are repeated in several frames.

Recorders repeat the last image of a slower stream. Poses at the full rate then belong to other images.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair

MIN_PAIRS = 3  # minimum number of pairs with a repeated image
MIN_FRACTION = 0.2  # minimum fraction of these pairs


def check_repeats(neighbors: Sequence[MatchedPair]) -> Finding | None:
    """Return the result for images that are equal in two neighboring frames, or None without such images.

    Repeated images are an error if the poses of the frames differ.
    """
    color = [pair for pair in neighbors if np.array_equal(pair.first.color, pair.second.color)]
    depth = [pair for pair in neighbors if np.array_equal(pair.first.depth, pair.second.depth)]
    found, name = (color, "color") if len(color) >= len(depth) else (depth, "depth")
    if len(found) < max(MIN_PAIRS, MIN_FRACTION * len(neighbors)):
        return None
    text = f"{name} images are repeated in {len(found)} of {len(neighbors)} pairs of neighboring frames"
    moved = sum(_is_moved(pair) for pair in found)
    if moved < max(MIN_PAIRS, MIN_FRACTION * len(neighbors)):
        return Finding(Verdict.NOTE, "frames", f"{text}; remove the repeated frames to save time")
    text = f"{text}, and the poses differ in {moved} of them; remove the frames that repeat an image"
    return Finding(Verdict.ERROR, "frames", text)


def _is_moved(pair: MatchedPair) -> bool:
    """Return True if the poses of the frames differ."""
    first, second = pair.first.T_world_camera, pair.second.T_world_camera
    return first is not None and second is not None and not np.allclose(first, second, atol=1e-5)
