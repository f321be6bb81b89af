"""`python -m framework.figures DIR...`: the pictures of experiments, also while a sweep still runs."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any, ClassVar

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from framework.command_line import one_line_errors
from framework.errors import InstanceMapError

log = logging.getLogger(__name__)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m framework.figures",
        description="Writes figure.png and figure.pdf into DIR, from the records of the experiment's runs below it.",
    )
    parser.add_argument("directory", metavar="DIR", nargs="+", type=Path, help="where an experiment's runs went")
    asked = parser.parse_args()
    with one_line_errors():
        from framework.reports.figures import write_figure  # here: every job imports this module for its callback

        for directory in asked.directory:
            for path in write_figure(directory):
                print(path)


class WriteFigures(Callback):
    """Draws the picture that the experiment asks for, if it does, when the sweep has ended."""

    failed: ClassVar[bool] = False  # whether there is one that could not be drawn: Hydra keeps callbacks' errors

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        if config.get("figure") is None:
            return
        from framework.reports.figures import write_figure

        try:
            for path in write_figure(Path(config.hydra.sweep.dir)):
                print(path)
        except InstanceMapError as error:  # Hydra would make a warning of many lines of it
            log.error("no picture: %s", error)
            WriteFigures.failed = True


if __name__ == "__main__":
    main()
