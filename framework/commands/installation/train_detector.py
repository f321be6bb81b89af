"""`instancemap train-detector`: train Mask R-CNN on rendered synthetic scenes."""

from __future__ import annotations

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from framework.commands.command_line import one_line_errors
from framework.files.search_paths import CONF


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train_detector")
def job(config: DictConfig) -> None:
    """Train the detector with the settings of the config, in the output folder of Hydra."""
    from framework.training.train import train  # slow import: after Hydra has checked the keys

    train(config, Path(HydraConfig.get().runtime.output_dir))


def main() -> None:
    """Run the command `instancemap train-detector`."""
    with one_line_errors():
        job()
