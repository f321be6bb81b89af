"""`python -m framework.tables DIR...`: the tables of the runs below a directory, also while a sweep still runs."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from framework.command_line import one_line_errors
from framework.reports.tables import write_tables


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m framework.tables",
        description="Writes table.md, table.tex and table.csv into DIR, from the records of the runs below it.",
    )
    parser.add_argument("directory", metavar="DIR", nargs="+", type=Path, help="where a sweep or several runs went")
    asked = parser.parse_args()
    with one_line_errors():
        for directory in asked.directory:
            print(write_tables(directory))


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends it silently
    main()
