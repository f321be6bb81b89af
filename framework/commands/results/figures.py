"""`python -m framework figures DIR...`: the pictures of experiments, also while a sweep still runs."""

from __future__ import annotations

from framework.commands.command_line import print_for_directories
from framework.figures.experiment_figure import write_figure


def main() -> None:
    print_for_directories(
        "Writes figure.png and figure.pdf into DIR, from the records of the experiment's runs below it.",
        "where an experiment's runs went",
        lambda directory: "\n".join(map(str, write_figure(directory))),
    )
