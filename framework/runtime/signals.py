"""Signal handling.

The first signal ends a run after the current step. The second signal ends it immediately, unless it is SIGXCPU.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any

# SIGINT: Ctrl-C. SIGTERM: `kill`, SLURM and containers. Not on Windows: SIGHUP, a closed terminal; SIGXCPU, SIGUSR1 and
# SIGUSR2, warnings of batch systems before they kill a job.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGXCPU", "SIGUSR1", "SIGUSR2")
ENDING = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
REPEATED = tuple(number for number in ENDING if number.name == "SIGXCPU")
"""Signals that the kernel repeats: SIGXCPU for each second of CPU time beyond the soft limit."""


class Interrupted(KeyboardInterrupt):
    """End of a run by a signal. Code that handles Ctrl-C also handles this exception."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number

    def __str__(self) -> str:
        by_ctrl_c = self.number == signal.SIGINT
        return "interrupted by Ctrl-C" if by_ctrl_c else f"ended by {signal.Signals(self.number).name}"


def _raise_interrupted(number: int, _frame: FrameType | None) -> None:
    _ignore_repetitions(number)
    raise Interrupted(number)


def _ignore_repetitions(number: int) -> None:
    """Ignore a signal of REPEATED from now on."""
    if number in REPEATED:
        signal.signal(number, signal.SIG_IGN)


def _restore(handlers: Mapping[int, Any]) -> None:
    """Set the handlers of signals again, except for signals that are ignored because the kernel repeats them."""
    for number, handler in handlers.items():
        if number not in REPEATED or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def _exit(_number: int, _frame: FrameType | None) -> None:
    os._exit(_exit_status)


_exit_status = 0  # of `exit_on_signals`

RAISING = (signal.default_int_handler, _raise_interrupted)
OURS_TO_HANDLE = (signal.SIG_DFL, *RAISING, _exit)
"""Handlers that may be replaced. Ignored signals, and signals with other handlers, are not changed."""


def raise_on_signals() -> None:
    """Raise Interrupted when this process receives a signal of ENDING.

    Handlers of other programs are not replaced.
    """
    for number in ENDING:
        if signal.getsignal(number) in OURS_TO_HANDLE:
            signal.signal(number, _raise_interrupted)


def exit_on_signals(status: int) -> None:
    """Exit with `status` when this process receives a signal of ENDING.

    Call this function when all work is done. Otherwise, a signal while the interpreter exits would print a traceback.
    """
    global _exit_status
    _exit_status = status
    _set_handlers(_exit)
    # after the exit functions, Python replaces handlers written in Python by the default, which loses the status
    atexit.register(_set_handlers, signal.SIG_IGN)


def _set_handlers(handler: Any) -> None:
    for number in ENDING:
        if signal.getsignal(number) in OURS_TO_HANDLE:
            signal.signal(number, handler)


@contextmanager
def interruptible_imports() -> Iterator[None]:
    """Raise Interrupted at a signal in the `with` body, and again at its end.

    An extension module that is interrupted while it is loaded may suppress the exception, or raise another one.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[Interrupted] = []

    def receive(number: int, _frame: FrameType | None) -> None:
        received.append(Interrupted(number))
        raise received[0]

    before = {number: signal.getsignal(number) for number in ENDING}
    taken = {number: handler for number, handler in before.items() if handler in RAISING}
    try:
        for number in taken:
            signal.signal(number, receive)
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)
        if received:
            raise received[0] from None


@dataclass
class Interruption:
    """The signal received while signals are deferred, if any."""

    received: Interrupted | None = None
    quiet: bool = False  # true if another process prints messages
    _when: str = "after this frame"  # end of the current step, for the message
    _at_once: bool = False  # true if the second signal raises

    def check(self) -> None:
        """Raise Interrupted if a signal was received."""
        if self.received is not None:
            raise self.received

    @contextmanager
    def second_ends_at_once(self, when: str) -> Iterator[None]:
        """Raise Interrupted at the second signal in the `with` body.

        Signals outside of such bodies do not raise, so that no result is lost between two steps.

        Args:
            when: End of the current step, for the message at the first signal, such as "after this frame".
        """
        self._when, self._at_once = when, True
        try:
            yield
        finally:
            self._at_once = False

    def receive(self, number: int, _frame: FrameType | None) -> None:
        _ignore_repetitions(number)
        if self.received is None:
            self.received = Interrupted(number)
            if not self.quiet:
                _print(f"{self.received}: stopping {self._when}; a second signal stops immediately\n")
        elif self._at_once and number not in REPEATED:
            raise Interrupted(number)


def _print(text: str) -> None:
    """Write to stderr directly, because the signal may have interrupted a buffered write."""
    if sys.__stderr__ is not None:
        with suppress(OSError, ValueError):
            os.write(sys.__stderr__.fileno(), text.encode())


_deferring: Interruption | None = None
_in_worker = ExitStack()  # never closed


@contextmanager
def signals_deferred(*numbers: int) -> Iterator[Interruption]:
    """Defer signals in the `with` body, and yield a record of the first signal.

    Without deferral, an exception could leave a frame partly integrated. A nested call yields the outer record. Other
    threads, ignored signals and signals with other handlers are not affected.
    """
    global _deferring
    if threading.current_thread() is not threading.main_thread():
        yield Interruption()
        return
    if _deferring is not None:
        for number in numbers:
            if signal.getsignal(number) == _deferring.receive:
                signal.signal(number, _deferring.receive)  # restore the handler: libraries such as glog replace it
        yield _deferring
        return
    interruption = _deferring = Interruption()
    before = {number: signal.getsignal(number) for number in numbers}
    taken = {number: handler for number, handler in before.items() if handler in OURS_TO_HANDLE}
    try:
        for number in taken:
            signal.signal(number, interruption.receive)
        yield interruption
    finally:
        _restore(taken)
        _deferring = None


def received_from_sweep() -> Interruption:
    """Return the record of the SIGTERM that the sweep sends to this worker process, or of its own CPU limit.

    Terminals and batch systems send all other signals to both the sweep and its workers. The workers ignore these
    signals.
    """
    own = (signal.SIGTERM, *REPEATED)
    for number in set(ENDING) - set(own):
        signal.signal(number, signal.SIG_IGN)
    if _deferring is None:
        _in_worker.enter_context(signals_deferred(*own)).quiet = True
    assert _deferring is not None
    return _deferring


def signal_received() -> bool:
    """Return True if a deferred signal was received."""
    return _deferring is not None and _deferring.received is not None


@contextmanager
def signals_passed_on(at_work: Callable[[], Collection[BaseProcess]]) -> Iterator[None]:
    """Forward the first signal in the `with` body to the busy workers.

    Interrupted is raised after these workers have finished, or immediately at the second signal.

    Args:
        at_work: Function that returns the busy worker processes.
    """

    def end_workers(number: int, _frame: FrameType | None) -> None:
        received = Interrupted(number)
        for each in taken:
            signal.signal(each, signal.SIG_IGN if each in REPEATED else _raise_interrupted)
        _print(
            f"{received}: stopping after the active runs have written their outputs; "
            "a second signal stops immediately\n"
        )
        # idle workers get no signal: they may have no handler yet, and joblib kills all workers when one ends
        signaled: set[int | None] = set()
        while busy := at_work():
            for worker in busy:
                if worker.pid not in signaled:
                    worker.terminate()
                    signaled.add(worker.pid)
            time.sleep(0.1)
        raise received

    taken = [number for number in ENDING if signal.getsignal(number) in OURS_TO_HANDLE]
    for number in taken:
        signal.signal(number, end_workers)
    try:
        yield
    finally:
        _restore(dict.fromkeys(taken, _raise_interrupted))
