"""`instancemap tables DIR...`: write the tables of the runs below a directory, also during a sweep."""

from __future__ import annotations

from framework.commands.command_line import print_for_directories
from framework.tables.experiment_tables import write_tables


def main() -> None:
    """Run the command `instancemap tables`."""
    print_for_directories(
        "Writes table.md, table.tex and table.csv of the runs below DIR.",
        "folder of a sweep or of several runs",
        write_tables,
    )
