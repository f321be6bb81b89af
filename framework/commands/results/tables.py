"""`instancemap tables DIR... [table.KEY=VALUE ...]`: write the tables of the runs in DIR. Works during a sweep."""

from __future__ import annotations

from framework.commands.command_line import print_for_directories
from framework.tables.experiment_tables import write_tables


def main() -> None:
    """Run the command `instancemap tables`."""
    print_for_directories(
        "Write table.md, table.tex and table.csv of the runs in DIR and its subfolders to DIR, and print table.md.",
        "folder of a sweep or of several runs",
        "table",
        write_tables,
    )
