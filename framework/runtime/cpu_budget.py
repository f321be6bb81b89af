"""Who gets how many cores: the threads that read and detect ahead, and the one that maps what was detected.

A parallel loop waits for its slowest thread, and a thread whose core is taken is late by milliseconds. So loops of two
threads that share all cores wait for each other: on two cores, beside a network that takes one, tracking and fusion
have taken up to ten times as long with two threads as with one. Each gets cores of its own instead, in proportion to
its work. No result depends on it, as no kernel's result depends on its number of threads.

This is about numba's kernels. The threads of a network are its own: they are neither limited here nor counted. So
detectors that take several frames at once may have more threads than their share has cores: on two cores, the second
one uses what is left of the mapping's core while that waits for the first. What no frame waits for stands back where
cores are scarce.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

import numba

STANDING_BACK = 10  # of nice(2): a tenth of the time of others who want the same core
RECENT = 15  # frames; their median is a frame's work


def stand_back() -> None:
    """Has the calling thread leave cores to others that want them. Only Linux knows that of a single thread."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), STANDING_BACK)


def parallel_kernels_are_thread_safe() -> bool:
    """Return whether two threads may run parallel kernels at the same time.

    numba's workqueue layer ends the process when they do. numba picks a layer when it starts its threads, as here.
    """
    numba.get_num_threads()
    return str(numba.threading_layer()) in ("omp", "tbb")


@contextmanager
def kernel_threads(threads: int) -> Iterator[None]:
    """Run the kernels that the calling thread calls with this number of threads."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Limit the kernels and torch networks that the calling thread runs; 0 = no limit."""
    if threads == 0:
        yield
        return
    torch = sys.modules.get("torch")
    before = torch.get_num_threads() if torch else 0
    with kernel_threads(min(threads, numba.config.NUMBA_NUM_THREADS)):
        if torch:
            torch.set_num_threads(threads)
        try:
            yield
        finally:
            if torch:
                torch.set_num_threads(before)


class CoreSharing:
    """How many threads the kernels of either side have, by what the latest frames have cost it."""

    def __init__(self, with_a_thread_ahead: bool = True) -> None:
        self.cores = int(numba.get_num_threads())
        self._alone = not with_a_thread_ahead
        self._ahead: deque[float] = deque(maxlen=RECENT)  # s of CPU time a frame, of its thread itself
        self._mapping: deque[float] = deque(maxlen=RECENT)  # likewise, times its threads: it is one loop after another
        self._lock = threading.Lock()

    @contextmanager
    def ahead(self, workers: int = 1) -> Iterator[None]:
        """Around what one of so many workers does ahead with one frame."""
        with kernel_threads(self.cores if self._alone else max(self.cores_ahead() // workers, 1)):
            began = time.thread_time()
            yield
            self._note(self._ahead, time.thread_time() - began)

    @contextmanager
    def mapping(self) -> Iterator[None]:
        """Around the mapping of one frame."""
        threads = self.cores if self._alone else max(self.cores - self.cores_ahead(), 1)
        with kernel_threads(threads):
            began = time.thread_time()
            yield
            self._note(self._mapping, threads * (time.thread_time() - began))

    def cores_ahead(self) -> int:
        """The share of what is done ahead, rounded.

        0: its work is so little that the mapping has all cores, and is disturbed. All of them: the other way round.
        """
        with self._lock:
            if not (self._ahead and self._mapping):
                return self.cores // 2
            ahead, mapping = median(self._ahead), median(self._mapping)
        return round(self.cores * ahead / max(ahead + mapping, 1e-9))

    def _note(self, spent: deque[float], seconds: float) -> None:
        with self._lock:
            spent.append(seconds)
