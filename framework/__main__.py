"""`python -m framework`: one run, or with -m a sweep of runs."""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from framework.command_line import CONF, EXIT_FAILED, Jobs, one_line_errors

jobs = Jobs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
@jobs.reported
def job(config: DictConfig) -> None:
    """One run: builds the stages that the config names, maps the sequence, leaves the record in Hydra's directory."""
    from framework.run import run  # here, so that a misspelt name is answered before the heavy libraries load

    hydra_config = HydraConfig.get()
    run(config, Path(hydra_config.runtime.output_dir), dict(hydra_config.runtime.choices))


def main() -> None:
    """The console script `instancemap`."""
    with one_line_errors():
        job()
    if jobs.failed:
        sys.exit(EXIT_FAILED)


if __name__ == "__main__":
    main()
