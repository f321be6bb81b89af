"""Swept keys and experiment rows on the command line, checked before the first run.

The sweeper of Hydra combines the values of independent keys, but a row of an experiment sets several keys together. An
experiment therefore sweeps over the key `row`. Each job adds the overrides of its row in `rows`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from math import prod

from hydra import compose
from hydra.conf import HydraConf
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict

from framework.config.composition import config_loader
from framework.config.validation import check_known, checked_rows
from framework.errors import ConfigError
from framework.runs.provenance import OF_SPEED, leaves, relevant
from framework.runs.stored_runs import GROUPS

GLOB_COUNT = 1_000_000  # assumed upper bound on the number of values of a glob(), which Hydra resolves later
COUNTED = (ValueType.SIMPLE_CHOICE_SWEEP, ValueType.CHOICE_SWEEP, ValueType.RANGE_SWEEP)

Choices = Mapping[str, str | None]

OmegaConf.register_new_resolver("all_of", lambda by_name: ",".join(map(str, by_name)), replace=True)
"""Resolver `${all_of:${rows}}`: the names of all rows, comma-separated, as a choice sweep for Hydra."""


def with_row(config: DictConfig, hydra_config: HydraConf) -> tuple[DictConfig, Choices]:
    """Return the config of a job with its row applied, and the chosen option of each config group.

    Raises:
        ConfigError: The row is unknown, or `table` or `figure` is invalid.
    """
    choices: Choices = dict(hydra_config.runtime.choices)
    rows = checked_rows(config.get("rows"))
    if not rows:
        return config, choices
    from framework.figures.figure_choice import FigureChoice
    from framework.tables.table_choice import TableChoice

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


def checked_sweep(overrides: Sequence[str], rows: Collection[str]) -> int:
    """Return an upper bound on the number of runs of a sweep.

    Raises:
        ConfigError: A key has no values, or a row does not exist.
    """
    runs: dict[str, int] = {}  # number of values by key; the last override of a key takes precedence
    for override in _parsed(overrides):
        values = _values(override)
        runs[override.get_key_element()] = len(values) or GLOB_COUNT
        if not values and override.value_type in COUNTED:
            raise ConfigError(f"{override.input_line}: expected at least one value, got none")
        if override.key_or_group == "row" and rows:
            check_row(values, rows)
    return prod(runs.values())


def check_outputs(config: DictConfig, overrides: Sequence[str], rows: Mapping[str, Sequence[str]]) -> None:
    """Check the `table` and the `figure` of a sweep.

    Some keys exist only with one of the swept options or rows. These configs are composed if a key is not found
    otherwise.

    Raises:
        ConfigError: The table or the figure is invalid, for example because a key is unknown.
    """
    from framework.figures.figure_choice import FigureChoice
    from framework.tables.table_choice import TableChoice

    keys: list[tuple[str, str]] = []
    if (table := config.get("table")) is not None:
        choice = TableChoice.of_sweep(OmegaConf.to_container(table) if OmegaConf.is_config(table) else table)
        choice.check_base(rows)
        keys += choice.keys
    if (figure := config.get("figure")) is not None:
        keys += FigureChoice.of(figure).keys
    known = {*_keys_of(config), *swept_keys(overrides), *GROUPS, *(["row"] if rows else [])}
    for alternative in _alternatives(overrides, rows):
        if all(key in known for _, key in keys):
            break
        with suppress(HydraException), config_loader() as loader:  # its job reports the error
            known |= _keys_of(loader.compose([*single_run(overrides), *alternative]))
    check_known(keys, known)


def _keys_of(config: DictConfig) -> set[str]:
    """Return the config keys that describe a run."""
    content = OmegaConf.to_container(config)
    assert isinstance(content, dict)
    plain = {str(key): value for key, value in content.items()}
    return {*dict(leaves(relevant(plain))), *OF_SPEED}


def _alternatives(overrides: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Iterator[list[str]]:
    """Yield the overrides of each row, and of each option of a swept group."""
    yield from map(list, rows.values())
    for override in _parsed(overrides):
        if override.is_sweep_override() and "." not in override.key_or_group:
            yield from ([f"{override.get_key_element()}={value}"] for value in _values(override))


def swept_keys(overrides: Sequence[str]) -> set[str]:
    """Return the swept keys and config groups. The last override of a key takes precedence."""
    last = {override.key_or_group: override for override in _parsed(overrides)}
    return {key for key, override in last.items() if override.is_sweep_override()}


def of_tables(overrides: Sequence[str]) -> list[str]:
    """Return the keys of overrides of the table and figure, such as table.where.dataset."""
    keys = [override.key_or_group for override in _parsed(overrides)]
    return [key for key in keys if key.startswith(("table.", "figure."))]


def check_row(chosen: Sequence[str], rows: Collection[str]) -> None:
    """Raise ConfigError if a row does not exist in the experiment."""
    for row in chosen:
        if row not in rows:
            close = get_close_matches(row, rows, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise ConfigError(f"row: expected one of {', '.join(rows)}, got {row}{hint}")


def error_of_first_run(words: Sequence[str]) -> HydraException | None:
    """Return the error in the config of the first run of a sweep, if any.

    If the config of the experiment cannot be composed, Hydra reports the swept values as errors instead. `words` is the
    command line.
    """
    overrides = [word for word in words if word.startswith("~") or ("=" in word and not word.startswith("-"))]
    try:
        with config_loader() as loader:
            loader.compose(single_run(overrides))
    except HydraException as error:
        return error
    return None


def single_run(overrides: Sequence[str]) -> list[str]:
    """Return the overrides of the first run of a sweep."""
    chosen = []
    for override in _parsed(overrides):
        values = _values(override)
        swept = override.value_type in COUNTED and values  # the first run has the first value of each key
        chosen.append(f"{override.get_key_element()}={values[0]}" if swept else str(override.input_line))
    return chosen


def _parsed(overrides: Sequence[str]) -> list[Override]:
    return list(OverridesParser.create().parse_overrides([*overrides]))


def _values(override: Override) -> list[str]:
    """Return the values of an override. The list is empty if only Hydra can determine them, as for a glob()."""
    try:
        return [*override.sweep_string_iterator()] if override.is_sweep_override() else [str(override.value())]
    except HydraException:
        return []
