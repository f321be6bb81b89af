"""Contents of a table: the run directories below a folder as rows, their base row and the columns."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from framework.config.text_values import literal_in_block
from framework.errors import DataError
from framework.runs.metrics import is_evaluation
from framework.runs.run_rows import DATA, Mean, Run, RunRow, is_below, is_of_data, natural, rows_of
from framework.runs.stored_runs import Incomplete, Record, completed_runs
from framework.runs.sweep_file import asked_keys, command_line, read_sweep, requested_runs, sweep_rows
from framework.tables.published import (
    DATASET,
    NOTHING_PUBLISHED,
    SYNTHETIC,
    Key,
    Published,
    PublishedRow,
    read_published,
)
from framework.tables.statistics import PairedValues, TableStatistics
from framework.tables.table_choice import TableChoice

FIRST = "the first row with the same data"  # name of the base if groups of rows have different bases


@dataclass(frozen=True)
class ComparisonTable:
    """Contents of a table, independent of its format."""

    title: str
    choice: TableChoice
    rows: list[RunRow]  # each with at least one run
    overrides: Mapping[str, Sequence[str]]  # by row of the experiment, including rows without runs
    requested: list[Run]  # runs of the last sweep for every row, including runs that have not started
    incomplete: list[Incomplete]
    superseded: int  # number of older records of the same runs
    root: Path  # base of relative run names
    left_out: Sequence[str] = ()  # default columns that are omitted, because no run has a value
    command_line: Sequence[str] = ()  # overrides of the sweep on the command line
    asked: Collection[str] | None = None  # keys in the overrides of the sweep; None = unknown

    @classmethod
    def below(cls, directory: Path, overrides: Sequence[str] = ()) -> ComparisonTable:
        """Return the table of the runs in and below `directory`, as set by its sweep, or with default settings.

        `overrides` change the settings, such as table.base=chain. Raises DataError if no run is complete, or if the
        sweep's config cannot be read, and ConfigError for an invalid table.
        """
        records, incomplete = completed_runs(directory)
        sweep = read_sweep(directory, literal_in_block("table", get_type_hints(TableChoice), overrides))
        choice, asked = TableChoice.of_sweep(sweep.get("table")), asked_keys(sweep)
        choice.check_keys({key for record in records for key in record.settings} | (asked or set()))
        selected = [record for record in records if choice.selects(record)]
        if not selected:
            raise DataError(f"table.where: expected a completed run with {as_text(choice.conditions)}, got none")
        changes = sweep_rows(sweep)
        rows = rows_of(selected, choice.averaged, changes, asked)
        requested = [run for run in requested_runs(sweep, choice.averaged) if _is_selected(choice, run)]
        superseded = len(selected) - sum(len(row.records) for row in rows)
        left_out: list[str] = []
        if "columns" not in (sweep.get("table") or {}):
            left_out = [key for key in choice.columns if not any(row.values(key) for row in rows)]
        if 0 < len(left_out) < len(choice.columns):
            choice = replace(choice, columns=[key for key in choice.columns if key not in left_out])
        else:
            left_out = []
        return cls(
            directory.resolve().name,
            choice,
            rows,
            changes,
            requested,
            incomplete,
            superseded,
            directory,
            left_out,
            command_line(sweep),
            asked,
        )

    @property
    def judged(self) -> bool:
        """True if a metric of the table depends on ground-truth instances, whose annotation release must be stated."""
        annotated = self.choice.split_key or any(record.annotation for record in self.records)
        return bool(annotated) and any(map(is_evaluation, self.choice.columns))

    @property
    def base_name(self) -> str:
        """Name of the base in the config: a row, or KEY=VALUE."""
        return self.choice.base or next(iter(self.overrides), self.rows[0].name)

    @property
    def base_called(self) -> str:
        """Name of the base in the table."""
        if any(row.system for row in self.rows):
            return self.choice.names.get(self.base_name, self.base_name)
        bases = {base.name: base for _, base in self.compared}
        if len(bases) == 1:
            return next(iter(bases))
        without_data = {", ".join(part for part in base.variant if not is_of_data(part)) for base in bases.values()}
        return self.choice.base or (without_data.pop() if len(without_data) == 1 else "") or FIRST

    @property
    def noun(self) -> str:
        """Last component of the split key, such as `scene` for dataset.scene."""
        return (self.choice.split_key or "").rpartition(".")[2]

    def base_of(self, row: RunRow) -> RunRow | None:
        """Return the row to compare `row` with; None for the base itself, and for a row without a base.

        In an experiment, the base has the same variant. In another sweep, the base has the same data; with
        table.base=KEY=VALUE, it differs from `row` only in this key.
        """
        if row.system:
            named = [other for other in self.rows if other.name == self.base_name]
            bases = named or [r for r in self.rows if r.system == self.base_name and r.variant == row.variant]
        else:
            same_data = [other for other in self.rows if other is row or self._have_same_data(other, row)]
            bases = [other for other in same_data if self.choice.base is None or self._differs_only_in_base(other, row)]
        return bases[0] if bases and bases[0] is not row else None

    def _have_same_data(self, row: RunRow, other: RunRow) -> bool:
        """Return True if the pairs of two rows have the same data; with table.pair_by, the same datasets."""
        if not self.choice.pair_by:
            return row.shares_data(other)
        common = self.common_units(row, other)
        return bool(common) and all(self._datasets(row, unit) == self._datasets(other, unit) for unit in common)

    def _datasets(self, row: RunRow, unit: Run) -> set[tuple[Any, Any]]:
        """Return the datasets of the runs of a unit, with their folders."""
        records = (record for run, record in row.records.items() if self._unit(run) == unit)
        return {(record.choices.get("dataset"), record.parameters.get(DATA)) for record in records}

    def _differs_only_in_base(self, other: RunRow, row: RunRow) -> bool:
        """Return True if `other` has the values of table.base, and all other values of `row`."""
        wanted = self.base_name.split(", ")
        keys = [part.partition("=")[0] for part in wanted]
        rest = [[p for p in one.variant if not is_below(p.partition("=")[0], keys)] for one in (other, row)]
        return set(wanted) <= set(other.variant) and rest[0] == rest[1]

    @property
    def has_base(self) -> bool:
        wanted = set(self.base_name.split(", "))
        return any(self.base_name in (row.name, row.system) or wanted <= set(row.variant) for row in self.rows)

    @cached_property
    def compared(self) -> list[tuple[RunRow, RunRow]]:
        """Pairs of a row and its base, for every row with a base."""
        pairs = ((row, self.base_of(row)) for row in self.rows)
        return [(row, base) for row, base in pairs if base is not None]

    def pairs(self, row: RunRow, base: RunRow, column: str) -> dict[Run, PairedValues]:
        """Return the values of a metric in two rows by unit (values of `choice.units`), for the units in both rows.

        Each value is a mean over the runs of the unit. Without table.pair_by, only runs in both rows are used.
        """
        own, others = (_grouped(values, self._unit) for values in self._compared_values(row, base, column))
        return {unit: PairedValues(own[unit].value, others[unit].value) for unit in own if unit in others}

    def difference(self, row: RunRow, base: RunRow, column: str) -> Mean:
        """Return the mean over units of the differences between a row and its base."""
        return Mean.of(pair.difference for pair in self.pairs(row, base, column).values())

    def difference_by_sequence(self, row: RunRow, base: RunRow, column: str) -> dict[str, float]:
        """Return the difference of a metric between two rows in each sequence of both rows."""
        own, others = map(mean_by_sequence, self._compared_values(row, base, column))
        return {sequence: own[sequence].value - others[sequence].value for sequence in own if sequence in others}

    @cached_property
    def statistics(self) -> TableStatistics:
        """Statistics of each compared row and column: row minus base; with columns_by, base minus row."""
        pairs = {}
        for row, base in self.compared:
            first, second = (base, row) if self.choice.columns_by else (row, base)
            for column in self.choice.columns:
                pairs[row.name, column] = self.pairs(first, second, column)
        return TableStatistics.of(pairs, self.choice.units)

    def common_units(self, row: RunRow, base: RunRow) -> set[Run]:
        """Return the units in which both rows have runs."""
        if not self.choice.pair_by:
            return set(map(self._unit, row.records.keys() & base.records.keys()))
        return set(map(self._unit, row.records)) & set(map(self._unit, base.records))

    def _compared_values(self, row: RunRow, base: RunRow, column: str) -> tuple[dict[Run, float], dict[Run, float]]:
        """Return the values of a metric in two rows by run; without table.pair_by, only of runs in both rows.

        Runs with the same seed have the same scene and detections, so most of the variation cancels.
        """
        own, others = row.values(column), base.values(column)
        if self.choice.pair_by:
            return own, others
        common = [run for run in own if run in others]
        return {run: own[run] for run in common}, {run: others[run] for run in common}

    def _unit(self, run: Run) -> Run:
        return tuple(run[self.choice.averaged.index(key)] for key in self.choice.units)

    @property
    def records(self) -> list[Record]:
        return [record for row in self.rows for record in row.records.values()]

    @property
    def is_of_scenenn(self) -> bool:
        """True if all runs use the original SceneNN data, as the published results do, and no synthetic scenes."""
        datasets = {record.choices.get("dataset") for record in self.records}
        return datasets == {DATASET} and not any(record.annotation.startswith(SYNTHETIC) for record in self.records)

    @cached_property
    def published(self) -> Published:
        if self.choice.published is None or not self.is_of_scenenn:
            return NOTHING_PUBLISHED
        return read_published(self.choice.published)

    @property
    def published_rows(self) -> list[PublishedRow]:
        """Published rows with a number in the table."""
        return [row for row in self.published.rows if row.has_any(self._keys)]

    @property
    def published_unknown(self) -> list[PublishedRow]:
        """Published rows with numbers for this table that were not looked up."""
        return [row for row in self.published.rows if not row.has_any(self._keys) and row.lacks_any(self._keys)]

    @property
    def _keys(self) -> list[Key]:
        """Keys of the table's metrics in published.yaml."""
        if self.choice.columns_by:
            return [(sequence,) for sequence in self.sequences]
        if self.choice.group_by:
            return [(sequence, key) for sequence in self.sequences for key in self.choice.columns]
        return [(key,) for key in self.choice.columns]

    @cached_property
    def sequences(self) -> list[str]:
        """Values of the split key: first the values in the published table, then the values in the runs."""
        found = {run[-1] for run in self._runs} if self.choice.split_key else set()
        order = sorted(found, key=lambda value: natural((value,)))
        return list(dict.fromkeys([*self.published.sequences, *order]))

    def called(self, row: RunRow, without: str = "") -> str:
        """Return the name of a row in the table, without the part of its variant for the config key `without`."""
        named = self.choice.names.get(row.system, row.system)
        variant = [part for part in row.variant if not without or not part.startswith(f"{without}=")]
        return ", ".join([named, *variant] if named else variant) or row.name

    def missing(self) -> Iterator[tuple[RunRow, list[Run]]]:
        """Yield the rows with missing runs: requested runs, or runs for the seeds and sequences of other rows."""
        runs = self._runs
        if self.choice.split_key and not self._is_nested:
            seeds, sequences = (dict.fromkeys(run[:-1] for run in runs), dict.fromkeys(run[-1] for run in runs))
            runs = [(*seed, sequence) for seed in seeds for sequence in sequences]
        for row in self.rows:
            if missing := sorted(set(runs) - set(row.records), key=natural):
                yield row, missing

    def expected(self, sequence: str) -> int:
        """Return the number of runs of a sequence that a complete row has."""
        return len({run for row in self.rows for run in row.records if run[-1] == sequence})

    @property
    def _is_nested(self) -> bool:
        """True if values of a key belong to one value of another key, as dataset.scene and dataset."""
        return any(is_below(key, set(self.choice.averaged) - {key}) for key in self.choice.averaged)

    @property
    def _runs(self) -> list[Run]:
        """Runs of all rows, and requested runs."""
        return [*(run for row in self.rows for run in row.records), *self.requested]


def _is_selected(choice: TableChoice, run: Run) -> bool:
    return all(run[k] in choice.conditions.get(key, [run[k]]) for k, key in enumerate(choice.averaged))


def as_text(conditions: Mapping[str, Sequence[str]]) -> str:
    """Return the conditions of `where` as overrides: dataset=desk,synthetic detector=none."""
    return " ".join(f"{key}={','.join(values)}" for key, values in conditions.items())


@dataclass(frozen=True)
class SequenceMean:
    """The mean over sequences of the means over seeds."""

    value: float  # NaN = no sequence
    deviation: (
        float  # sample standard deviation over the seeds with all sequences; NaN = fewer than two; 0 = equal runs
    )
    count: int  # number of sequences
    runs: int  # number of runs of all sequences


def mean_by_sequence(values: Mapping[Run, float]) -> dict[str, Mean]:
    """Return the mean of each sequence over the other keys. The sequence is the last entry of a Run."""
    return _grouped(values, lambda run: run[-1])


def mean_over_sequences(values: Mapping[Run, float]) -> SequenceMean:
    """Return the mean over the sequences, with equal weights."""
    means = mean_by_sequence(values)
    seeds = _grouped(values, lambda run: run[:-1])
    complete = Mean.of(mean.value for mean in seeds.values() if mean.count == len(means))
    mean = Mean.of(mean.value for mean in means.values())
    return SequenceMean(mean.value, complete.deviation, len(means), len(values))


Group = TypeVar("Group", bound=Hashable)


def _grouped(values: Mapping[Run, float], group_of: Callable[[Run], Group]) -> dict[Group, Mean]:
    """Return the mean of the values of each group of runs."""
    grouped: dict[Group, list[float]] = {}
    for run, value in values.items():
        grouped.setdefault(group_of(run), []).append(value)
    return {group: Mean.of(found) for group, found in grouped.items()}
