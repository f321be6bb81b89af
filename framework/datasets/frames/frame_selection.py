"""The parameters by which every dataset chooses from the frames that there are: `start`, `stop`, `stride`, `share`."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from framework.errors import ConfigError

TO_THE_END = -1  # value of `stop`
_STREAM = zlib.crc32(b"share")  # a random stream of its own, beside all that a dataset draws from the same seed


def check_selection(start: int, stop: int, stride: int, share: float = 1.0) -> None:
    """Raises ConfigError unless the parameters can choose frames at all."""
    if start < 0:
        raise ConfigError(f"dataset.start must be 0 or positive, found {start}")
    if stop != TO_THE_END and stop <= start:
        raise ConfigError(
            f"dataset.stop must be above dataset.start ({start}), or {TO_THE_END} for the end; found {stop}"
        )
    if stride < 1:
        raise ConfigError(f"dataset.stride must be at least 1, found {stride}")
    if not 0 < share <= 1:  # NaN is neither
        raise ConfigError(f"dataset.share must be in (0, 1], found {share}")


def choose_frames(count: int, start: int, stop: int, stride: int, share: float = 1.0, seed: int = 0) -> Sequence[int]:
    """The frame numbers chosen of `count` frames, ascending: as a Python slice chooses, and of those a random share.

    The same `seed` takes the same share, of at least one frame. Raises ConfigError when no frame is left.
    """
    check_selection(start, stop, stride, share)
    if start >= count:
        raise ConfigError(f"dataset.start is {start}, but the sequence has only {count} frames (0 to {count - 1})")
    if seed < 0:
        raise ConfigError(f"seed must be 0 or positive, found {seed}")
    chosen = range(start, count if stop == TO_THE_END else min(stop, count), stride)
    if share == 1:
        return chosen
    kept = np.random.default_rng([seed, _STREAM]).permutation(len(chosen))[: max(1, round(share * len(chosen)))]
    return tuple(chosen[k] for k in np.sort(kept).tolist())
