"""Grouping of runs into the rows of a comparison table."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.registry import STAGES
from framework.runs.metrics import CLASS_NAMES, LABEL_SPACE, TRUTH
from framework.runs.stored_runs import CHOICE, EVALUATION, Record, is_number

DATA = "dataset.root"  # config key of the dataset folder
ANNOTATION = "annotation"  # name of the ground-truth release in the variant of a row
CONFIDENCE = 0.95  # level of confidence intervals
PRESET_STAGES = ("masking", "tracker", "refiner", "fuser", "backend")  # stages set by preset=NAME

OURS = "InstanceMap"  # name of runs without other settings, next to the rows of imported maps
ABSENT = "–"  # text for a key that a run does not have

Run = tuple[str, ...]  # values of the averaged keys, e.g. ("3",) for seed 3


@dataclass(frozen=True)
class Mean:
    """The mean and the standard deviation of a metric over runs.

    The mean of no run and the deviation of a single run are NaN.
    """

    value: float
    deviation: float  # sample standard deviation, with the divisor n - 1
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Mean:
        sample = np.array(list(values), np.float64)
        if not len(sample):
            return cls(math.nan, math.nan, 0)
        if np.ptp(sample) == 0:  # exact for equal values
            return cls(float(sample[0]), 0.0 if len(sample) > 1 else math.nan, len(sample))
        return cls(float(sample.mean()), float(sample.std(ddof=1)), len(sample))

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.deviation / math.sqrt(self.count) if self.count > 1 else math.nan


@dataclass(frozen=True)
class RunRow:
    """One row of a comparison table: runs that differ only in the averaged keys."""

    name: str
    records: Mapping[Run, Record]
    system: str = ""  # name of the row in an experiment, "" = no experiment
    variant: tuple[str, ...] = ()  # other settings that differ between rows, e.g. ("tracker=icp_only",)

    @property
    def pose_source(self) -> str:
        return self._distinct("pose_source")

    @property
    def poses(self) -> str:
        """Pose source as text, with the tracker of tracked poses."""
        tracked = {"tracked": f"tracked ({self._distinct(f'{CHOICE}tracker')})"}
        return tracked.get(self.pose_source, self.pose_source.replace("_", " "))

    @property
    def annotation(self) -> str:
        """Release of the ground truth, or "" if unknown."""
        return "/".join(sorted({record.annotation for record in self.records.values()}))

    def _distinct(self, key: str) -> str:
        return "/".join(sorted({str(record.metrics.get(key)) for record in self.records.values()}))

    @property
    def peers(self) -> tuple[str, ...]:
        """Key that comparable rows have in common.

        In an experiment, this is the variant. For other rows, it consists of the pose source and the data.
        """
        if self.system:
            return self.variant
        return (self.pose_source, *(part for part in self.variant if is_of_data(part)))

    def values(self, column: str) -> dict[Run, float]:
        """Return the value of a metric for each run, without undefined values."""
        found = {run: record.metrics.get(column) for run, record in self.records.items()}
        return {run: float(value) for run, value in found.items() if is_number(value)}

    def mean(self, column: str) -> Mean:
        return Mean.of(self.values(column).values())

    def shares_data(self, other: RunRow) -> bool:
        """Return True if both rows have common runs, and these have the same data."""
        runs = self.records.keys() & other.records.keys()
        return bool(runs) and all(data_of(self.records[run]) == data_of(other.records[run]) for run in runs)


def data_of(record: Record) -> tuple[Any, ...]:
    """Return a key for the dataset, sequence and ground truth of a run."""
    keys = ("sequence", "annotation_release", TRUTH, LABEL_SPACE, CLASS_NAMES)
    parameters = (record.parameters.get(key) for key in (DATA, "dataset.scene"))
    return (record.choices.get("dataset"), *parameters, *(record.metrics.get(key) for key in keys))


def is_of_data(part: str) -> bool:
    """Return True if a part of a variant, such as dataset=desk, is about the data."""
    return is_below(part.partition("=")[0], ("dataset", ANNOTATION, "seed", "evaluation"))


def value_of(record: Record, key: str) -> str:
    """Return an option or parameter of a run as text, or ABSENT if the run does not have it."""
    return str(record.settings[key]) if key in record.settings else ABSENT


def rows_of(
    records: Sequence[Record],
    over: Sequence[str],
    overrides: Mapping[str, Sequence[str]] | None = None,
    asked: Collection[str] | None = None,
) -> list[RunRow]:
    """Group runs into the rows of a table.

    Runs of an experiment are grouped by their row in the experiment. Other runs are grouped by the options and
    parameters that differ between them. Averaged keys and keys that depend on them do not separate rows.

    A row of an experiment is split if its runs have different settings, data folders or annotations. It is also split
    if it differs from other rows in a setting that no override changes, such as the number of frames. If a run was
    repeated, the latest record is used.

    Args:
        records: The runs.
        over: The averaged keys, i.e. names of options and parameters.
        overrides: The overrides of each row of an experiment, by name.
        asked: The keys that the overrides of the sweep set; None = unknown.

    Returns:
        The rows, each with at least one run. Rows in `overrides` are first; other rows are sorted by name.
    """
    overrides = overrides or {}
    variants = [_Variant.of(record, over) for record in sorted(records, key=lambda record: record.written)]
    changed = {key for changes in overrides.values() for override in changes for key in _changed(override)}
    own = _dependent(variants, over, None if asked is None else {*_all_changed(asked), *changed})
    stages = _differing(
        [(one.row, one.choices) for one in variants]
        + [("", {key: value for key, value in one.choices.items() if key not in changed}) for one in variants]
    )

    def dataset_of(one: _Variant) -> Any:  # rows of several datasets are named by the dataset, not by its folder
        return one.choices.get("dataset") if "dataset" in stages else ""

    parameters = _differing(
        [((one.row, *map(one.choices.get, stages)), one.parameters) for one in variants]
        + [(dataset_of(one), {DATA: one.parameters[DATA]}) for one in variants if DATA in one.parameters]
        + [kept for one in variants if not one.row or one.row in overrides for kept in _kept(one, changed)]
    )
    rows: dict[tuple[str, tuple[str, ...]], dict[Run, Record]] = {}
    for one in variants:
        variant = [f"{key}={one.choices[key]}" for key in stages if key in one.choices and key not in own]
        variant += [f"{key}={one.parameters[key]}" for key in parameters if key in one.parameters and key not in own]
        rows.setdefault((one.row, tuple(variant)), {})[one.run] = one.record
    place = {name: k for k, name in enumerate(overrides)}
    # the parts of a split row stay together
    order = sorted(rows, key=lambda key: (place.get(key[0], len(place)), key))
    unnamed = "all runs" if len(rows) == 1 else OURS
    return [_row(system, variant, rows[system, variant], unnamed) for system, variant in order]


def _row(system: str, variant: tuple[str, ...], records: Mapping[Run, Record], unnamed: str) -> RunRow:
    name = ", ".join([system, *variant] if system else variant) or unnamed
    return RunRow(name, dict(sorted(records.items(), key=lambda item: natural(item[0]))), system, variant)


def _changed(override: str) -> tuple[str, ...]:
    """Return the keys that an override changes, e.g. refiner.links.x for refiner@refiner.links.x=y."""
    group, _, package = override.lstrip("+~").partition("=")[0].partition("@")
    return PRESET_STAGES if group == "preset" else (package or group.replace("/", "."),)


def _all_changed(keys: Iterable[str]) -> Iterator[str]:
    for key in keys:
        yield from _changed(key)


def _kept(one: _Variant, changed: Collection[str]) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    """Yield each parameter that no override changes, with its stage and the option of this stage."""
    for key, value in one.parameters.items():
        if not is_below(key, changed):
            stage = key.partition(".")[0]
            yield (stage, one.choices.get(stage)), {key: value}


def is_below(key: str, others: Collection[str]) -> bool:
    """Return True if a dotted key is in `others` or below one of them."""
    parts = key.split(".")
    return any(".".join(parts[:k]) in others for k in range(1, len(parts) + 1))


@dataclass(frozen=True)
class _Variant:
    """A record with its row, its run and its settings."""

    record: Record
    row: str
    run: Run
    choices: Mapping[str, Any]  # option of each stage, the annotation, and the label space of the evaluation
    parameters: Mapping[str, Any]  # by dotted key

    @classmethod
    def of(cls, record: Record, over: Sequence[str]) -> _Variant:
        stages = ("dataset",) if record.is_imported else STAGES
        choices = {stage: option for stage, option in record.choices.items() if stage in stages}
        choices[ANNOTATION] = record.annotation or "unknown"
        choices |= {f"{EVALUATION}label_space": record.metrics.get(LABEL_SPACE) or "null"}
        choices |= {f"{EVALUATION}names": record.metrics.get(CLASS_NAMES) or "null"}
        return cls(record, record.row, tuple(value_of(record, key) for key in over), choices, record.parameters)

    @property
    def values(self) -> Mapping[str, Any]:
        """Chosen options, annotation and parameters by key."""
        return {**self.parameters, **self.choices}


def dependent_keys(records: Sequence[Record], over: Sequence[str], asked: Collection[str] | None = None) -> list[str]:
    """Return the keys that are averaged because they depend on an averaged key.

    The notes of a table list these keys. Obvious keys are omitted. These are keys with the same last part as an
    averaged key, such as dataset.seed for seed, and the parameters of averaged or returned options.

    Args:
        records: The runs.
        over: The averaged keys.
        asked: The keys that the overrides of the sweep set; None = unknown.
    """
    variants = [_Variant.of(record, over) for record in records]
    names = {key.rpartition(".")[2] for key in over}
    differing = set(_differing([("", one.values) for one in variants]))
    found = differing & _dependent(variants, over, None if asked is None else set(_all_changed(asked)))
    return sorted(
        key for key in found if key.rpartition(".")[2] not in names and not is_below(key, {*over, *found} - {key})
    )


def _dependent(variants: Sequence[_Variant], over: Sequence[str], asked: Collection[str] | None) -> set[str]:
    """Return the averaged keys `over` and the keys that depend on them.

    A parameter depends on an averaged key if both have the same value in every run.

    A key depends on an averaged option if it has one value for each option. It must be a parameter of the option, the
    annotation of a dataset, or a key that is not in `asked`.
    """
    found = set(over)
    keys = {key for one in variants for key in one.values}
    for key in {key for one in variants for key in one.parameters}:
        for k in range(len(over)):
            if all(str(one.parameters[key]) == one.run[k] for one in variants if key in one.parameters):
                found.add(key)
    options = [k for k, key in enumerate(over) if key in STAGES]
    if not options:
        return found
    for key in keys - found:
        of_option = is_below(key, over) or (key == ANNOTATION and "dataset" in over)
        if of_option or (asked is not None and not is_below(key, asked)):
            values: dict[Run, set[str]] = {}
            for one in variants:
                values.setdefault(tuple(one.run[k] for k in options), set()).add(repr(one.values.get(key)))
            if all(len(of_run) == 1 for of_run in values.values()):
                found.add(key)
    return found


def _differing(groups: Sequence[tuple[Any, Mapping[str, Any]]]) -> list[str]:
    """Return the keys with several values within a group. `groups` contains pairs of a group and its values."""
    seen: dict[Any, dict[str, set[str]]] = {}
    for group, values in groups:
        for key, value in values.items():
            seen.setdefault(group, {}).setdefault(key, set()).add(repr(value))
    differing = {key for keys in seen.values() for key, values in keys.items() if len(values) > 1}
    return [key for key in dict.fromkeys(key for _, values in groups for key in values) if key in differing]


def natural(run: Run) -> tuple[tuple[float, str], ...]:
    """Return a sort key that orders numbers by value, followed by other texts in alphabetical order."""
    return tuple((float(word) if word.isdecimal() else math.inf, word) for word in run)
