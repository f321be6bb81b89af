"""What the readers of cameras share: frames as a library hands them out, and words while it does not."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import TypeVar

from framework.errors import DataError

WAIT_MS = 100  # for a frame, before something is said
LONGEST_SILENCE = 5.0  # s; a camera that runs and sends nothing for so long is broken, or its cable is

Images = TypeVar("Images")


def images_of(name: str, wait: Callable[[], Images | None]) -> Generator[Images | None]:
    """What `wait` returns, again and again; None = nothing came for WAIT_MS. Raises DataError after a long silence."""
    heard = time.monotonic()
    while True:
        images = wait()
        if images is not None:
            heard = time.monotonic()
        elif time.monotonic() - heard > LONGEST_SILENCE:
            raise DataError(f"{name}: no frame has come for {LONGEST_SILENCE:g} s; is the camera still connected?")
        yield images
