"""Tests for the memory of a process."""

import numpy as np

from tests.support.process_memory import memory


def test_heap_contains_arrays() -> None:
    before = memory().heap
    array = np.ones(10**6)
    assert 8e6 <= memory().heap - before < 9e6
    del array
