"""Rows of runs side by side: means with their spread, and differences paired run by run."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeGuard

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.errors import ConfigError
from framework.reports.provenance import WITHOUT_EFFECT
from framework.reports.records import Record

CHOICE = "choice."  # starts the keys of metrics.json that say which option was chosen of a config group
CONFIDENCE = 0.95

Run = tuple[str, ...]  # what a run has under the keys that are averaged over: ("3",) is seed 3


@dataclass(frozen=True)
class TableChoice:
    """What a table shows: the block `table` of an experiment."""

    over: list[str] = field(default_factory=lambda: ["seed"])  # keys of the config; averaged over, paired by
    base: str | None = None  # name of the row that the others are compared with; None = the first
    columns: list[str] = field(default_factory=list)  # keys of metrics.json, at least one

    def __post_init__(self) -> None:
        for name in ("over", "columns"):
            if not getattr(self, name):
                raise ConfigError(f"table.{name} must name at least one key")

    @classmethod
    def of(cls, node: Any) -> TableChoice:
        """The choice that a config's `table` describes. Raises ConfigError for keys and types that it does not have."""
        if not isinstance(node, Mapping):
            raise ConfigError(f"table must have keys and values, found {node!r}")
        try:
            checked = OmegaConf.merge(OmegaConf.structured(cls), OmegaConf.create(dict(node)))
        except OmegaConfBaseException as error:
            first_line = str(error).partition("\n")[0]
            raise ConfigError(f"table: {first_line}") from error
        return cls(list(checked.over), checked.base, list(checked.columns))


@dataclass(frozen=True)
class Mean:
    """A mean over runs. NaN where nothing is known: the mean of no run, the deviation of one."""

    value: float
    deviation: float  # sample standard deviation, with n - 1
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Mean:
        sample = np.array(list(values), np.float64)
        value = float(sample.mean()) if len(sample) else math.nan
        deviation = float(sample.std(ddof=1)) if len(sample) > 1 else math.nan
        return cls(value, deviation, len(sample))

    @property
    def error(self) -> float:
        """The standard error of the mean."""
        return self.deviation / math.sqrt(self.count) if self.count > 1 else math.nan

    @property
    def is_not_zero(self) -> bool:
        """Whether 0 lies outside of the mean's interval of confidence, by Student's t."""
        if self.count < 2:
            return False
        from scipy.stats import t

        return abs(self.value) > self.error * float(t.ppf((1 + CONFIDENCE) / 2, self.count - 1))


@dataclass(frozen=True)
class Row:
    """Runs that differ in nothing but the keys that are averaged over."""

    name: str
    records: Mapping[Run, Record]

    @property
    def pose_source(self) -> str:
        return "/".join(sorted({str(record.metrics.get("pose_source")) for record in self.records.values()}))

    def values(self, column: str) -> dict[Run, float]:
        """The runs' figures, without those that are not defined."""
        found = {run: record.metrics.get(column) for run, record in self.records.items()}
        return {run: float(value) for run, value in found.items() if _is_number(value)}

    def mean(self, column: str) -> Mean:
        return Mean.of(self.values(column).values())

    def difference(self, base: Row, column: str) -> Mean:
        """The mean over the runs that both rows have of this row's figure less the base's.

        Runs of one seed have the same room and the same detections: most of what varies between seeds cancels.
        """
        own, others = self.values(column), base.values(column)
        return Mean.of(own[run] - others[run] for run in own if run in others)


def rows_of(records: Sequence[Record], over: Sequence[str], order: Sequence[str] = ()) -> list[Row]:
    """The rows that `records` make: those named in `order` first, the others by name.

    A row is what an experiment calls `row`, else what was chosen: the stages' options and the parameters in which the
    records differ, other than the keys `over` and what follows them, as dataset.seed follows seed.
    Of two records of the same run, the later one counts.
    """
    told = [_Told.of(record, over) for record in sorted(records, key=lambda record: record.written)]
    own = _following(told, over)
    stages = _differing([(one.row, one.choices) for one in told])
    of_stages = [((one.row, *map(one.choices.get, stages)), one.parameters) for one in told]
    parameters = [key for key in _differing(of_stages) if key not in own]
    rows: dict[str, dict[Run, Record]] = {}
    for one in told:
        shown = [f"{key}={one.choices[key]}" for key in stages if key in one.choices]
        shown += [f"{key}={one.parameters[key]}" for key in parameters if key in one.parameters]
        name = ", ".join([one.row, *shown] if one.row else shown)
        rows.setdefault(name or "all runs", {})[one.run] = one.record
    place = {name: k for k, name in enumerate(order)}
    # what a row of an experiment is split into stands where it does
    names = sorted(rows, key=lambda name: (place.get(name.partition(",")[0], len(place)), name))
    return [Row(name, dict(sorted(rows[name].items(), key=lambda item: _natural(item[0])))) for name in names]


@dataclass(frozen=True)
class _Told:
    """What a record says about the row and the run that it belongs to."""

    record: Record
    row: str
    run: Run
    choices: Mapping[str, Any]  # by stage
    parameters: Mapping[str, Any]  # by dotted key

    @classmethod
    def of(cls, record: Record, over: Sequence[str]) -> _Told:
        parameters = dict(_leaves({key: value for key, value in record.config.items() if key not in WITHOUT_EFFECT}))
        choices = {k.removeprefix(CHOICE): v for k, v in record.metrics.items() if k.startswith(CHOICE)}
        run = tuple(str(parameters.get(key)) for key in over)
        return cls(record, str(record.config.get("row") or ""), run, choices, parameters)


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _following(told: Sequence[_Told], over: Sequence[str]) -> set[str]:
    """The keys `over`, and those whose value is that of one of them in every record."""
    found = set(over)
    for key in {key for one in told for key in one.parameters}:
        for k in range(len(over)):
            if all(str(one.parameters[key]) == one.run[k] for one in told if key in one.parameters):
                found.add(key)
    return found


def _differing(told: Sequence[tuple[Any, Mapping[str, Any]]]) -> list[str]:
    """The keys that have several values in one group, in their order; `told` are groups with keys and values."""
    seen: dict[Any, dict[str, set[str]]] = {}
    for group, values in told:
        for key, value in values.items():
            seen.setdefault(group, {}).setdefault(key, set()).add(repr(value))
    differing = {key for keys in seen.values() for key, values in keys.items() if len(values) > 1}
    return [key for key in dict.fromkeys(key for _, values in told for key in values) if key in differing]


def _natural(run: Run) -> tuple[tuple[float, str], ...]:
    """Seeds in their order as numbers, other words after them."""
    return tuple((float(word) if word.isdecimal() else math.inf, word) for word in run)


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
