"""Text tables in Markdown, and number formats."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from framework.runtime.plain_output import plain_line
from framework.tables.metric_columns import Direction


@dataclass(frozen=True)
class TextTable:
    """A table of text cells with column headings."""

    heads: list[str]  # column headings
    body: list[list[str]]
    label_columns: int = 1  # number of left-aligned columns; the remaining columns contain numbers
    bold: frozenset[tuple[int, int]] = frozenset()  # (line, column) of each bold cell
    groups: frozenset[int] = frozenset()  # index of the first line of each group
    directions: Mapping[int, Direction] = field(default_factory=dict)  # by column; none = no direction of better values


def decimals(values: Iterable[float]) -> int:
    """Return the number of decimals for about three significant digits of the largest value; NaN is ignored."""
    largest = max((abs(value) for value in values if not math.isnan(value)), default=0.0)
    return next((3 - k for k, limit in enumerate((2, 20, 200)) if largest < limit), 0)


def figure(value: float, spread: float, digits: int, signed: bool = False) -> str:
    """Return the text `value ± spread` with `digits` decimals; a NaN spread is omitted."""
    text = f"{round(value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"  # + 0.0 avoids -0.000
    return text if math.isnan(spread) else f"{text} ± {spread:.{digits}f}"


_HTML = re.compile(r"<(?=[A-Za-z/!?])|&(?=#?\w+;)")
_MARKDOWN = re.compile(r"[\\`|]|\](?=[(\[:])|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])|[*~](?=[\w*~])|(?<=[\w*~])[*~]")


def markdown_text(text: str) -> str:
    """Return plain text as one line of Markdown, without links, HTML and emphasis."""
    line = plain_line(text)
    return _HTML.sub(lambda match: html.escape(match[0]), _MARKDOWN.sub(r"\\\g<0>", line))


def markdown_grid(grid: TextTable) -> str:
    """Return the table as Markdown, with columns padded for terminals."""
    cells = [[markdown_text(cell) for cell in line] for line in (grid.heads, *grid.body)]
    for line, column in grid.bold:
        cells[line + 1][column] = f"**{cells[line + 1][column]}**"
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * w if k < grid.label_columns else "-" * (w - 1) + ":" for k, w in enumerate(widths)])
    adjust = [str.ljust if k < grid.label_columns else str.rjust for k in range(len(widths))]
    padded = ([pad(cell, w) for pad, cell, w in zip(adjust, line, widths, strict=True)] for line in cells)
    return "\n".join("| " + " | ".join(line) + " |" for line in padded)


def markdown_page(title: str, grids: Iterable[TextTable], notes: Iterable[str]) -> str:
    """Return a page of tables with a title and a list of notes as Markdown."""
    bullets = "\n".join(f"- {markdown_text(note)}" for note in notes)
    return "\n\n".join([f"# {markdown_text(title)}", *map(markdown_grid, grids), bullets]) + "\n"
