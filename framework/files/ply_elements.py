"""Elements of a PLY file, i.e. the tables that are declared in the header."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from framework.data import Array, Float64, Int64
from framework.errors import DataError

USUAL_HEADER = 2**16  # bytes; a header has tens of lines
LARGEST_HEADER = 2**24  # bytes; a header may contain 65,535 class names
LONGEST_LINE = 2**20  # bytes of a line in a text file; splitting a line takes tens of times as much memory
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
TYPES = {
    **dict(zip(("char", "uchar", "short", "ushort", "int", "uint", "float", "double"), "bBhHiIfd", strict=True)),
    **{str(np.dtype(code)): code for code in "bBhHiIfd"},  # int8, uint8, ...
}
MAX_DIGITS = 18  # maximum number of digits of a row count


@dataclass(frozen=True)
class Property:
    """A column of an element.

    A row contains one number or a list of numbers.
    """

    name: str
    dtype: np.dtype[Any]  # type of the numbers, in native byte order
    count: np.dtype[Any] | None = None  # type of the list length; None = one number


@dataclass(frozen=True)
class Element:
    """A table with N rows.

    The arrays are empty until the rows are read.
    """

    name: str
    rows: int
    properties: tuple[Property, ...] = ()
    scalars: dict[str, Array] = field(default_factory=dict)  # (N,) each
    lists: dict[str, tuple[Array, Int64]] = field(default_factory=dict)  # values (sum of lengths,), lengths (N,)
    place: Callable[[int], str] = str  # position of a row in the file: "line 12" or "byte 340"


@dataclass(frozen=True)
class Header:
    """Content of a PLY header."""

    format: str  # one of FORMATS
    elements: tuple[Element, ...]  # in file order
    comments: tuple[str, ...]  # without the keyword `comment`
    lines: int  # number of lines
    size: int  # bytes, including the line end_header


def read_elements(path: Path, data: bytes) -> tuple[Header, dict[str, Element]]:
    """Parse the header and the elements of a PLY file.

    Args:
        path: The file, for messages.
        data: The content of the file.

    Returns:
        The header, and the elements by name.

    Raises:
        DataError: The file is damaged or does not match its header.
    """
    header = _parse_header(path, data)
    body = _Body(path, data, header)
    elements = {element.name: body.read(element) for element in header.elements}
    body.check_end()
    return header, elements


def _parse_header(path: Path, data: bytes) -> Header:
    lines = _header_lines(path, data)
    format_name = ""
    elements: list[Element] = []
    comments: list[str] = []
    for number, line in enumerate(lines, start=1):
        words = line.decode("latin-1").split()
        try:
            match words:
                case ["ply"] if number == 1:
                    pass
                case [] | ["obj_info", *_] | ["end_header"]:
                    pass
                case ["comment", *_]:
                    comments.append(line.decode("latin-1").strip().removeprefix("comment").lstrip())
                case ["format", name, "1.0"] if name in FORMATS and not format_name:
                    format_name = name
                case ["element", name, rows]:
                    if not (rows.isascii() and rows.isdigit() and len(rows) <= MAX_DIGITS):
                        expected = f"expected a row count of at most {MAX_DIGITS} digits"
                        raise ValueError(f"element {shown(name)}: {expected}, got {shown(rows)}")
                    if name in (element.name for element in elements):
                        raise ValueError(f"expected unique elements, got {shown(name)} twice")
                    elements.append(Element(name, int(rows)))
                case ["property", *declaration] if elements:
                    elements[-1] = _with_property(elements[-1], declaration)
                case _:
                    raise ValueError(f"expected a header line of PLY 1.0, got {shown(' '.join(words))}")
        except ValueError as error:
            raise DataError(f"{path}, line {number}: {error}") from error
    if not format_name:
        expected = f"expected a header line 'format' with 1.0 and the encoding {' or '.join(FORMATS)}"
        raise DataError(f"{path}, line {len(lines)}: {expected}, got none")
    header = Header(format_name, tuple(elements), tuple(comments), len(lines), sum(map(len, lines)))
    _check_size(path, header, len(data) - header.size)
    return header


def _header_lines(path: Path, data: bytes) -> list[bytes]:
    """Return the lines of the header, up to `end_header`."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise DataError(f"{path}, line 1: expected a PLY file, got {shown(data[:16].decode('latin-1'))}")
    for size in (USUAL_HEADER, LARGEST_HEADER):  # splitting binary data into lines is slow
        lines = data[:size].splitlines(keepends=True)
        for k, line in enumerate(lines):
            if line.strip() == b"end_header" and (line[-1:].isspace() or len(data) <= size):
                return lines[: k + 1]
    searched = min(len(data), LARGEST_HEADER)
    expected = f"expected a line 'end_header' in the first {searched} bytes"
    raise DataError(f"{path}, line {len(lines)}: {expected}, got none")


def _with_property(element: Element, declaration: list[str]) -> Element:
    match declaration:
        case ["list", count, kind, name]:
            column = Property(name, _dtype(kind), _dtype(count))
        case [kind, name]:
            column = Property(name, _dtype(kind))
        case _:
            raise ValueError(
                f"expected 'property TYPE NAME' or 'property list TYPE TYPE NAME', "
                f"got {shown(' '.join(['property', *declaration]))}"
            )
    if column.count is not None and column.count.kind == "f":
        raise ValueError(f"list {shown(name)}: expected an integer type for its length, got {count}")
    if name in (other.name for other in element.properties):
        raise ValueError(f"element {shown(element.name)}: expected unique properties, got {shown(name)} twice")
    return replace(element, properties=(*element.properties, column))


def _dtype(name: str) -> np.dtype[Any]:
    if name not in TYPES:
        raise ValueError(f"expected a type in {', '.join(TYPES)}, got {shown(name)}")
    return np.dtype(TYPES[name])


def _check_size(path: Path, header: Header, body: int) -> None:
    """Raise DataError if the file is too short for the declared rows.

    This limits the allocated memory.
    """
    least = 0
    for element in header.elements:
        if element.rows and not element.properties:
            where = f"{path}, line {header.lines}: element {shown(element.name)}"
            raise DataError(f"{where}: expected properties, got none for {element.rows} rows")
        if header.format == "ascii":
            row = 2 * len(element.properties)  # each has at least a digit and a separator
        else:
            row = sum((column.count or column.dtype).itemsize for column in element.properties)
        least += element.rows * row
    if least > body + (header.format == "ascii"):  # the last line needs no line break
        announced = ", ".join(f"{element.rows} {shown(element.name)}" for element in header.elements[:4])
        raise DataError(
            f"{path}, byte {header.size}: expected at least {least} bytes for {announced}, got {body}; "
            "the file is truncated or its header is wrong"
        )


class _Body:
    """The part of a PLY file after the header.

    Positions and sizes are in bytes for binary files, and in numbers for text files. Numbers of text files are stored
    as float64, which represents all PLY types exactly.
    """

    def __init__(self, path: Path, data: bytes, header: Header) -> None:
        self._path = path
        self._text = header.format == "ascii"
        self._order: Literal["little", "big", "="] = "=" if self._text else "little"
        if header.format == "binary_big_endian":
            self._order = "big"
        self._position = 0
        self._offset = header.size  # number of bytes before position 0
        self._data: memoryview | Float64 = memoryview(data)[header.size :]
        self._end = len(self._data)
        if self._text:
            self._split_lines(data[header.size :].splitlines(), header.lines)

    def read(self, element: Element) -> Element:
        """Read the rows of an element from the current position."""
        sizes = [0] * len(element.properties)
        if element.rows:
            sizes = self._row(element, 0, self._position)
        if self._rows_are_alike(element, sizes):
            return self._uniform(element, sizes)
        return self._ragged(element)

    def check_end(self) -> None:
        """Raise DataError if data follow the last declared row."""
        if self._position < self._end and (self._text or bytes(self._data[self._position :]).strip()):
            count = self._end - self._position
            raise DataError(
                f"{self._path}, {self._place(self._position)}: expected the end of the file after the last row, "
                f"got {count} more {'numbers' if self._text else 'bytes'}"
            )

    def _split_lines(self, lines: list[bytes], before: int) -> None:
        words = array("d")
        starts, numbers = array("q"), array("q")
        for number, line in enumerate(lines, start=before + 1):
            if len(line) > LONGEST_LINE:
                expected = f"expected at most {LONGEST_LINE} bytes in a line"
                raise DataError(f"{self._path}, line {number}: {expected}, got {len(line)}")
            found = line.split()
            if found:
                starts.append(len(words))
                numbers.append(number)
                try:
                    words.extend(map(float, found))
                except ValueError as error:
                    text = shown(line.decode("latin-1").strip())
                    raise DataError(f"{self._path}, line {number}: expected numbers, got {text}") from error
        self._data, self._end = np.array(words), len(words)
        self._line_starts = np.array([*starts, len(words)], np.int64)  # position of each line with numbers
        self._line_numbers = np.array([*numbers, before + len(lines)], np.int64)

    def _place(self, position: int) -> str:
        if not self._text:
            return f"byte {self._offset + position}"
        return f"line {self._line_numbers[np.searchsorted(self._line_starts, position, side='right') - 1]}"

    def _size(self, dtype: np.dtype[Any]) -> int:
        return 1 if self._text else dtype.itemsize

    def _row(self, element: Element, row: int, start: int) -> list[int]:
        """Return the number of values of each column in a row that begins at the position `start`."""
        position, lengths = start, []
        where = f"{shown(element.name)} {row}"
        for column in element.properties:
            length = 1
            if column.count is not None:
                count = self._view(column.count, position, 1, 1, 0)
                length = int(count[0, 0]) if count.size and np.isfinite(count[0, 0]) else 0
                if length < 0:
                    raise DataError(
                        f"{self._path}, {self._place(position)}: {where}: expected a list length >= 0, got {length}"
                    )
                position += self._size(column.count)
            lengths.append(length)
            position += length * self._size(column.dtype)
        line_end = self._end
        if self._text and start < self._end:
            line_end = int(self._line_starts[np.searchsorted(self._line_starts, start, side="right")])
        if start < self._end and self._text and position != line_end:
            expected, found = position - start, line_end - start
            raise DataError(f"{self._path}, {self._place(start)}: {where}: expected {expected} numbers, got {found}")
        if position > self._end:
            raise DataError(
                f"{self._path}, {self._place(self._end)}: expected {element.rows} rows as in the header, "
                f"got the end of the file in {where}"
            )
        return lengths

    def _view(self, dtype: np.dtype[Any], start: int, rows: int, length: int, stride: int) -> npt.NDArray[Any]:
        """Return a strided view (rows, length) of the numbers from the position `start`.

        The view is empty if a row exceeds the end of the file.
        """
        if start + (rows - 1) * stride + length * self._size(dtype) > self._end:
            return np.empty((0, 0))
        stored = np.dtype(np.float64) if self._text else dtype.newbyteorder(self._order)
        unit = 8 if self._text else 1
        return np.ndarray((rows, length), stored, self._data, start * unit, (stride * unit, stored.itemsize))

    def _rows_are_alike(self, element: Element, lengths: list[int]) -> bool:
        """Return True if the lists of all rows have the same lengths as those of the first row."""
        stride = self._stride(element, lengths)
        end = self._position + element.rows * stride
        if not element.rows or end > self._end:
            return not element.rows
        position = self._position
        for column, length in zip(element.properties, lengths, strict=True):
            if column.count is not None:
                if (self._view(column.count, position, element.rows, 1, stride) != length).any():
                    return False
                position += self._size(column.count)
            position += length * self._size(column.dtype)
        if self._text:
            begin = int(np.searchsorted(self._line_starts, self._position))
            starts = self._line_starts[begin : begin + element.rows + 1]
            return np.array_equal(starts, np.arange(self._position, end + 1, stride))
        return True

    def _stride(self, element: Element, lengths: list[int]) -> int:
        counts = sum(self._size(column.count) for column in element.properties if column.count is not None)
        return counts + sum(n * self._size(c.dtype) for c, n in zip(element.properties, lengths, strict=True))

    def _uniform(self, element: Element, lengths: list[int]) -> Element:
        """Read the rows of an element that all have the same size."""
        stride, start, position = self._stride(element, lengths), self._position, self._position
        scalars: dict[str, Array] = {}
        lists: dict[str, tuple[Array, Int64]] = {}
        for column, length in zip(element.properties, lengths, strict=True):
            position += 0 if column.count is None else self._size(column.count)
            view = np.empty((0, 1))
            if element.rows:
                view = self._view(column.dtype, position, element.rows, length, stride)
            positions = position + stride * np.arange(element.rows)[:, None] + np.arange(length) if self._text else None
            values = self._native(column, view, positions)
            if column.count is None:
                scalars[column.name] = values
            else:
                lists[column.name] = values, np.broadcast_to(np.int64(length), element.rows)
            position += length * self._size(column.dtype)
        self._position += element.rows * stride
        return replace(element, scalars=scalars, lists=lists, place=lambda row: self._place(start + row * stride))

    def _ragged(self, element: Element) -> Element:
        """Read the rows of an element that have different sizes, one after the other."""
        lengths = np.empty((len(element.properties), element.rows), np.int64)
        starts = np.empty(element.rows, np.int64)
        for row in range(element.rows):
            starts[row] = self._position
            found = self._row(element, row, self._position)
            lengths[:, row] = found
            self._position += self._stride(element, found)
        scalars: dict[str, Array] = {}
        lists: dict[str, tuple[Array, Int64]] = {}
        ends = starts.copy()
        for column, counts in zip(element.properties, lengths, strict=True):
            size = self._size(column.dtype)
            ends += (0 if column.count is None else self._size(column.count)) + counts * size
            before_end = np.repeat(np.cumsum(counts), counts) - np.arange(counts.sum())
            first = np.repeat(ends, counts) - before_end * size
            if isinstance(self._data, memoryview):
                taken = np.frombuffer(self._data, np.uint8)[first[:, None] + np.arange(size)].reshape(-1)
                stored = taken.view(column.dtype.newbyteorder(self._order))
            else:
                stored = self._data[first]
            values = self._native(column, stored, first)
            if column.count is None:
                scalars[column.name] = values
            else:
                lists[column.name] = values, counts
        return replace(element, scalars=scalars, lists=lists, place=lambda row: self._place(int(starts[row])))

    def _native(self, column: Property, stored: npt.NDArray[Any], positions: Int64 | None) -> Array:
        """Convert the stored numbers to the type of a column, and return them flattened."""
        if self._text and positions is not None and column.dtype.kind != "f":
            limits = np.iinfo(column.dtype)
            wrong = ~((stored == np.rint(stored)) & (stored >= limits.min) & (stored <= limits.max))
            if wrong.any():
                place, value = self._place(int(positions[wrong][0])), stored[wrong][0]
                raise DataError(f"{self._path}, {place}: {column.name}: expected a {column.dtype}, got {value:g}")
        with np.errstate(over="ignore"):  # overflow is detected by later checks for finite values
            values = np.ascontiguousarray(stored.reshape(-1), column.dtype)
        return values if column.count is not None or values.flags.owndata else values.copy()


def shown(text: str) -> str:
    """Quote and shorten a text from the file for messages."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
