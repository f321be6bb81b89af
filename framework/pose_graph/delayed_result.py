"""Work in background threads whose results do not depend on timing."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

from framework.runtime.cpu_budget import lower_priority

Result = TypeVar("Result")


class DelayedResult(Generic[Result]):
    """The result of a call in a background thread of low priority. It is used a fixed number of frames later."""

    def __init__(self, call: Callable[[], Result], due: int) -> None:
        """Start the call.

        Args:
            call: The call. It must not read what other threads change.
            due: The number of the frame at which the result is used.
        """
        self.due = due
        worker = ThreadPoolExecutor(1, "pose_graph", lower_priority)
        self._future = worker.submit(call)
        worker.shutdown(wait=False)  # the thread ends after the call

    def get(self) -> Result:
        """Return the result, after waiting for it, or raise the exception of the call."""
        return self._future.result()
