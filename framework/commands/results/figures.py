"""`instancemap figures DIR... [figure.KEY=VALUE ...]`: draw the figure of the runs in DIR. Works during a sweep."""

from __future__ import annotations

from framework.commands.command_line import print_for_directories
from framework.figures.experiment_figure import write_figure


def main() -> None:
    """Run the command `instancemap figures`."""
    print_for_directories(
        "Write figure.png and figure.pdf of the runs in DIR and its subfolders.",
        "folder of a sweep or of several runs",
        "figure",
        lambda directory, overrides: "\n".join(map(str, write_figure(directory, overrides))),
    )
