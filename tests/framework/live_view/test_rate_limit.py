"""What takes time is done seldom."""

from __future__ import annotations

import pytest

from framework.live_view import rate_limit
from framework.live_view.rate_limit import Pace


class Clock:
    now = 100.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(rate_limit.time, "perf_counter", lambda: clock.now)
    return clock


def did(paced: Pace, clock: Clock, seconds: float) -> None:
    with paced.kept():
        clock.now += seconds


@pytest.mark.parametrize(("seconds", "next_after"), [(0.001, 1.0), (0.2, 4.0)])
def test_it_waits_for_its_time_and_for_its_share(clock: Clock, seconds: float, next_after: float) -> None:
    paced = Pace(1.0, 0.05, lambda: clock.now)
    assert paced.due()
    did(paced, clock, seconds)
    clock.now = 100 + next_after - 0.01
    assert not paced.due()
    clock.now += 0.02
    assert paced.due()


def test_it_is_not_due_while_it_is_done(clock: Clock) -> None:
    paced = Pace(1.0, 0.05, lambda: clock.now)
    with paced.kept():
        assert not paced.due()
