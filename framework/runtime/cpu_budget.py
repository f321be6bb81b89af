"""Division of the CPU cores between prefetching (reading, detection) and mapping.

A parallel loop waits for its slowest thread. Two loops that share all cores therefore slow each other down. Prefetching
and mapping each get their own cores, in proportion to their recent work. The results of kernels do not depend on the
number of threads. Threads of networks are neither limited nor counted. Background work has low priority.
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

LOW_PRIORITY = 10  # value for nice(2): a tenth of the CPU time of normal threads on a busy core
RECENT = 15  # number of frames in the median of the work per frame


def lower_priority() -> None:
    """Lower the priority of the calling thread. Only Linux supports this for single threads."""
    if sys.platform == "linux":
        thread = threading.get_native_id()
        if os.getpriority(os.PRIO_PROCESS, thread) < LOW_PRIORITY:  # raising a priority requires privileges
            os.setpriority(os.PRIO_PROCESS, thread, LOW_PRIORITY)


def parallel_kernels_are_thread_safe() -> bool:
    """Return True if two threads may run parallel kernels at the same time."""
    numba.get_num_threads()  # starts the threads and thus selects the threading layer
    return str(numba.threading_layer()) in ("omp", "tbb")  # the layer workqueue aborts the process


@contextmanager
def kernel_threads(threads: int) -> Iterator[None]:
    """Set the number of kernel threads of the calling thread in the `with` body."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Limit the threads of kernels and torch networks in the `with` body. With 0, there is no limit."""
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


class CpuBudget:
    """Division of the kernel threads between prefetching and mapping, based on recent frames."""

    def __init__(self, with_prefetch: bool = True) -> None:
        self.cores = int(numba.get_num_threads())
        self._alone = not with_prefetch
        self._prefetching: deque[float] = deque(maxlen=RECENT)  # CPU time per frame of one thread, s
        self._mapping: deque[float] = deque(maxlen=RECENT)  # CPU time per frame times threads, s; mostly parallel loops
        self._lock = threading.Lock()

    @contextmanager
    def prefetching(self, workers: int = 1) -> Iterator[None]:
        """Run the `with` body, which prefetches one frame, on the cores for prefetching.

        The calling thread is one of `workers` threads. If no core is left, its priority is lowered permanently, so that
        parallel loops of mapping do not wait for it.
        """
        cores = self.cores if self._alone else self.prefetch_cores()
        if cores == 0:
            lower_priority()
        with kernel_threads(max(cores // workers, 1)):
            began = time.thread_time()
            yield
            self._record(self._prefetching, time.thread_time() - began)

    @contextmanager
    def mapping(self) -> Iterator[None]:
        """Run the `with` body, which maps one frame, on the cores for mapping."""
        threads = self.cores if self._alone else max(self.cores - self.prefetch_cores(), 1)
        with kernel_threads(threads):
            began = time.thread_time()
            yield
            self._record(self._mapping, threads * (time.thread_time() - began))

    def prefetch_cores(self) -> int:
        """Return the number of cores for prefetching.

        It is half of the cores until both sides have processed a frame. It is 0 or all cores if one side has almost no
        work.
        """
        with self._lock:
            if not (self._prefetching and self._mapping):
                return self.cores // 2
            prefetching, mapping = median(self._prefetching), median(self._mapping)
        return round(self.cores * prefetching / max(prefetching + mapping, 1e-9))

    def _record(self, spent: deque[float], seconds: float) -> None:
        with self._lock:
            spent.append(seconds)
