"""`python -m framework.figures DIR...`: the pictures of experiments, also while a sweep still runs."""

from __future__ import annotations

from framework.command_line import print_for_directories, quiet_when_cut_off
from framework.reports.figures import write_figure


def main() -> None:
    print_for_directories(
        "python -m framework.figures",
        "Writes figure.png and figure.pdf into DIR, from the records of the experiment's runs below it.",
        "where an experiment's runs went",
        lambda directory: "\n".join(map(str, write_figure(directory))),
    )


if __name__ == "__main__":
    quiet_when_cut_off()
    main()
