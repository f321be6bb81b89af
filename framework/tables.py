"""`python -m framework.tables DIR...`: the tables of the runs below a directory, also while a sweep still runs."""

from __future__ import annotations

from framework.command_line import print_for_directories, quiet_when_cut_off
from framework.reports.tables import write_tables


def main() -> None:
    print_for_directories(
        "python -m framework.tables",
        "Writes table.md, table.tex and table.csv into DIR, from the records of the runs below it.",
        "where a sweep or several runs went",
        write_tables,
    )


if __name__ == "__main__":
    quiet_when_cut_off()
    main()
