"""Rows of a comparison: means of runs with their spread, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.runs.provenance import leaves, relevant
from framework.runs.stored_runs import Record, is_number

CHOICE = "choice."  # prefix of the chosen options in metrics.json
DATA = "dataset.root"  # config key of the recording's folder
CONFIDENCE = 0.95
PRESET_STAGES = ("tracker", "refiner", "fuser")  # stages set by preset=NAME

Run = tuple[str, ...]  # values of the averaged keys: ("3",) is seed 3


@dataclass(frozen=True)
class Mean:
    """A mean over runs. NaN = undefined, such as the mean of no run or the deviation of a single run."""

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
        """Return the standard error of the mean."""
        return self.deviation / math.sqrt(self.count) if self.count > 1 else math.nan


@dataclass(frozen=True)
class RunRow:
    """Runs with equal config values, except for the averaged keys."""

    name: str
    records: Mapping[Run, Record]
    system: str = ""  # name in an experiment; "" = no experiment
    variant: tuple[str, ...] = ()  # other differences between rows: ("tracker=icp_only",)

    @property
    def pose_source(self) -> str:
        return self._distinct("pose_source")

    @property
    def poses(self) -> str:
        """Return the pose source as text, including the tracker of tracked poses."""
        tracked = {"tracked": f"tracked ({self._distinct(f'{CHOICE}tracker')})"}
        return tracked.get(self.pose_source, self.pose_source.replace("_", " "))

    @property
    def annotation(self) -> str:
        """Return the release of the ground truth; "" = unknown."""
        return "/".join(sorted({record.annotation for record in self.records.values()}))

    def _distinct(self, key: str) -> str:
        return "/".join(sorted({str(record.metrics.get(key)) for record in self.records.values()}))

    def values(self, column: str) -> dict[Run, float]:
        """Return the metric of each run, without undefined values."""
        found = {run: record.metrics.get(column) for run, record in self.records.items()}
        return {run: float(value) for run, value in found.items() if is_number(value)}

    def mean(self, column: str) -> Mean:
        return Mean.of(self.values(column).values())

    def differences(self, base: RunRow, column: str) -> dict[Run, float]:
        """Return the difference of the metric from the baseline, for the runs in both rows.

        Runs with the same seed have the same scene and detections, so most of the variation cancels.
        """
        own, others = self.values(column), base.values(column)
        return {run: own[run] - others[run] for run in own if run in others}


def rows_of(
    records: Sequence[Record], over: Sequence[str], overrides: Mapping[str, Sequence[str]] | None = None
) -> list[RunRow]:
    """Group `records` into rows: first the rows in `overrides`, then other rows by name.

    Records of an experiment are grouped by their config key `row`. Other records are grouped by their differing options
    and parameters, except for the averaged keys `over` and keys that always have the same value as one of them, such as
    dataset.seed and seed. `overrides` contains the overrides of each row by name.

    A row of an experiment is split by differences within it, by data folder and by annotation. It is also split by
    differences between rows that no override causes, such as the pose source or the number of frames. The later of two
    records of the same run is used.
    """
    overrides = overrides or {}
    variants = [_Variant.of(record, over) for record in sorted(records, key=lambda record: record.written)]
    own = _following(variants, over)
    changed = {key for changes in overrides.values() for override in changes for key in _changed(override)}
    stages = _differing(
        [(one.row, one.choices) for one in variants]
        + [("", {key: value for key, value in one.choices.items() if key not in changed}) for one in variants]
    )
    parameters = _differing(
        [((one.row, *map(one.choices.get, stages)), one.parameters) for one in variants]
        + [("", {DATA: one.parameters[DATA]}) for one in variants if DATA in one.parameters]
        + [kept for one in variants if not one.row or one.row in overrides for kept in _kept(one, changed)]
    )
    rows: dict[tuple[str, tuple[str, ...]], dict[Run, Record]] = {}
    for one in variants:
        variant = [f"{key}={one.choices[key]}" for key in stages if key in one.choices]
        variant += [f"{key}={one.parameters[key]}" for key in parameters if key in one.parameters and key not in own]
        rows.setdefault((one.row, tuple(variant)), {})[one.run] = one.record
    place = {name: k for k, name in enumerate(overrides)}
    # the parts of a split row take its position
    order = sorted(rows, key=lambda key: (place.get(key[0], len(place)), key))
    return [_row(system, variant, rows[system, variant]) for system, variant in order]


def _row(system: str, variant: tuple[str, ...], records: Mapping[Run, Record]) -> RunRow:
    name = ", ".join([system, *variant] if system else variant) or "all runs"
    return RunRow(name, dict(sorted(records.items(), key=lambda item: natural(item[0]))), system, variant)


def _changed(override: str) -> tuple[str, ...]:
    """Return the keys changed by an override: refiner.links.x for refiner@refiner.links.x=y."""
    group, _, package = override.lstrip("+~").partition("=")[0].partition("@")
    return PRESET_STAGES if group == "preset" else (package or group.replace("/", "."),)


def _kept(one: _Variant, changed: Collection[str]) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    """Yield the parameters that no row changes, with their stage and its option."""
    for key, value in one.parameters.items():
        if not _is_below(key, changed):
            stage = key.partition(".")[0]
            yield (stage, one.choices.get(stage)), {key: value}


def _is_below(key: str, others: Collection[str]) -> bool:
    """Return True if a dotted key is in `others` or below one of them."""
    parts = key.split(".")
    return any(".".join(parts[:k]) in others for k in range(1, len(parts) + 1))


@dataclass(frozen=True)
class _Variant:
    """The row and run of a record."""

    record: Record
    row: str
    run: Run
    choices: Mapping[str, Any]  # by stage, and the annotation
    parameters: Mapping[str, Any]  # by dotted key

    @classmethod
    def of(cls, record: Record, over: Sequence[str]) -> _Variant:
        parameters = dict(leaves(relevant(record.config)))
        choices = {k.removeprefix(CHOICE): v for k, v in record.metrics.items() if k.startswith(CHOICE)}
        choices["annotation"] = record.annotation or "unknown"
        run = tuple(str(parameters.get(key)) for key in over)
        row = record.config.get("row")
        return cls(record, "" if row is None else str(row), run, choices, parameters)


def following(records: Sequence[Record], over: Sequence[str]) -> list[str]:
    """Return the keys whose value equals that of a key in `over` in every record, even by chance.

    Keys with the same last part as a key in `over`, such as dataset.seed for seed, are omitted.
    """
    variants = [_Variant.of(record, over) for record in records]
    names = {key.rpartition(".")[2] for key in over}
    differing = set(_differing([("", one.parameters) for one in variants]))
    return sorted(key for key in differing & _following(variants, over) if key.rpartition(".")[2] not in names)


def _following(variants: Sequence[_Variant], over: Sequence[str]) -> set[str]:
    """Return the keys `over`, and the keys whose value equals that of one of them in every record."""
    found = set(over)
    for key in {key for one in variants for key in one.parameters}:
        for k in range(len(over)):
            if all(str(one.parameters[key]) == one.run[k] for one in variants if key in one.parameters):
                found.add(key)
    return found


def _differing(groups: Sequence[tuple[Any, Mapping[str, Any]]]) -> list[str]:
    """Return the keys that have several values within a group, in order; `groups` are (group, values) pairs."""
    seen: dict[Any, dict[str, set[str]]] = {}
    for group, values in groups:
        for key, value in values.items():
            seen.setdefault(group, {}).setdefault(key, set()).add(repr(value))
    differing = {key for keys in seen.values() for key, values in keys.items() if len(values) > 1}
    return [key for key in dict.fromkeys(key for _, values in groups for key in values) if key in differing]


def natural(run: Run) -> tuple[tuple[float, str], ...]:
    """Return a sort key that orders seeds as numbers, and other words after them."""
    return tuple((float(word) if word.isdecimal() else math.inf, word) for word in run)
