"""Options of all config groups, for tests of all plugins."""

from __future__ import annotations

import copy
import functools
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from framework.commands.installation.plugins import registered
from framework.files.search_paths import CONF
from framework.registry import GROUPS, build, find_class

OPTION = {(option.stage, option.name): option for option in registered(*GROUPS)}
OPTIONS = [*OPTION]


def names(stage: str, kind: type = object) -> list[str]:
    """Return the names of the options of a stage with a class derived from `kind`."""
    return [
        option.name
        for option in OPTION.values()
        if option.stage == stage and issubclass(find_class(GROUPS[stage], option.target), kind)
    ]


def composed(stage: str, name: str, *overrides: str) -> DictConfig:
    """Return the main config with this option and without other stages."""
    return copy.deepcopy(_composed(stage, name, *overrides))


@functools.cache
def _composed(stage: str, name: str, *overrides: str) -> DictConfig:
    others = [f"~{other}" for other in GROUPS if other != stage]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=[f"{stage}={name}", *others, *overrides])


def built(stage: str, name: str, *overrides: str) -> Any:
    """Build the plugin of an option."""
    return build(GROUPS[stage], composed(stage, name, *overrides)[stage])
