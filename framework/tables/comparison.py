"""Contents of a table: the run directories below a folder as rows, their baseline and the columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from framework.config.validation import checked_block
from framework.errors import ConfigError, DataError
from framework.runs.metrics import is_evaluation
from framework.runs.run_rows import CHOICE, Mean, Run, RunRow, natural, rows_of
from framework.runs.stored_runs import Incomplete, Record, find_records, read_yaml
from framework.runs.sweep_file import SWEEP, requested_runs, sweep_rows
from framework.runs.timings_file import current_key
from framework.tables.published import (
    DATASET,
    NOTHING_PUBLISHED,
    SYNTHETIC,
    Key,
    Published,
    PublishedRow,
    read_published,
)
from framework.tables.statistics import TableStatistics

PLAIN = (
    *("instances.ap50", "instances.ap50_agnostic", "instances.ap25", "instances.ap", "instances.mean_iou"),
    *("instances.count", "trajectory.ate_rmse_m", "frames_lost", "fps"),
    *(f"stage_ms.{stage}.median" for stage in ("refinement", "association", "update", "integration", "fusion")),
)
"""Default columns of a table without an experiment: keys of metrics.json. Columns without values are omitted."""


@dataclass(frozen=True)
class TableChoice:
    """The block `table` of an experiment.

    Each line is a row and each column a metric. Cells are means over the runs that differ only in `average_over`. With
    `columns_by`, each column is a value of that key, such as a sequence, and the last column is the mean. With
    `group_by`, each value of that key has a group of lines.
    """

    # config keys for averaging and pairing; runs with the same value of the last key are not independent
    average_over: list[str] = field(default_factory=lambda: ["seed"])
    columns_by: str | None = None  # config key with one column per value; None = one column per metric
    group_by: str | None = None  # config key with one group of lines per value; None = one line per row
    baseline: str | None = None  # row for comparisons; None = the first row
    # keys of metrics.json, at least one; with `columns_by`, exactly one
    columns: list[str] = field(default_factory=list)
    names: dict[str, str] = field(default_factory=dict)  # display names by row
    published: str | None = None  # section of published.yaml, if all runs use the original SceneNN data; None = none

    def __post_init__(self) -> None:
        for name in ("average_over", "columns"):
            if not getattr(self, name):
                raise ConfigError(f"table.{name}: expected at least one key, got none")
        if self.columns_by and self.group_by:
            raise ConfigError(
                f"table.columns_by, table.group_by: expected at most one key, got {self.columns_by} and {self.group_by}"
            )
        if self.split_key in self.average_over:
            raise ConfigError(f"table.average_over: expected keys other than table.{self.layout}, got {self.split_key}")
        if self.columns_by and len(self.columns) > 1:
            raise ConfigError(
                f"table.columns: expected one metric with table.columns_by, got {len(self.columns)}; set "
                f"table.group_by={self.columns_by} for several metrics"
            )
        if self.published and read_published(self.published).layout != self.layout:
            raise ConfigError(
                f"table.published: expected a section for the layout {self.layout}, got {self.published} for the "
                f"layout {read_published(self.published).layout}"
            )

    @property
    def layout(self) -> str:
        """`columns_by`, `group_by` or `rows`."""
        return "columns_by" if self.columns_by else "group_by" if self.group_by else "rows"

    @property
    def split_key(self) -> str | None:
        """Key of the columns or groups of lines."""
        return self.columns_by or self.group_by

    @classmethod
    def of(cls, node: Any) -> TableChoice:
        """Return the choice of a config's `table`. Raises ConfigError for unknown keys and wrong types."""
        choice = cls(**checked_block(cls, "table", node))
        # a stored sweep may have keys of an older version
        return replace(choice, columns=[current_key(key) for key in choice.columns])


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
    left_out: Sequence[str] = ()  # columns of PLAIN that are omitted, because no run has a value

    @classmethod
    def below(cls, directory: Path) -> ComparisonTable:
        """Return the table of the runs in and below `directory`, as set by its experiment, or with the columns PLAIN.

        Raises DataError if no run is complete, or if the experiment's config cannot be read.
        """
        if not directory.is_dir():
            raise DataError(f"{directory}: expected a folder of runs, got no folder")
        sweep = read_yaml(directory / SWEEP) if (directory / SWEEP).exists() else {}
        choice = TableChoice.of(sweep.get("table") or {"columns": list(PLAIN)})
        overrides = sweep_rows(sweep)
        records, incomplete = find_records(directory)
        if not records:
            why = "; ".join(f"{one.directory.name}: {one.reason}" for one in incomplete[:3])
            raise DataError(f"{directory}: expected a completed run, got none{f' ({why})' if why else ''}")
        keys = [*choice.average_over, choice.split_key] if choice.split_key else choice.average_over
        rows = rows_of(records, keys, overrides)
        requested = requested_runs(sweep, keys)
        superseded = len(records) - sum(len(row.records) for row in rows)
        left_out = () if sweep.get("table") else [c for c in choice.columns if not any(row.values(c) for row in rows)]
        if 0 < len(left_out) < len(choice.columns):
            choice = replace(choice, columns=[key for key in choice.columns if key not in left_out])
        else:
            left_out = ()
        return cls(
            directory.resolve().name, choice, rows, overrides, requested, incomplete, superseded, directory, left_out
        )

    @property
    def judged(self) -> bool:
        """True if a metric of the table depends on ground-truth instances, whose annotation release must be stated."""
        annotated = self.choice.split_key or any(record.annotation for record in self.records)
        return bool(annotated) and any(map(is_evaluation, self.choice.columns))

    @property
    def base_name(self) -> str:
        return self.choice.baseline or next(iter(self.overrides), self.rows[0].name)

    @property
    def base_called(self) -> str:
        return self.choice.names.get(self.base_name, self.base_name)

    @property
    def noun(self) -> str:
        """Last component of the split key, such as `scene` for dataset.scene."""
        return (self.choice.split_key or "").rpartition(".")[2]

    def base_of(self, row: RunRow) -> RunRow | None:
        """Return the baseline of `row`; None for the baseline itself, and for a variant without a baseline."""
        named = [other for other in self.rows if other.name == self.base_name]
        bases = named or [r for r in self.rows if r.system == self.base_name and r.variant == row.variant]
        return bases[0] if bases and bases[0] is not row else None

    @property
    def has_base(self) -> bool:
        return any(self.base_name in (row.name, row.system) for row in self.rows)

    @property
    def compared(self) -> list[tuple[RunRow, RunRow]]:
        """Pairs of a row and its baseline."""
        pairs = ((row, self.base_of(row)) for row in self.rows)
        return [(row, base) for row, base in pairs if base is not None]

    @cached_property
    def statistics(self) -> TableStatistics:
        """Statistics of each compared row and column: row minus baseline; with columns_by, baseline minus row."""
        pairs = {}
        for row, base in self.compared:
            first, second = (base, row) if self.choice.columns_by else (row, base)
            for key in self.choice.columns:
                values, others = first.values(key), second.values(key)
                pairs[row.name, key] = {run: (values[run], others[run]) for run in values if run in others}
        return TableStatistics.of(pairs, self.choice.split_key or self.choice.average_over[-1])

    @property
    def records(self) -> list[Record]:
        return [record for row in self.rows for record in row.records.values()]

    @property
    def is_of_scenenn(self) -> bool:
        """True if all runs use the original SceneNN data, as the published results do, and no synthetic scenes."""
        datasets = {record.metrics.get(f"{CHOICE}dataset") for record in self.records}
        return datasets == {DATASET} and not any(record.annotation.startswith(SYNTHETIC) for record in self.records)

    @cached_property
    def published(self) -> Published:
        if self.choice.published is None or not self.is_of_scenenn:
            return NOTHING_PUBLISHED
        return read_published(self.choice.published)

    @property
    def published_rows(self) -> list[PublishedRow]:
        """Published rows with a number in the table."""
        return [row for row in self.published.rows if row.knows(self._keys)]

    @property
    def published_unknown(self) -> list[PublishedRow]:
        """Published rows with numbers for this table that were not looked up."""
        return [row for row in self.published.rows if not row.knows(self._keys) and row.leaves_open(self._keys)]

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
        """Values of the split key: those of the published table, then those of the runs."""
        found = {run[-1] for run in self._runs} if self.choice.split_key else set()
        order = sorted(found, key=lambda value: natural((value,)))
        return list(dict.fromkeys([*self.published.sequences, *order]))

    def called(self, row: RunRow, without: str = "") -> str:
        """Return a row's name in the table; the value of the key `without` is omitted."""
        named = self.choice.names.get(row.system, row.system)
        variant = [part for part in row.variant if not without or not part.startswith(f"{without}=")]
        return ", ".join([named, *variant] if named else variant) or row.name

    def missing(self) -> Iterator[tuple[RunRow, list[Run]]]:
        """Yield the rows with missing runs: requested runs, or runs for the seeds and sequences of other rows."""
        runs = self._runs
        if self.choice.split_key:
            seeds, sequences = (dict.fromkeys(run[:-1] for run in runs), dict.fromkeys(run[-1] for run in runs))
            runs = [(*seed, sequence) for seed in seeds for sequence in sequences]
        for row in self.rows:
            if missing := sorted(set(runs) - set(row.records), key=natural):
                yield row, missing

    @property
    def _runs(self) -> list[Run]:
        """Runs of all rows, and requested runs."""
        return [*(run for row in self.rows for run in row.records), *self.requested]


@dataclass(frozen=True)
class SequenceMean:
    """The mean over sequences of the means over seeds."""

    value: float  # NaN = no sequence
    deviation: float  # sample standard deviation over the seeds with all sequences; NaN = fewer than two
    count: int  # number of sequences
    runs: int  # number of runs of all sequences


def mean_by_sequence(values: Mapping[Run, float]) -> dict[str, Mean]:
    """Return the mean of each sequence; the sequence is the last part of a run."""
    grouped: dict[str, list[float]] = {}
    for run, value in values.items():
        grouped.setdefault(run[-1], []).append(value)
    return {sequence: Mean.of(found) for sequence, found in grouped.items()}


def mean_over_sequences(values: Mapping[Run, float]) -> SequenceMean:
    """Return the mean over the sequences, with equal weights."""
    means = mean_by_sequence(values)
    seeds: dict[Run, list[float]] = {}
    for run, value in values.items():
        seeds.setdefault(run[:-1], []).append(value)
    complete = Mean.of(Mean.of(found).value for found in seeds.values() if len(found) == len(means))
    mean = Mean.of(mean.value for mean in means.values())
    return SequenceMean(mean.value, complete.deviation, len(means), len(values))


def mean_difference(differences: Mapping[Run, float]) -> Mean:
    """Return the mean of paired differences; its standard error is over sequences, as seeds are not independent."""
    return Mean.of(mean.value for mean in mean_by_sequence(differences).values())
