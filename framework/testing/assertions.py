"""How the contracts compare what plugins return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import is_dataclass

import numpy as np

from framework.errors import DataError


def same(a: object, b: object) -> bool:
    """Whether two of the pipeline's data hold the same arrays."""
    return all(
        same(x, y) if is_dataclass(x) else np.array_equal(x, y)
        for x, y in zip(vars(a).values(), vars(b).values(), strict=True)
    )


def refused(call: Callable[[], object], words: str) -> None:
    """Asserts that the call raises a DataError of one line with these words."""
    try:
        call()
    except DataError as error:
        assert words in str(error), f"{str(error)!r} does not say {words!r}"
        assert "\n" not in str(error)
    else:
        raise AssertionError(f"nothing was raised; expected a DataError with {words!r}")
