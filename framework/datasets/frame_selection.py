"""`start`, `stop` and `stride`: the parameters by which every dataset chooses from the frames that there are."""

from __future__ import annotations

from framework.errors import ConfigError

TO_THE_END = -1  # value of `stop`


def check_selection(start: int, stop: int, stride: int) -> None:
    """Raises ConfigError unless the three parameters can choose frames at all."""
    if start < 0:
        raise ConfigError(f"dataset.start must be 0 or positive, found {start}")
    if stop != TO_THE_END and stop <= start:
        raise ConfigError(
            f"dataset.stop must be above dataset.start ({start}), or {TO_THE_END} for the end; found {stop}"
        )
    if stride < 1:
        raise ConfigError(f"dataset.stride must be at least 1, found {stride}")


def choose_frames(count: int, start: int, stop: int, stride: int) -> range:
    """The frame numbers chosen of `count` frames, as a Python slice chooses. Raises ConfigError when none is left."""
    check_selection(start, stop, stride)
    if start >= count:
        raise ConfigError(f"dataset.start is {start}, but the sequence has only {count} frames (0 to {count - 1})")
    return range(start, count if stop == TO_THE_END else min(stop, count), stride)
