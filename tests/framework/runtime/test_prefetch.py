"""Tests for prefetching."""

from __future__ import annotations

import random
import threading
import time
from contextlib import nullcontext

import pytest

from framework.runtime.frame_stream import Turns, prefetched_map


def test_prefetched_map_is_bounded_and_ordered() -> None:
    begun: list[int] = []

    def square(k: int) -> int:
        begun.append(k)
        return k * k

    outcomes = prefetched_map(square, range(10), prefetch=2)
    assert next(outcomes) == 0
    assert max(begun, default=0) <= 2
    assert list(outcomes) == [k * k for k in range(1, 10)]
    assert begun == list(range(10))


def test_prefetched_map_overlaps_with_consumer() -> None:
    """Each side waits for the other, which would be a deadlock without a worker thread."""
    fusing, detected = threading.Event(), threading.Event()

    def detect(k: int) -> int:
        if k == 1:
            assert fusing.wait(10)
            detected.set()
        return k

    for k in prefetched_map(detect, range(2), prefetch=1):
        if k == 0:
            fusing.set()
            assert detected.wait(10)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_prefetched_map_results_keep_order(workers: int) -> None:
    def sleep(k: int) -> int:
        time.sleep(0.002 * (k % 3))
        return k

    assert list(prefetched_map(sleep, range(20), prefetch=3, workers=workers)) == list(range(20))


@pytest.mark.parametrize("workers", [1, 2])
def test_prefetched_map_worker_exception_is_raised_in_order(workers: int) -> None:
    def fail(k: int) -> int:
        if k == 3:
            raise OSError("the disk is gone")
        return k

    outcomes = prefetched_map(fail, range(100), prefetch=2, workers=workers)
    assert [next(outcomes) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(OSError, match="the disk is gone"):
        next(outcomes)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


def test_turns_run_in_order_despite_exceptions() -> None:
    turns, taken, inside = Turns(), [], threading.Lock()

    def work(number: int) -> None:
        with turns.turn(number):
            assert inside.acquire(blocking=False), "expected one turn at a time"
            taken.append(number)
            time.sleep(0.001)
            inside.release()
            if number % 3 == 0:
                raise OSError("expected")

    def quietly(number: int) -> None:
        with pytest.raises(OSError, match="expected") if number % 3 == 0 else nullcontext():
            work(number)

    numbers = list(range(12))
    random.Random(0).shuffle(numbers)
    threads = [threading.Thread(target=quietly, args=(number,), daemon=True) for number in numbers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert taken == list(range(12))
