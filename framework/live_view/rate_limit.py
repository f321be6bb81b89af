"""How often something is done that takes time from others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Pace:
    """At most once in `every` seconds, and so seldom that it takes at most `share` of the time, by `clock`."""

    def __init__(self, every: float, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.every = every  # s
        self.share = share  # in (0, 1]
        self.clock = clock  # s; time.thread_time counts what the calling thread computes, and not what it waits
        self._next = 0.0  # s, by time.perf_counter

    def due(self) -> bool:
        return time.perf_counter() >= self._next

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Around doing it."""
        began, before = time.perf_counter(), self.clock()
        self._next = began + self.every
        yield
        self._next = began + max(self.every, (self.clock() - before) / self.share)
