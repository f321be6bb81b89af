"""Assignment of CPU cores to the test processes of pytest-xdist.

On shared cores, the parallel kernels of several processes wait for each other. Tracker tests that take 22 s on one core
took 72 s in two processes on two shared cores. Each process therefore gets separate cores.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from framework.runtime.process_settings import set_environment

ALL = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _share_among_processes() -> None:
    """Set the cores of this process before numba is loaded, because numba cannot add threads later.

    numba sets the number of OpenMP threads only in the thread that first uses it, and torch uses the same OpenMP.
    Without these variables, torch would use another number in new threads and round differently.
    """
    number = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if ALL and processes > 1:
        for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ.setdefault(variable, str(len(ALL)))
        os.sched_setaffinity(0, ALL[number::processes] or ALL)


@contextmanager
def all_cores() -> Iterator[None]:
    """Use all cores in the body and in the threads that the body starts."""
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
set_environment()  # like the command line
