"""Work in background threads whose results do not depend on timing."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import numba

from framework.runtime.cpu_budget import lower_priority, parallel_kernels_are_thread_safe

Result = TypeVar("Result")


class DelayedResult(Generic[Result]):
    """The result of a call in a background thread of low priority. It is used a fixed number of frames later.

    If numba's threading layer is not thread-safe, the thread that uses the result calls.
    """

    def __init__(self, call: Callable[[], Result], due: int) -> None:
        """Start the call.

        Args:
            call: The call. It must not read what other threads change.
            due: The number of the frame at which the result is used.
        """
        self.due = due
        self._call = call
        self._future: Future[Result] | None = None
        if parallel_kernels_are_thread_safe():
            worker = ThreadPoolExecutor(1, "pose_graph", _begin_thread)
            self._future = worker.submit(call)
            worker.shutdown(wait=False)  # the thread ends after the call

    def get(self) -> Result:
        """Return the result, after waiting for it, or raise the exception of the call."""
        return self._call() if self._future is None else self._future.result()


def _begin_thread() -> None:
    lower_priority()
    numba.set_num_threads(1)
