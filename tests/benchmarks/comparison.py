"""Comparison tables in Markdown, aligned for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

NOTHING = "-"  # a cell without a number: not measured, or not defined


@dataclass
class Table:
    """Table with text cells and notes that state how the values were measured."""

    title: str
    columns: Sequence[str]
    rows: list[Sequence[str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Return the lines of the table in Markdown. Text is aligned left, numbers are aligned right."""
        table = [list(self.columns), *map(list, self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        numbers = [all(_is_number(row[k]) for row in self.rows) for k in range(len(self.columns))]

        def line(row: Sequence[str]) -> str:
            cells = [
                cell.rjust(width) if number else cell.ljust(width)
                for cell, width, number in zip(row, widths, numbers, strict=True)
            ]
            return "| " + " | ".join(cells) + " |"

        rule = ["-" * (width - 1) + (":" if number else "-") for width, number in zip(widths, numbers, strict=True)]
        return [f"### {self.title}", "", line(table[0]), line(rule), *map(line, table[1:]), "", *self.notes]


def _is_number(cell: str) -> bool:
    return cell == NOTHING or cell.lstrip(">= ")[:1].isdigit()


def ms(seconds: float) -> str:
    return f"{1e3 * seconds:.1f}"


def mib(count: float) -> str:
    return f"{count / 2**20:.0f}"


def times(theirs: float, ours: float) -> str:
    """Return the ratio of two times as text, i.e. the speedup of ours over theirs."""
    return f"{theirs / ours:.1f}" if ours else NOTHING
