"""Cells of text under heads, as Markdown and as LaTeX; and how a figure becomes the text of a cell."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class TextTable:
    """Cells of text under heads."""

    heads: list[str]
    body: list[list[str]]
    label_columns: int = 1  # how many columns, from the left, hold words; the others hold figures
    bold: frozenset[tuple[int, int]] = frozenset()  # (line, column)
    groups: frozenset[int] = frozenset()  # lines that begin another group than the line above


def decimals(values: Iterable[float]) -> int:
    """As many as the largest of the values that are known needs, for three digits or so."""
    largest = max((abs(value) for value in values if not math.isnan(value)), default=0.0)
    return next((3 - k for k, limit in enumerate((2, 20, 200)) if largest < limit), 0)


def figure(value: float, spread: float, digits: int, signed: bool = False) -> str:
    """Value ± spread, the spread only where it is known."""
    text = f"{round(value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"  # + 0.0: no -0.000
    return text if math.isnan(spread) else f"{text} ± {spread:.{digits}f}"


def markdown_grid(grid: TextTable) -> str:
    """Padded, so that it reads as a table in a terminal, too."""
    cells = [[" ".join(cell.replace("|", "\\|").split()) for cell in line] for line in (grid.heads, *grid.body)]
    for line, column in grid.bold:
        cells[line + 1][column] = f"**{cells[line + 1][column]}**"
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    first, *lines = ["| " + " | ".join(_padded(line, widths, grid.label_columns)) + " |" for line in cells]
    rules = ["-" * width if k < grid.label_columns else "-" * (width - 1) + ":" for k, width in enumerate(widths)]
    return "\n".join([first, "| " + " | ".join(rules) + " |", *lines])


def _padded(line: list[str], widths: list[int], label_columns: int) -> list[str]:
    pairs = enumerate(zip(line, widths, strict=True))
    return [cell.ljust(width) if k < label_columns else cell.rjust(width) for k, (cell, width) in pairs]


def latex_grid(grid: TextTable) -> list[str]:
    """The lines of a tabular for `\\usepackage{booktabs}`."""
    lines = [
        f"\\begin{{tabular}}{{{'l' * grid.label_columns}{'r' * (len(grid.heads) - grid.label_columns)}}}",
        "\\toprule",
    ]
    lines += [_latex_line(map(_escaped, grid.heads)), "\\midrule"]
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
    # else the line above would take the mark for its argument
    return f"{{}}{line}" if line.startswith(("*", "[")) else line
