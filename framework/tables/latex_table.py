"""LaTeX tables for a paper: environments `table` and `table*` with a caption and a label."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from framework.runtime.plain_output import plain_line
from framework.tables.grid import TextTable
from framework.tables.metric_columns import Direction

PACKAGES = ("booktabs", "graphicx")
MAX_IN_ONE_COLUMN = 5  # maximum number of columns of a table with the width of one page column
ENVIRONMENTS = {1: "table", 2: "table*"}  # by number of page columns

# \resizebox of the natural width, unless the table is wider than the page column
_BOX = "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%"
_ARROWS = {Direction.HIGHER: " $\\uparrow$", Direction.LOWER: " $\\downarrow$", Direction.NONE: ""}


@dataclass(frozen=True)
class LatexTable:
    """A table of a paper."""

    grid: TextTable
    caption: str  # LaTeX
    label: str  # for \ref, such as tab:ablation_refiner
    page_columns: int | None = None  # width in columns of the page, 1 or 2; None = 1 up to MAX_IN_ONE_COLUMN columns

    def lines(self) -> list[str]:
        """Return the lines of the environment."""
        narrow = len(self.grid.heads) <= MAX_IN_ONE_COLUMN
        environment = ENVIRONMENTS[self.page_columns or (1 if narrow else 2)]
        return [
            f"\\begin{{{environment}}}",
            "\\centering",
            f"\\caption{{{' '.join(self.caption.split())}}}",
            f"\\label{{{self.label}}}",
            "\\small",
            _BOX,
            "\n".join(latex_grid(self.grid)) + "}",
            f"\\end{{{environment}}}",
            "",
        ]


def latex_file(tables: Sequence[LatexTable], notes: Iterable[str]) -> str:
    """Return the text of a .tex file: the packages to load and the notes as comments, then the tables."""
    packages = " ".join(f"\\usepackage{{{name}}}" for name in PACKAGES)
    comments = (f"% {plain_line(note)}" for note in notes)
    return "\n".join([f"% {packages}", *comments, *(line for table in tables for line in table.lines())])


def latex_label(title: str) -> str:
    """Return the label of a table with this title, such as tab:ablation_refiner."""
    return f"tab:{re.sub(r'[^A-Za-z0-9_.-]+', '-', title).strip('-')}"


def latex_grid(grid: TextTable) -> list[str]:
    """Return the lines of a LaTeX tabular for the package booktabs. Arrows show the direction of better values."""
    alignment = "l" * grid.label_columns + "r" * (len(grid.heads) - grid.label_columns)
    heads = (
        escaped(head) + _ARROWS[grid.directions.get(column, Direction.NONE)] for column, head in enumerate(grid.heads)
    )
    lines = [f"\\begin{{tabular}}{{{alignment}}}", "\\toprule", _latex_line(heads), "\\midrule"]
    for k, cells in enumerate(grid.body):
        if k in grid.groups:
            lines.append("\\midrule")
        texts = (escaped(cell) if column < grid.label_columns else _number(cell) for column, cell in enumerate(cells))
        marked = (f"\\textbf{{{text}}}" if (k, column) in grid.bold else text for column, text in enumerate(texts))
        lines.append(_latex_line(marked))
    return [*lines, "\\bottomrule", "\\end{tabular}"]


_LATEX = str.maketrans(
    {
        **{mark: f"\\{mark}" for mark in "&%$#_{}"},
        **{"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}"},
        **{"|": "\\textbar{}", "<": "\\textless{}", ">": "\\textgreater{}"},
        **{"±": "$\\pm$", "×": "$\\times$", "→": "$\\rightarrow$", "≥": "$\\geq$", "≤": "$\\leq$", "µ": "$\\mu$"},
        **{"–": "--", "—": "---", "°": "$^\\circ$", "…": "\\ldots{}"},
    }
)


def escaped(text: str) -> str:
    """Return plain text as LaTeX."""
    return plain_line(text).translate(_LATEX)


def _number(cell: str) -> str:
    """Return a cell of numbers as LaTeX, with minus signs."""
    return re.sub(r"(?<![\w.-])-(?=\d)", "$-$", escaped(cell))


def _latex_line(cells: Iterable[str]) -> str:
    line = " & ".join(cells) + " \\\\"
    # Without {}, LaTeX would interpret the star or bracket as an argument of the row end or rule before it.
    return f"{{}}{line}" if line.startswith(("*", "[")) else line
