"""What a command line sweeps over: looked at before the first run of it begins."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from difflib import get_close_matches
from math import prod

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException

from framework.config.composition import config_loader
from framework.errors import ConfigError

MANY = 1_000_000  # where glob() asks the disk
COUNTED = (ValueType.SIMPLE_CHOICE_SWEEP, ValueType.CHOICE_SWEEP, ValueType.RANGE_SWEEP)


def checked_sweep(overrides: Sequence[str], rows: Collection[str]) -> int:
    """How many runs a sweep has at most, as far as its command line tells.

    Raises ConfigError for a sweep without a single run, and for a row that is none of an experiment's `rows`.
    """
    runs: dict[str, int] = {}  # by key, of which the last one counts
    for override in OverridesParser.create().parse_overrides([*overrides]):
        values = _values(override)
        runs[override.get_key_element()] = len(values) or MANY
        if not values and override.value_type in COUNTED:
            raise ConfigError(f"{override.input_line} has no value: the sweep would be empty")
        if override.key_or_group == "row" and rows:
            check_row(values, rows)
    return prod(runs.values())


def swept_keys(overrides: Sequence[str]) -> set[str]:
    """The keys and groups that get several values, one after the other; the last override of a key counts."""
    last = {override.key_or_group: override for override in OverridesParser.create().parse_overrides([*overrides])}
    return {key for key, override in last.items() if override.is_sweep_override()}


def check_row(asked: Sequence[str], rows: Collection[str]) -> None:
    """Raises ConfigError for the first of the rows asked for that an experiment does not have."""
    for row in asked:
        if row not in rows:
            close = get_close_matches(row, rows, n=1)
            hint = f"; did you mean {close[0]}?" if close else "."
            raise ConfigError(f"there is no row={row}{hint} The experiment has {', '.join(rows)}")


def fault_of_first_run(words: Sequence[str]) -> HydraException | None:
    """What is wrong with the first run of a sweep that an experiment makes; None = nothing.

    Hydra asks a config whether it is a sweep's, and where that cannot be composed it takes it for a run's, and finds
    fault with its choices, whatever else is wrong. `words` are those of the command line.
    """
    overrides = [word for word in words if word.startswith("~") or ("=" in word and not word.startswith("-"))]
    try:
        with config_loader() as loader:
            loader.compose(single_run(overrides))
    except HydraException as error:
        return error
    return None


def single_run(overrides: Sequence[str]) -> list[str]:
    """The overrides of the first run of the sweep that they make."""
    chosen = []
    for override in OverridesParser.create().parse_overrides([*overrides]):
        values = _values(override)
        swept = override.value_type in COUNTED and values
        chosen.append(f"{override.get_key_element()}={values[0]}" if swept else str(override.input_line))
    return chosen


def _values(override: Override) -> list[str]:
    """What an override gives its key, one after the other, as far as that can be told from the command line."""
    try:
        return [*override.sweep_string_iterator()] if override.is_sweep_override() else [str(override.value())]
    except HydraException:
        return []
