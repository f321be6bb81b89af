"""Signals are heard once the step in work is done, and then at once; who handles them otherwise goes on to do so."""

from __future__ import annotations

import pickle
import signal
import threading
from collections.abc import Iterator

import pytest

from framework.runtime.signals import ENDING, Interrupted, raise_on_signals, signals_deferred


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Those of before, afterwards."""
    before = {number: signal.getsignal(number) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDING)
def test_the_first_is_noted_and_the_second_raises_where_it_may(
    number: signal.Signals, capfd: pytest.CaptureFixture[str]
) -> None:
    signal.signal(number, signal.SIG_DFL)
    with signals_deferred(*ENDING) as interruption:
        interruption.check()
        with interruption.second_ends_at_once("after this frame"):
            signal.raise_signal(number)
        assert interruption.asked is not None
        assert interruption.asked.number == number
        signal.raise_signal(number)  # between two steps: what the first has made must reach the second
        with pytest.raises(Interrupted) as second, interruption.second_ends_at_once("once the record is written"):
            signal.raise_signal(number)
        assert second.value.number == number
        with pytest.raises(Interrupted):
            interruption.check()
    said = "interrupted by Ctrl-C" if number == signal.SIGINT else f"ended by {number.name}"
    assert capfd.readouterr().err == f"{said}: ending after this frame; a second time ends at once\n"
    assert signal.getsignal(number) is signal.SIG_DFL


@pytest.fixture(autouse=True)
def nobody_else_handles_signals() -> Iterator[None]:
    """Libraries that other tests load in this process, such as Ray, have handlers of their own."""
    before = {number: signal.getsignal(number) for number in ENDING}
    for number in ENDING:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_one_inside_of_another_is_the_same() -> None:
    with signals_deferred(signal.SIGINT, signal.SIGTERM) as outer:
        with signals_deferred(signal.SIGINT) as inner:
            assert inner is outer
        signal.raise_signal(signal.SIGTERM)
        assert outer.asked is not None
    with signals_deferred(signal.SIGINT) as later:
        assert later.asked is None


def test_who_ignores_or_handles_a_signal_goes_on_to_do_so() -> None:
    """Scripts start what is in the background with Ctrl-C ignored; submitit handles SIGTERM in its jobs."""
    heard: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    raise_on_signals()
    with signals_deferred(*ENDING) as interruption:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
    assert (interruption.asked, heard) == (None, [signal.SIGTERM])


def test_every_signal_raises_in_a_process_that_asks_for_it() -> None:
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
    raise_on_signals()
    for number in ENDING:
        with pytest.raises(KeyboardInterrupt) as ended:
            signal.raise_signal(number)
        assert isinstance(ended.value, Interrupted)
        assert ended.value.number == number


def test_it_reaches_the_process_that_began_a_sweep() -> None:
    copy = pickle.loads(pickle.dumps(Interrupted(signal.SIGTERM)))
    assert (copy.number, str(copy)) == (signal.SIGTERM, "ended by SIGTERM")


def test_other_threads_are_left_alone() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen: list[object] = []

    def elsewhere() -> None:
        with signals_deferred(signal.SIGINT):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [before]
