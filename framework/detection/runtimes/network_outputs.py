"""What a network in a file answers, whichever library runs it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from framework.data import Array, Float32
from framework.errors import DataError, in_one_line

Outputs = dict[str, Float32]


def finite_outputs(path: Path, named: Iterable[tuple[str, Array]]) -> Outputs:
    """The outputs by name in float32. Raises DataError when one holds numbers that are not finite."""
    outputs = {name: np.asarray(array, np.float32) for name, array in named}
    for name, array in outputs.items():
        if not np.isfinite(array).all():
            raise DataError(f"{path}: the output {name} holds values that are not finite")
    return outputs


def one_line(error: Exception) -> str:
    """The beginning of what a library's exception says, for a message: some add a whole trace."""
    return in_one_line(error)[:300]
