"""One run from its config, or with -m or an experiment a sweep of runs: what there is without a command."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from framework.commands.command_line import Jobs
from framework.commands.experiment import with_row
from framework.commands.sweep import ending
from framework.files.directory_lock import locked
from framework.files.search_paths import CONF
from framework.records.stored_runs import is_recorded

if TYPE_CHECKING:  # what is imported where it is used loads heavy libraries
    from framework.journal import RunResult

log = logging.getLogger(__name__)
jobs = Jobs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
@jobs.reported
def job(config: DictConfig) -> None:
    """One run: builds the stages that the config names, maps the sequence, leaves the record in Hydra's directory."""
    hydra_config = HydraConfig.get()
    directory = Path(hydra_config.runtime.output_dir)
    config, choices = with_row(config, hydra_config)
    with locked(directory, wait=config.resume):  # where the sweep was killed and not its workers, they go on
        if config.resume and is_recorded(directory, config):
            return
        run(config, directory, choices)


def run(config: DictConfig, directory: Path, choices: Mapping[str, str | None]) -> RunResult:
    """Maps the config's sequence with its stages and leaves the run's record in `directory`.

    `choices` are the options that were chosen, by config group. A run that ended early (Ctrl-C, full map) leaves its
    record too, marked as partial, and then raises what ended it.
    """
    from framework.api import pipeline_of  # here: a misspelt name is answered before these load
    from framework.detection.cache import cache_metrics
    from framework.interfaces import RGBDSequence
    from framework.records.run_record import RunRecord
    from framework.registry import STAGES, build
    from framework.settings import Settings

    Settings.of(config).apply()
    sequence = build(RGBDSequence, config.dataset)
    pipeline = pipeline_of(config)
    record = RunRecord.begin(directory, config, choices)
    chosen = ", ".join(f"{stage} {choices.get(stage)}" for stage in STAGES if stage != "dataset")
    log.info("mapping %s: %d frames, %s", sequence.name, len(sequence), chosen)
    result = pipeline.run(sequence)
    record.write(sequence, result, cache_metrics(pipeline.detector))
    if result.stopped_by is not None:
        raise result.stopped_by
    return result


def main() -> None:
    jobs.run(job_or_sweep)


def job_or_sweep() -> None:
    with ending:
        job()
