"""`instancemap figures DIR...`: draw the figures of an experiment. Works during a sweep."""

from __future__ import annotations

from framework.commands.command_line import print_for_directories
from framework.figures.experiment_figure import write_figure


def main() -> None:
    """Run the command `instancemap figures`."""
    print_for_directories(
        "Write figure.png and figure.pdf of the experiment in DIR.",
        "output folder of an experiment",
        lambda directory: "\n".join(map(str, write_figure(directory))),
    )
