"""`instancemap check dataset=D [out=FILE]`: validate an RGB-D sequence and suggest parameter fixes.

Exit status 1 means that the sequence is not usable.
"""

from __future__ import annotations

import logging
from pathlib import Path

import hydra
from omegaconf import DictConfig

from framework.commands.command_line import Jobs
from framework.config.validation import checked_file
from framework.errors import DataError
from framework.files.search_paths import CONF
from framework.interfaces import MapFuser, RGBDSequence

log = logging.getLogger(__name__)
jobs = Jobs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="check")
@jobs.reported
def job(config: DictConfig) -> None:
    """Check the dataset of the config, print the problems, and save a figure."""
    out = checked_file("out", config.out, ".png") if config.out is not None else Path("outputs", "check.png").absolute()

    from framework.checking.recording_check import check
    from framework.figures.check_figure import write_check
    from framework.registry import build
    from framework.runtime.process_settings import Settings

    Settings.of(config).apply()
    farthest = build(MapFuser, config.fuser).scene.depth_range[1]
    found = check(build(RGBDSequence, config.dataset), farthest)
    print(found.summary, *found.findings, sep="\n")
    out.parent.mkdir(exist_ok=True)
    write_check(out, found)
    log.info("%s", out)
    if found.errors:
        settings = " ".join(dict.fromkeys(finding.setting for finding in found.errors if finding.setting))
        count = f"{len(found.errors)} error{'s' * (len(found.errors) > 1)} (listed above)"
        raise DataError(f"dataset: expected a usable sequence, got {count}{f'; set {settings}' if settings else ''}")


def main() -> None:
    """Run the command `instancemap check`."""
    jobs.run(job)
