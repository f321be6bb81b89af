"""Experiments: sweeps over named rows, each of which is several overrides at once, that end with a table.

Hydra's own sweeper varies one key at a time and makes products of them. An experiment therefore sweeps over the key
`row`, and a job adds its row's overrides, which the experiment lists under `rows`, to its own.
"""

from __future__ import annotations

from collections.abc import Mapping

from hydra import compose
from hydra.conf import HydraConf
from omegaconf import DictConfig, OmegaConf, open_dict

from framework.commands.running.choices import check_row
from framework.config.validation import checked_rows
from framework.figures.figure_choice import FigureChoice
from framework.tables.comparison import TableChoice

Choices = Mapping[str, str | None]

OmegaConf.register_new_resolver("all_of", lambda by_name: ",".join(map(str, by_name)), replace=True)
"""`${all_of:${rows}}`: the names of all rows, as a choice for Hydra's sweeper."""


def with_row(config: DictConfig, hydra_config: HydraConf) -> tuple[DictConfig, Choices]:
    """A job's config and choices by group, with the overrides of the experiment's row that the job is for.

    Raises ConfigError for a row that the experiment does not have, and for a `table` or a `figure` that could not
    be made afterwards.
    """
    choices: Choices = dict(hydra_config.runtime.choices)
    rows = checked_rows(config.get("rows"))
    if not rows:
        return config, choices
    TableChoice.of(config.table)
    if config.get("figure") is not None:
        FigureChoice.of(config.figure)
    row = str(config.row)
    check_row([row], rows)
    overrides = [*hydra_config.overrides.task, *rows[row]]
    composed = compose(hydra_config.job.config_name, overrides, return_hydra_config=True)
    choices = dict(composed.hydra.runtime.choices)
    with open_dict(composed):
        del composed["hydra"]
    return composed, choices
