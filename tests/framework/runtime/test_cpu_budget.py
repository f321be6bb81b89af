"""Tests for the CPU budget.

The cores are divided between prefetching and mapping according to the recent load of both.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import cast
from unittest.mock import Mock

import numba
import pytest

from framework.runtime import cpu_budget
from framework.runtime.cpu_budget import RECENT, CpuBudget


@pytest.fixture
def thread_time(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[float], None]]:
    """Replace the CPU clock. Return a function that advances the clock by a number of seconds."""
    now = [0.0]
    monkeypatch.setattr(time, "thread_time", lambda: now[0])

    def passes(seconds: float) -> None:
        now[0] += seconds

    return passes


@pytest.fixture(params=[1, 2, 4])
def sharing(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> CpuBudget:
    """Return a budget of 1, 2 or 4 cores. The thread limit of Numba is simulated, and priorities are not changed."""
    monkeypatch.setattr(cpu_budget, "lower_priority", Mock())
    threads = [request.param]
    monkeypatch.setattr(numba, "get_num_threads", lambda: threads[0])
    monkeypatch.setattr(numba, "set_num_threads", lambda number: threads.__setitem__(0, number))
    return CpuBudget()


def pass_frames(sharing: CpuBudget, passes: Callable[[float], None], ahead: float, mapping: float) -> None:
    """Simulate frames with `ahead` s of prefetching and `mapping` s of mapping, which is perfectly parallel."""
    for _ in range(RECENT):
        with sharing.prefetching():
            passes(ahead)
        with sharing.mapping():
            passes(mapping / numba.get_num_threads())


def test_cpu_budget_splits_equal_load_evenly(sharing: CpuBudget, thread_time: Callable[[float], None]) -> None:
    assert sharing.prefetch_cores() == sharing.cores // 2  # no measurements yet
    pass_frames(sharing, thread_time, ahead=1.0, mapping=1.1)
    assert sharing.prefetch_cores() == sharing.cores // 2


def test_cpu_budget_assigns_all_cores_to_loaded_side(sharing: CpuBudget, thread_time: Callable[[float], None]) -> None:
    pass_frames(sharing, thread_time, ahead=0.1, mapping=1.0)  # without a network, prefetching only reads a frame
    assert sharing.prefetch_cores() == 0
    with sharing.mapping():
        assert numba.get_num_threads() == sharing.cores
    with sharing.prefetching():
        assert numba.get_num_threads() == 1
    assert numba.get_num_threads() == sharing.cores
    pass_frames(sharing, thread_time, ahead=20.0, mapping=1.0)
    assert sharing.prefetch_cores() == sharing.cores
    with sharing.mapping():
        assert numba.get_num_threads() == 1


def test_cpu_budget_lowers_priority_if_all_cores_map(sharing: CpuBudget, thread_time: Callable[[float], None]) -> None:
    lower_priority = cast(Mock, cpu_budget.lower_priority)
    pass_frames(sharing, thread_time, ahead=20.0, mapping=1.0)
    lower_priority.reset_mock()
    with sharing.prefetching():
        lower_priority.assert_not_called()
    pass_frames(sharing, thread_time, ahead=0.1, mapping=1.0)
    with sharing.prefetching():
        lower_priority.assert_called()


def test_cpu_budget_without_prefetch_keeps_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_budget, "lower_priority", Mock())
    budget = CpuBudget(with_prefetch=False)
    pass_frames(budget, lambda _: None, ahead=0.1, mapping=1.0)
    cast(Mock, cpu_budget.lower_priority).assert_not_called()


def test_cpu_budget_is_divided_among_workers(sharing: CpuBudget, thread_time: Callable[[float], None]) -> None:
    pass_frames(sharing, thread_time, ahead=20.0, mapping=1.0)
    with sharing.prefetching(workers=2):
        assert numba.get_num_threads() == max(sharing.cores // 2, 1)


def test_cpu_budget_ignores_single_slow_frame(sharing: CpuBudget, thread_time: Callable[[float], None]) -> None:
    pass_frames(sharing, thread_time, ahead=1.0, mapping=1.1)
    with sharing.mapping():
        thread_time(100.0)  # a frame with compilation of kernels
    assert sharing.prefetch_cores() == sharing.cores // 2


def test_cpu_budget_restores_thread_count_after_exception(sharing: CpuBudget) -> None:
    with pytest.raises(RuntimeError, match="lost"), sharing.mapping():
        raise RuntimeError("lost")
    assert numba.get_num_threads() == sharing.cores


def test_cpu_budget_is_thread_safe() -> None:
    sharing = CpuBudget()

    def side(around: Callable[[], object]) -> None:
        for _ in range(2000):
            with around():  # type: ignore[attr-defined]
                sharing.prefetch_cores()

    threads = [threading.Thread(target=side, args=(around,)) for around in (sharing.prefetching, sharing.mapping)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert 0 <= sharing.prefetch_cores() <= sharing.cores


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads exist only on Linux")
@pytest.mark.parametrize(("before", "calls"), [(0, 1), (10, 0), (19, 0)])
def test_lower_priority_changes_only_higher_priorities(
    before: int, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Raising the priority requires privileges."""
    monkeypatch.setattr(os, "getpriority", lambda *_: before)
    setpriority = Mock()
    monkeypatch.setattr(os, "setpriority", setpriority)
    cpu_budget.lower_priority()
    assert setpriority.call_count == calls
