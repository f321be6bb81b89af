"""The rows of a binary PLY file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from framework.data import Array, Int64
from framework.errors import DataError
from framework.files.ply_header import Element, Header, Property, shown
from framework.files.ply_rows import Body, Rows, alike, no_rows, row_dtype, rows_of_columns, rows_of_table


class BinaryBody(Body):
    """Rows of bytes."""

    def __init__(self, path: Path, data: bytes, header: Header) -> None:
        self._path, self._data, self._position = path, data, header.size
        self._order: Literal["little", "big"] = "big" if header.format == "binary_big_endian" else "little"

    def rows(self, element: Element) -> Rows:
        if not element.rows:
            return no_rows(element, "byte")
        row = row_dtype(element, self._first_lengths(element), self._order)
        start = self._position
        if row is not None and start + element.rows * row.itemsize <= len(self._data):
            table = np.frombuffer(self._data, row, element.rows, start)
            if alike(table):
                self._position += table.nbytes
                return rows_of_table(element, table, "byte", range(start, self._position, row.itemsize))
        return self._walk(element)

    def check_end(self) -> None:
        rest = self._data[self._position :]
        if rest.strip():  # some writers end with a line end
            raise DataError(
                f"{self._path}, byte {self._position}: {len(rest)} bytes follow the last row that the header announces"
            )

    def _first_lengths(self, element: Element) -> list[int]:
        """How many numbers each column has in the next row."""
        lengths, position = [], self._position
        for column in element.properties:
            position, length = self._step(element, 0, column, position)
            lengths.append(length)
        return lengths

    def _walk(self, element: Element) -> Rows:
        """Rows whose lists have different lengths: each begins where the one before it ends."""
        places = np.empty(element.rows, np.int64)
        ends = np.empty((len(element.properties), element.rows), np.int64)
        lengths = np.empty_like(ends)
        position = self._position
        for row in range(element.rows):
            places[row] = position
            for k, column in enumerate(element.properties):
                position, lengths[k, row] = self._step(element, row, column, position)
                ends[k, row] = position
        self._position = position
        values = [self._gathered(column.dtype, ends[k], lengths[k]) for k, column in enumerate(element.properties)]
        return rows_of_columns(element, values, list(lengths), "byte", places)

    def _step(self, element: Element, row: int, column: Property, position: int) -> tuple[int, int]:
        """Where the column's numbers end if it begins at byte `position`, and how many they are."""
        length = 1
        if column.count is not None:
            first, position = position, position + column.count.itemsize
            length = int.from_bytes(self._data[first:position], self._order, signed=column.count.kind == "i")
            if length < 0:
                raise DataError(
                    f"{self._path}, byte {first}: {shown(element.name)} {row} has a list of {length} numbers"
                )
        position += length * column.dtype.itemsize
        if position > len(self._data):
            raise self._truncated(element, row)
        return position, length

    def _gathered(self, dtype: np.dtype[Any], ends: Int64, lengths: Int64) -> Array:
        """The numbers (sum of lengths,) that end at these bytes, so many before each end."""
        before_end = np.repeat(np.cumsum(lengths), lengths) - np.arange(lengths.sum())
        starts = np.repeat(ends, lengths) - before_end * dtype.itemsize
        found = np.frombuffer(self._data, np.uint8)[starts[:, None] + np.arange(dtype.itemsize)]
        return np.asarray(found.reshape(-1).view(dtype.newbyteorder(self._order)))

    def _truncated(self, element: Element, row: int) -> DataError:
        return DataError(
            f"{self._path}, byte {len(self._data)}: the file ends in {shown(element.name)} {row}, "
            f"but its header announces {element.rows}"
        )
