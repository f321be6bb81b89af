"""The rows of an ASCII PLY file."""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from framework.errors import DataError
from framework.files.ply_header import Element, Header, shown
from framework.files.ply_rows import Body, Rows, alike, no_rows, row_dtype, rows_of_columns, rows_of_table

LONGEST_LINE = 2**20  # bytes; a longer line is damage, and splitting it would take tens of times its memory


class TextBody(Body):
    """Rows as lines of numbers; empty lines are skipped."""

    def __init__(self, path: Path, data: bytes, header: Header) -> None:
        self._path, self._line = path, header.lines
        self._file = io.BytesIO(data)
        self._file.seek(header.size)

    def rows(self, element: Element) -> Rows:
        if not element.rows:
            return no_rows(element, "line")
        start = self._file.tell(), self._line
        rows = self._read_at_once(element)
        if rows is None:
            self._go(start)
            rows = self._walk(element)
        return rows

    def check_end(self) -> None:
        if next(self._lines(array("q")), None) is not None:
            raise DataError(f"{self._path}, line {self._line}: the rows that the header announces end before this line")

    def _read_at_once(self, element: Element) -> Rows | None:
        """The rows when they are like the first one; None when they are not, or one is at fault."""
        start = self._file.tell(), self._line
        first = next(self._lines(array("q")), None)
        if first is None:
            return None
        row = row_dtype(element, [len(numbers) for numbers in self._parsed(element, 0, first)], "=")
        if row is None:
            return None
        self._go(start)
        places = array("q")
        try:
            table = np.loadtxt(islice(self._lines(places), element.rows), row, comments=None, ndmin=1)
        except ValueError:  # the walk finds the line
            return None
        if len(table) < element.rows or not alike(table):
            return None
        return rows_of_table(element, table, "line", places)

    def _walk(self, element: Element) -> Rows:
        """Row by row: for lists of different lengths, and to say which line is at fault."""
        places = array("q")
        values = [array("d" if column.dtype.kind == "f" else "q") for column in element.properties]
        lengths = [array("q") for _ in element.properties]
        for row, line in enumerate(islice(self._lines(places), element.rows)):
            for k, numbers in enumerate(self._parsed(element, row, line)):
                values[k].extend(numbers)
                lengths[k].append(len(numbers))
        if len(places) < element.rows:
            raise DataError(
                f"{self._path}, line {self._line}: the file ends after {len(places)} rows of {shown(element.name)}, "
                f"but its header announces {element.rows}"
            )
        counts = [np.array(found, np.int64) for found in lengths]
        with np.errstate(over="ignore"):  # whoever needs finite numbers checks them
            return rows_of_columns(element, [np.array(found) for found in values], counts, "line", places)

    def _lines(self, places: array[int]) -> Iterator[bytes]:
        """The lines that hold something; their numbers are appended to `places`."""
        for line in self._file:
            self._line += 1
            if len(line) > LONGEST_LINE:
                raise DataError(f"{self._path}, line {self._line}: the line has more than {LONGEST_LINE} bytes")
            if not line.isspace():
                places.append(self._line)
                yield line

    def _parsed(self, element: Element, row: int, line: bytes) -> list[list[Any]]:
        """Each column's numbers in the line that was read last."""
        words = line.decode("latin-1").split()
        found: list[list[Any]] = []
        used = 0
        try:
            for column in element.properties:
                length = 1
                if column.count is not None and used < len(words):
                    length = _number(words[used], column.count)
                    used += 1
                if not 0 <= length <= len(words) - used:
                    raise ValueError(f"{len(words)} numbers are too few for its property {shown(column.name)}")
                found.append([_number(word, column.dtype) for word in words[used : used + length]])
                used += length
            if used < len(words):
                raise ValueError(f"expected {used} numbers, found {len(words)}")
        except ValueError as error:
            raise DataError(f"{self._path}, line {self._line}: {shown(element.name)} {row}: {error}") from error
        return found

    def _go(self, place: tuple[int, int]) -> None:
        self._file.seek(place[0])
        self._line = place[1]


def _number(word: str, dtype: np.dtype[Any]) -> Any:
    try:
        if dtype.kind == "f":
            return float(word)
        number = int(word)
    except ValueError as error:
        raise ValueError(f"expected a number of type {dtype}, found {shown(word)}") from error
    if not np.iinfo(dtype).min <= number <= np.iinfo(dtype).max:
        raise ValueError(f"{shown(word)} is no {dtype}")
    return number
