"""Tests for deferred signals. The first signal takes effect after the current step, a second one immediately."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from framework.runtime.signals import (
    ENDING,
    REPEATED,
    Interrupted,
    interruptible_imports,
    raise_on_signals,
    signals_deferred,
)

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Restore the signal handlers after the test."""
    before = {number: signal.getsignal(number) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", sorted({*ENDING} - {*REPEATED}))
def test_signals_deferred_first_waits_and_second_raises(
    number: signal.Signals, capfd: pytest.CaptureFixture[str]
) -> None:
    signal.signal(number, signal.SIG_DFL)
    with signals_deferred(*ENDING) as interruption:
        interruption.check()
        with interruption.second_ends_at_once("after this frame"):
            signal.raise_signal(number)
        assert interruption.received is not None
        assert interruption.received.number == number
        signal.raise_signal(number)  # a signal between two steps must not raise, or the result would be lost
        with pytest.raises(Interrupted) as second, interruption.second_ends_at_once("after the outputs are written"):
            signal.raise_signal(number)
        assert second.value.number == number
        with pytest.raises(Interrupted):
            interruption.check()
    message = "interrupted by Ctrl-C" if number == signal.SIGINT else f"ended by {number.name}"
    assert capfd.readouterr().err == f"{message}: stopping after this frame; a second signal stops immediately\n"
    assert signal.getsignal(number) is signal.SIG_DFL


@pytest.mark.parametrize("first", sorted({*REPEATED, signal.SIGTERM}))
def test_signals_deferred_repeated_signal_never_raises(first: signal.Signals) -> None:
    """The kernel sends SIGXCPU every second, also to a run that another signal is ending."""
    raise_on_signals()
    for number in REPEATED:
        with signals_deferred(*ENDING) as interruption, interruption.second_ends_at_once("after this frame"):
            for sent in (first, number, number):
                signal.raise_signal(sent)
        assert interruption.received is not None
        assert interruption.received.number == first
        signal.raise_signal(number)


@pytest.mark.parametrize("number", REPEATED)
def test_raise_on_signals_raises_repeated_signal_once(number: signal.Signals) -> None:
    raise_on_signals()
    with pytest.raises(Interrupted):
        signal.raise_signal(number)
    signal.raise_signal(number)


@pytest.fixture(autouse=True)
def default_signal_handlers() -> Iterator[None]:
    """Restore the default signal handlers, which libraries such as Ray change in other tests."""
    before = {number: signal.getsignal(number) for number in ENDING}
    for number in ENDING:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_signals_deferred_nested_returns_outer_context() -> None:
    with signals_deferred(signal.SIGINT, signal.SIGTERM) as outer:
        with signals_deferred(signal.SIGINT) as inner:
            assert inner is outer
        signal.raise_signal(signal.SIGTERM)
        assert outer.received is not None
    with signals_deferred(signal.SIGINT) as later:
        assert later.received is None


def test_signals_deferred_keeps_existing_handlers() -> None:
    """SIGINT is ignored in background jobs of a shell, and submitit handles SIGTERM."""
    received: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    raise_on_signals()
    with signals_deferred(*ENDING) as interruption:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
    assert (interruption.received, received) == (None, [signal.SIGTERM])


def test_raise_on_signals_raises_for_each_signal() -> None:
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
    raise_on_signals()
    for number in ENDING:
        with pytest.raises(KeyboardInterrupt) as ended:
            signal.raise_signal(number)
        assert isinstance(ended.value, Interrupted)
        assert ended.value.number == number


def test_interrupted_exception_is_picklable() -> None:
    copy = pickle.loads(pickle.dumps(Interrupted(signal.SIGTERM)))
    assert (copy.number, str(copy)) == (signal.SIGTERM, "ended by SIGTERM")


def test_signals_deferred_in_other_thread_has_no_effect() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen: list[object] = []

    def elsewhere() -> None:
        with signals_deferred(signal.SIGINT):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [before]


def suppress_signal() -> None:
    with suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def replace_signal() -> None:
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise ImportError("expected a working extension module") from None


@pytest.mark.parametrize("load", [suppress_signal, replace_signal])
def test_import_that_suppresses_signal_is_interrupted(load: Callable[[], None]) -> None:
    before = {number: signal.getsignal(number) for number in ENDING}
    with pytest.raises(Interrupted, match="interrupted by Ctrl-C"), interruptible_imports():
        load()
    assert {number: signal.getsignal(number) for number in ENDING} == before


EXITING = """
import atexit, signal, sys, threading, time
from framework.runtime.signals import exit_on_signals, raise_on_signals

def wait(name):
    print(name, flush=True)
    time.sleep(20)

raise_on_signals()
threading.Thread(target=wait, args=("thread",)).start() if sys.argv[1] == "thread" else atexit.register(wait, "exit")
exit_on_signals(143)
sys.exit(143)
"""


@pytest.mark.integration
@pytest.mark.parametrize("number", ENDING)
def test_signal_to_waiting_thread_at_exit_keeps_status(number: int) -> None:
    line = [sys.executable, "-c", EXITING, "thread"]
    with subprocess.Popen(line, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "thread\n"
        time.sleep(0.3)  # the main thread waits for the other thread
        process.send_signal(number)
        _, stderr = process.communicate(timeout=10)
    assert (process.returncode, stderr) == (143, "")


@pytest.mark.integration
@pytest.mark.parametrize("number", ENDING)
def test_signal_to_exit_function_keeps_status(number: int) -> None:
    line = [sys.executable, "-c", EXITING.replace("sleep(20)", "sleep(1)"), "exit"]
    with subprocess.Popen(line, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "exit\n"
        process.send_signal(number)
        _, stderr = process.communicate(timeout=10)
    assert (process.returncode, stderr) == (143, "")
