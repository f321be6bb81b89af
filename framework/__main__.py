"""`python -m framework`: one run, or with -m or an experiment a sweep of runs."""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from framework.command_line import CONF, Jobs
from framework.directory_lock import locked
from framework.experiment import with_row
from framework.reports.records import is_recorded
from framework.sweep import ending

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
        from framework.run import run  # here, so that a misspelt name is answered before the heavy libraries load

        run(config, directory, choices)


def main() -> None:
    """The console script `instancemap`."""
    jobs.run(job_or_sweep)


def job_or_sweep() -> None:
    with ending:
        job()


if __name__ == "__main__":
    main()
