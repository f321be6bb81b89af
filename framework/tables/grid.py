"""Text tables in Markdown and LaTeX, and number formats."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class TextTable:
    """A table of text cells with column headings."""

    heads: list[str]  # column headings
    body: list[list[str]]
    label_columns: int = 1  # number of left-aligned columns; the remaining columns contain numbers
    bold: frozenset[tuple[int, int]] = frozenset()  # (line, column) of each bold cell
    groups: frozenset[int] = frozenset()  # index of the first line of each group


def decimals(values: Iterable[float]) -> int:
    """Return the number of decimals for about three significant digits of the largest value; NaN is ignored."""
    largest = max((abs(value) for value in values if not math.isnan(value)), default=0.0)
    return next((3 - k for k, limit in enumerate((2, 20, 200)) if largest < limit), 0)


def figure(value: float, spread: float, digits: int, signed: bool = False) -> str:
    """Return the text `value ± spread` with `digits` decimals; a NaN spread is omitted."""
    text = f"{round(value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"  # + 0.0 avoids -0.000
    return text if math.isnan(spread) else f"{text} ± {spread:.{digits}f}"


def markdown_grid(grid: TextTable) -> str:
    """Return the table as Markdown, with columns padded for terminals."""
    cells = [[" ".join(cell.replace("|", "\\|").split()) for cell in line] for line in (grid.heads, *grid.body)]
    for line, column in grid.bold:
        cells[line + 1][column] = f"**{cells[line + 1][column]}**"
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * w if k < grid.label_columns else "-" * (w - 1) + ":" for k, w in enumerate(widths)])
    adjust = [str.ljust if k < grid.label_columns else str.rjust for k in range(len(widths))]
    padded = ([pad(cell, w) for pad, cell, w in zip(adjust, line, widths, strict=True)] for line in cells)
    return "\n".join("| " + " | ".join(line) + " |" for line in padded)


def latex_grid(grid: TextTable) -> list[str]:
    """Return the lines of a LaTeX tabular for the package booktabs."""
    alignment = "l" * grid.label_columns + "r" * (len(grid.heads) - grid.label_columns)
    lines = [f"\\begin{{tabular}}{{{alignment}}}", "\\toprule", _latex_line(map(_escaped, grid.heads)), "\\midrule"]
    for k, cells in enumerate(grid.body):
        if k in grid.groups:
            lines.append("\\midrule")
        marked = (
            f"\\textbf{{{_escaped(cell)}}}" if (k, column) in grid.bold else _escaped(cell)
            for column, cell in enumerate(cells)
        )
        lines.append(_latex_line(marked))
    return [*lines, "\\bottomrule", "\\end{tabular}", ""]


_LATEX = str.maketrans(
    {
        **{mark: f"\\{mark}" for mark in "&%$#_{}"},
        **{"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}"},
        **{"±": "$\\pm$", "–": "--", "|": "\\textbar{}", "<": "\\textless{}", ">": "\\textgreater{}"},
    }
)


def _escaped(cell: str) -> str:
    return " ".join(cell.split()).translate(_LATEX)


def _latex_line(cells: Iterable[str]) -> str:
    line = " & ".join(cells) + " \\\\"
    # Without {}, LaTeX would interpret the star or bracket as an argument of the row end or rule before it.
    return f"{{}}{line}" if line.startswith(("*", "[")) else line
