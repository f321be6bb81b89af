"""An element's rows as columns. Rows whose lists are equally long are one NumPy table."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from framework.data import Array, Int64
from framework.files.ply_header import Element

LONGEST_ROW = 2**30  # bytes; NumPy takes no row of 2^31
Places = Sequence[int] | Int64


@dataclass(frozen=True)
class Lists:
    """A list property of N rows."""

    lengths: Int64  # (N,)
    values: Array  # (sum of lengths,)


@dataclass(frozen=True)
class Rows:
    """An element's N rows, in the file's types and the machine's byte order."""

    scalars: Mapping[str, Array]  # (N,) each
    lists: Mapping[str, Lists]
    unit: str  # "line" or "byte": what `places` counts
    places: Places  # (N,) where each row begins

    def place(self, row: int) -> str:
        return f"{self.unit} {self.places[row]}"


class Body(ABC):
    """What follows a header. Elements are read in the file's order."""

    @abstractmethod
    def rows(self, element: Element) -> Rows:
        """The next rows. Raises DataError, naming line or byte, when they are not what the header announced."""

    @abstractmethod
    def check_end(self) -> None:
        """Raises DataError, naming line or byte, when more follows than the header announced."""


def row_dtype(element: Element, lengths: Sequence[int], order: Literal["little", "big", "="]) -> np.dtype[Any] | None:
    """The type of rows with so many numbers in each column; None where NumPy has none."""
    fields: list[tuple[Any, ...]] = []
    for k, (column, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if column.count is not None:
            fields.append((f"length{k}", column.count.newbyteorder(order)))
        fields.append((f"values{k}", column.dtype.newbyteorder(order), (length,)))
    size = sum(column.dtype.itemsize * n for column, n in zip(element.properties, lengths, strict=True))
    return np.dtype(fields) if min(lengths) > 0 and size < LONGEST_ROW else None


def alike(table: npt.NDArray[np.void]) -> bool:
    """Whether the lists of each column really are as long as the table's type assumes."""
    assert table.dtype.fields is not None
    return all(
        (table[name] == table.dtype[name.replace("length", "values")].shape[0]).all()
        for name in table.dtype.fields
        if name.startswith("length")
    )


def rows_of_table(element: Element, table: npt.NDArray[np.void], unit: str, places: Places) -> Rows:
    """The columns of rows that are alike."""
    values = [table[f"values{k}"] for k in range(len(element.properties))]
    lengths = [np.broadcast_to(np.int64(column.shape[1]), len(table)) for column in values]  # takes no memory
    return rows_of_columns(element, [column.reshape(-1) for column in values], lengths, unit, places)


def rows_of_columns(
    element: Element, values: Sequence[Array], lengths: Sequence[Int64], unit: str, places: Places
) -> Rows:
    """Rows from each column's numbers, one behind the other, and how many each row has."""
    scalars, lists = {}, {}
    for column, numbers, counts in zip(element.properties, values, lengths, strict=True):
        native = np.ascontiguousarray(numbers, column.dtype)
        if column.count is None:
            scalars[column.name] = native
        else:
            lists[column.name] = Lists(counts, native)
    return Rows(scalars, lists, unit, places)


def no_rows(element: Element, unit: str) -> Rows:
    nothing = [np.empty(0, np.int64)] * len(element.properties)
    return rows_of_columns(element, nothing, nothing, unit, ())
