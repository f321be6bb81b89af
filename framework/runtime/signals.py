"""Signals that ask a run to end: the first one is heard when the step in work is done, the second one at once."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from types import FrameType

ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Ctrl-C; what `kill`, SLURM and containers send; a terminal that is closed, which Windows does not know


class Interrupted(KeyboardInterrupt):
    """A signal ended the run. Whatever treats Ctrl-C well treats the others alike."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    def __str__(self) -> str:
        return (
            "interrupted by Ctrl-C" if self.number == signal.SIGINT else f"ended by {signal.Signals(self.number).name}"
        )


def _raise_interrupted(number: int, _frame: FrameType | None) -> None:
    raise Interrupted(number)


OURS_TO_HANDLE = (signal.SIG_DFL, signal.default_int_handler, _raise_interrupted)
"""Who ignores a signal, as scripts do for what they start in the background, or handles it, goes on to do so."""


def raise_on_signals() -> None:
    """Has every signal of ENDING raise Interrupted in this process, from now on."""
    for number in ENDING:
        if signal.getsignal(number) in OURS_TO_HANDLE:
            signal.signal(number, _raise_interrupted)


@dataclass
class Interruption:
    """What signals have asked for while they were deferred."""

    asked: Interrupted | None = None
    quiet: bool = False  # where another process says what happens
    _when: str = "after this frame"  # when the step that is in work is done, in words
    _at_once: bool = False  # whether a further signal raises

    def check(self) -> None:
        """Raises Interrupted where a signal has been heard."""
        if self.asked is not None:
            raise self.asked

    @contextmanager
    def second_ends_at_once(self, when: str) -> Iterator[None]:
        """While the body runs, the second signal raises in the middle of it; the first one is told that it ends `when`.

        Between such bodies no signal raises, so that what one of them has made reaches the next.
        """
        self._when, self._at_once = when, True
        try:
            yield
        finally:
            self._at_once = False

    def hear(self, number: int, _frame: FrameType | None) -> None:
        if self.asked is None:
            self.asked = Interrupted(number)
            if not self.quiet:
                _say(f"{self.asked}: ending {self._when}; a second time ends at once\n")
        elif self._at_once:
            raise Interrupted(number)


def _say(text: str) -> None:
    """To stderr, past its buffer and the log, which the signal may have come in the middle of."""
    if sys.__stderr__ is not None:
        with suppress(OSError, ValueError):
            os.write(sys.__stderr__.fileno(), text.encode())


_deferring: Interruption | None = None
_in_worker = ExitStack()  # which nobody leaves


@contextmanager
def signals_deferred(*numbers: int) -> Iterator[Interruption]:
    """While the body runs, the first of these signals is noted in what this yields, in place of raising.

    An exception in the middle of a frame would leave it half integrated. Inside of another such body, that one goes on.
    Outside the main thread, where Python does not let signals be handled, and for signals that others handle or ignore,
    nothing changes.
    """
    global _deferring
    if threading.current_thread() is not threading.main_thread():
        yield Interruption()
        return
    if _deferring is not None:
        for number in numbers:
            if signal.getsignal(number) == _deferring.hear:
                signal.signal(number, _deferring.hear)  # libraries set their own past Python, such as glog in pycolmap
        yield _deferring
        return
    interruption = _deferring = Interruption()
    before = {number: signal.getsignal(number) for number in numbers}
    taken = {number: handler for number, handler in before.items() if handler in OURS_TO_HANDLE}
    try:
        for number in taken:
            signal.signal(number, interruption.hear)
        yield interruption
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)
        _deferring = None


def heard_from_sweep() -> Interruption:
    """In a worker process of a sweep: what the sweep has asked for by SIGTERM, since the worker's first job.

    Of the other signals, which a terminal sends to all of its processes, the sweep decides what they mean.
    """
    for number in set(ENDING) - {signal.SIGTERM}:
        signal.signal(number, signal.SIG_IGN)
    if _deferring is None:
        _in_worker.enter_context(signals_deferred(signal.SIGTERM)).quiet = True
    assert _deferring is not None
    return _deferring


@contextmanager
def signals_passed_on(at_work: Callable[[], Collection[BaseProcess]]) -> Iterator[None]:
    """While the body runs, the first signal is passed on to the worker processes of this one, and raises in the end.

    It is passed on to those `at_work`, and that is when none is at work any more. An idle one may not have begun to
    listen: it would die, and joblib kills all workers when one has. The second signal raises at once.
    """

    def end_workers(number: int, _frame: FrameType | None) -> None:
        asked = Interrupted(number)
        for each in taken:
            signal.signal(each, _raise_interrupted)
        _say(f"{asked}: ending once the runs in work have left their records; a second time ends at once\n")
        told: set[int | None] = set()
        while busy := at_work():
            for worker in busy:
                if worker.pid not in told:
                    worker.terminate()
                    told.add(worker.pid)
            time.sleep(0.1)
        raise asked

    taken = [number for number in ENDING if signal.getsignal(number) in OURS_TO_HANDLE]
    for number in taken:
        signal.signal(number, end_workers)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, _raise_interrupted)
