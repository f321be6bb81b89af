"""`python -m framework tables DIR...`: the tables of the runs below a directory, also while a sweep still runs."""

from __future__ import annotations

from framework.commands.command_line import print_for_directories
from framework.tables.experiment_tables import write_tables


def main() -> None:
    print_for_directories(
        "Writes table.md, table.tex and table.csv into DIR, from the records of the runs below it.",
        "where a sweep or several runs went",
        write_tables,
    )
