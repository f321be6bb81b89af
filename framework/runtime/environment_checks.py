"""Checks of the environment before the libraries are loaded. The libraries report these errors with a traceback."""

from __future__ import annotations

import os
import re
import threading
import warnings
from collections.abc import Iterator

from framework.errors import ConfigError
from framework.runtime.process_settings import BOUNDS, available_cores

THREADING_LAYERS = ("default", "omp", "workqueue", "tbb", "threadsafe", "forksafe", "safe")  # of numba

KNOWN = {
    *("NUMBA_NUM_THREADS", "NUMBA_DISABLE_JIT", "NUMBA_THREADING_LAYER", "NUMBA_THREADING_LAYER_PRIORITY"),
    "NUMBA_CACHE_DIR",
}
"""Variables of numba that are checked here, or when kernels are stored."""

IGNORED = re.compile(r"Environment variable '(NUMBA_\w+)' is defined but")  # warning of numba

# of a run with the default stages: 4 threads on one core, 11 on two; most libraries start one thread per core
LEAST_THREADS = 4
THREADS_PER_CORE = 6


def environment_errors() -> list[str]:
    """Return a line for each environment variable with a value that numba rejects or ignores."""
    return [*_known_variables()] or [*_other_variables()]


def _known_variables() -> Iterator[str]:
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    most = BOUNDS["threads"][1]
    if not threads.isdecimal() or not 1 <= int(threads) <= most:
        yield f"NUMBA_NUM_THREADS: expected an integer in [1, {most}], got {threads!r}; unset it, or set threads=N"
    if (switch := os.environ.get("NUMBA_DISABLE_JIT", "0")) != "0":
        yield f"NUMBA_DISABLE_JIT: expected 0, got {switch!r}; unset it, because the kernels must be compiled"
    layer = os.environ.get("NUMBA_THREADING_LAYER", "omp")
    if layer.lower() not in THREADING_LAYERS:
        yield f"NUMBA_THREADING_LAYER: expected one of {', '.join(THREADING_LAYERS)}, got {layer!r}; unset it"
    elif layer.lower() in ("tbb", "safe") and not _has_tbb():
        yield f"NUMBA_THREADING_LAYER: expected an installed TBB for {layer!r}, got none; run pip install tbb"
    order = os.environ.get("NUMBA_THREADING_LAYER_PRIORITY", "tbb omp workqueue")
    if sorted(order.split()) != ["omp", "tbb", "workqueue"]:
        yield (
            f"NUMBA_THREADING_LAYER_PRIORITY: expected the words omp, tbb and workqueue in any order, got {order!r}; "
            "unset it"
        )


def _other_variables() -> Iterator[str]:
    """Yield a line for each variable that numba ignores, with a warning that contains a traceback."""
    if not any(name.startswith("NUMBA_") and name not in KNOWN for name in os.environ):
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        import numba  # noqa: F401
    for warning in caught:
        if found := IGNORED.match(str(warning.message)):
            yield f"{found[1]}: expected a valid value, got {os.environ[found[1]]!r}; unset it"


def _has_tbb() -> bool:
    try:
        import numba.np.ufunc.tbbpool  # noqa: F401
    except ImportError:
        return False
    return True


def check_thread_limit() -> None:
    """Check that the system allows the threads of a run, before a library fails to start them.

    Raises:
        ConfigError: The system allows fewer threads.
    """
    cores = available_cores()
    started = _started_threads(threads := LEAST_THREADS + THREADS_PER_CORE * (cores - 1))
    if started < threads:
        raise ConfigError(
            f"process limit: expected at least {threads} threads for {cores} cores, got {started}; raise the limit "
            "(ulimit -u), or use one core (taskset -c 0 instancemap ...)"
        )


def _started_threads(count: int) -> int:
    """Return the number of threads that this process can start, including the main thread, up to `count`."""
    done = threading.Event()
    threads: list[threading.Thread] = []
    try:
        for _ in range(count - 1):
            thread = threading.Thread(target=done.wait)
            thread.start()
            threads.append(thread)
    except RuntimeError:  # can't start new thread
        pass
    finally:
        done.set()
        for thread in threads:
            thread.join()
    return 1 + len(threads)
