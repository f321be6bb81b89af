"""Every option of every config group, for tests that run on all of them."""

from __future__ import annotations

from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from framework.commands.plugins import registered
from framework.files.search_paths import CONF
from framework.registry import STAGES, build

OPTIONS = [(stage, option.name) for stage in STAGES for option in registered(stage)]


def names(stage: str) -> list[str]:
    """The options of one stage."""
    return [name for of, name in OPTIONS if of == stage]


def composed(stage: str, name: str, *overrides: str) -> DictConfig:
    """The main config with this option and no other stage."""
    others = [f"~{other}" for other in STAGES if other != stage]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=[f"{stage}={name}", *others, *overrides])


def built(stage: str, name: str, *overrides: str) -> Any:
    """The option as the command would build it."""
    return build(STAGES[stage], composed(stage, name, *overrides)[stage])
