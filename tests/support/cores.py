"""Which cores the tests run on: of several processes of pytest-xdist each has some to itself.

Their parallel kernels would wait for each other else: tests of the tracker that take 22 s on a core took 72 s where two
processes shared two cores.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from framework.runtime.process_settings import set_environment

ALL = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _share_among_processes() -> None:
    """Before numba is loaded, which else could never use a second thread.

    numba gives the thread that starts its OpenMP threads its own number of threads. Torch uses the same OpenMP and
    would otherwise use another number in a new thread, where networks would round differently.
    """
    number = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if ALL and processes > 1:
        for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ.setdefault(variable, str(len(ALL)))
        os.sched_setaffinity(0, ALL[number::processes] or ALL)


@contextmanager
def all_cores() -> Iterator[None]:
    """The body, and the threads that it starts, run on every core."""
    if not ALL:
        yield
        return
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, ALL)
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)


_share_among_processes()
set_environment()  # as the command line does
