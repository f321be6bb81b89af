"""`instancemap` without a command: execute a run or, with -m or an experiment, a sweep of runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import nullcontext
from multiprocessing import parent_process
from pathlib import Path

import hydra
from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig

from framework.commands.command_line import Jobs, is_of_sweep
from framework.commands.running.choices import error_of_first_run, with_row
from framework.commands.running.sweep import by_joblib, ending
from framework.config.composition import resolved
from framework.files.folders.directory_lock import locked
from framework.files.search_paths import CONF
from framework.runs.objective import objective_keys, objective_of
from framework.runs.stored_runs import is_recorded
from framework.runtime.signals import Interruption, interruptible_imports
from framework.runtime.sweep_worker import job_of_worker

jobs = Jobs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
@jobs.reported
def job(config: DictConfig) -> float | list[float] | None:
    """Execute a run with the config and output directory of Hydra, and return its objective."""
    hydra_config = HydraConfig.get()
    in_worker = is_of_sweep(hydra_config) and by_joblib(hydra_config) and parent_process() is not None
    with job_of_worker() if in_worker else nullcontext():
        return run_job(config, hydra_config)


def run_job(config: DictConfig, hydra_config: HydraConf) -> float | list[float] | None:
    """Execute a single run, or one job of a sweep, and return its objective."""
    directory = Path(hydra_config.runtime.output_dir)
    config, choices = with_row(config, hydra_config)
    objective_keys(config.objective)
    # workers of a killed sweep may still be writing here; a single run has already locked its directory
    with locked(directory, wait=True) if is_of_sweep(hydra_config) else nullcontext():
        if config.skip_completed and is_recorded(directory, config):
            from framework.runs.reevaluation import evaluate_as_configured  # slow import

            evaluate_as_configured(directory, resolved(config))
        else:
            interruption = run(config, directory, choices)
            if is_of_sweep(hydra_config):  # a sweep would continue after this run
                interruption.check()
        return objective_of(directory, config.objective)


def run(config: DictConfig, directory: Path, choices: Mapping[str, str | None]) -> Interruption:
    """Build the pipeline of a config with the settings of the process, and call `write_run`."""
    from framework.api import begin  # local: after Hydra has checked the names
    from framework.runs.run_directory import write_run
    from framework.runtime.process_settings import Settings

    settings = Settings.of(config)
    with interruptible_imports():
        settings.apply()
        pipeline = begin(config)
        settings.apply()  # apply to torch, if a stage has loaded it
    return write_run(pipeline, config, directory, choices)


def main() -> None:
    """Run the pipeline or a sweep from the command line."""
    jobs.run(job_or_sweep)


def job_or_sweep() -> None:
    """Execute one run or, with -m, a sweep."""
    with ending:
        try:
            job()
        except ConfigCompositionException as error:
            first = error_of_first_run(sys.argv[1:]) or error
            raise first from first.__cause__
