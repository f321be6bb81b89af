"""The same computation with one thread and with two threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba
import pytest

from tests.support.cores import all_cores

Made = TypeVar("Made")


def by_one_thread_and_two(make: Callable[[], Made]) -> tuple[Made, Made]:
    """Return the results of `make` with one and with two numba threads. Skip the test on a single core."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("this machine has one core")
    usual = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        by_one = make()
        numba.set_num_threads(2)
        with all_cores():
            return by_one, make()
    finally:
        numba.set_num_threads(usual)
