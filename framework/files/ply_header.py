"""The header of a PLY file: which elements follow, how many rows they have and of what types."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.errors import DataError

LARGEST_HEADER = 2**16  # bytes; a header has tens of lines, so what is longer is no PLY file
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
TYPES = {
    **dict(zip(("char", "uchar", "short", "ushort", "int", "uint", "float", "double"), "bBhHiIfd", strict=True)),
    **{str(np.dtype(code)): code for code in "bBhHiIfd"},  # int8, uint8, ...
}
MOST_DIGITS = 18  # of a count: what has more is no count of rows


@dataclass(frozen=True)
class Property:
    """A column of an element: one number a row, or a list of numbers a row."""

    name: str
    dtype: np.dtype[np.generic]  # of the number or of the list's entries, in the machine's byte order
    count: np.dtype[np.generic] | None = None  # of the list's length; None = one number


@dataclass(frozen=True)
class Element:
    """A table of the file."""

    name: str
    rows: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class Header:
    """What a file says of itself."""

    format: str  # one of FORMATS
    elements: tuple[Element, ...]  # in the file's order
    comments: tuple[str, ...]  # without the word `comment`
    lines: int
    size: int  # bytes, the line end_header included


def parse_header(path: Path, data: bytes) -> Header:
    """The header of the file `path` with this content. Raises DataError, naming the line, where it is none.

    Whatever it announces fits into the file's size, so that nothing larger than the file is allocated for it.
    """
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
                    elements.append(_element(name, rows, elements))
                case ["property", *declaration] if elements:
                    elements[-1] = _with_property(elements[-1], declaration)
                case _:
                    raise ValueError(f"the header does not know {shown(' '.join(words))}")
        except ValueError as error:
            raise DataError(f"{path}, line {number}: {error}") from error
    if not format_name:
        raise DataError(f"{path}, line {len(lines)}: the header has no line 'format', one of {', '.join(FORMATS)}, 1.0")
    header = Header(format_name, tuple(elements), tuple(comments), len(lines), sum(map(len, lines)))
    _check_size(path, header, len(data) - header.size)
    return header


def _header_lines(path: Path, data: bytes) -> list[bytes]:
    """The lines up to `end_header`, with their line ends."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise DataError(f"{path}, line 1: expected 'ply', found {shown(data[:16].decode('latin-1'))}: no PLY file")
    lines = data[:LARGEST_HEADER].splitlines(keepends=True)
    for k, line in enumerate(lines):
        if line.strip() == b"end_header":
            return lines[: k + 1]
    looked_at = f"the first {LARGEST_HEADER} bytes" if len(data) > LARGEST_HEADER else f"its {len(data)} bytes"
    raise DataError(f"{path}, line {len(lines)}: the header has no line 'end_header' in {looked_at}")


def _element(name: str, rows: str, before: list[Element]) -> Element:
    if not (rows.isascii() and rows.isdigit() and len(rows) <= MOST_DIGITS):
        raise ValueError(f"element {shown(name)} must have a whole number of rows, found {shown(rows)}")
    if name in (element.name for element in before):
        raise ValueError(f"element {shown(name)} is there twice")
    return Element(name, int(rows), ())


def _with_property(element: Element, declaration: list[str]) -> Element:
    match declaration:
        case ["list", count, kind, name]:
            column = Property(name, _dtype(kind), _dtype(count))
        case [kind, name]:
            column = Property(name, _dtype(kind))
        case _:
            raise ValueError(
                f"expected 'property TYPE NAME' or 'property list TYPE TYPE NAME', "
                f"found {shown(' '.join(['property', *declaration]))}"
            )
    if column.count is not None and column.count.kind == "f":
        raise ValueError(f"the length of the list {shown(name)} must be an integer, found the type {count}")
    if name in (other.name for other in element.properties):
        raise ValueError(f"element {shown(element.name)} has the property {shown(name)} twice")
    return Element(element.name, element.rows, (*element.properties, column))


def _dtype(name: str) -> np.dtype[np.generic]:
    if name not in TYPES:
        raise ValueError(f"unknown type {shown(name)}, expected one of {', '.join(TYPES)}")
    return np.dtype(TYPES[name])


def _check_size(path: Path, header: Header, body: int) -> None:
    """Raises DataError when the rows cannot fit into a body of so many bytes, however short their lists are."""
    least = 0
    for element in header.elements:
        if element.rows and not element.properties:
            raise DataError(f"{path}, line {header.lines}: element {shown(element.name)} has rows but no properties")
        if header.format == "ascii":
            row = 2 * len(element.properties)  # a digit and a space or line end each
        else:
            row = sum((column.count or column.dtype).itemsize for column in element.properties)
        least += element.rows * row
    if least > body + (header.format == "ascii"):  # the last line needs no end
        announced = ", ".join(f"{element.rows} {shown(element.name)}" for element in header.elements[:4])
        raise DataError(
            f"{path}, byte {header.size}: the header announces {announced}, at least {least} bytes, "
            f"but {body} follow: the file is truncated, or its header wrong"
        )


def shown(text: str) -> str:
    """A word of the file, quoted for an error's one line."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
