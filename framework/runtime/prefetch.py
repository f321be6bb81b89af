"""Work that other threads do in front of whoever uses it, in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Condition
from typing import TypeVar

import numba

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def map_ahead(
    function: Callable[[Item], Outcome], items: Iterable[Item], ahead: int, workers: int = 1
) -> Generator[Outcome]:
    """`map(function, items)` by so many `workers`, threads that stay at most `ahead` outcomes in front of the consumer.

    What a worker raises is raised here, in its place. Closing the generator ends the workers after the items in work.
    """
    if ahead == 0:
        yield from map(function, items)
        return
    # numba keeps its number of threads by thread: the workers get the consumer's
    pool = ThreadPoolExecutor(workers, "detect-ahead", numba.set_num_threads, (numba.get_num_threads(),))
    pending: deque[Future[Outcome]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class Turns:
    """Has several threads do a part of their work one after the other, in the order of their numbers from 0 on."""

    def __init__(self) -> None:
        self._next = 0
        self._changed = Condition()

    @contextmanager
    def turn(self, number: int) -> Iterator[None]:
        """Waits until all smaller numbers have had theirs."""
        with self._changed:
            self._changed.wait_for(lambda: self._next == number)
        try:
            yield
        finally:
            with self._changed:
                self._next += 1
                self._changed.notify_all()
