"""What a table compares: the records below a directory as rows, the row that the others are compared with, and what a
table shows of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from framework.config.validation import checked_block
from framework.errors import ConfigError, DataError
from framework.runs.metrics import is_evaluation
from framework.runs.run_rows import CHOICE, Run, RunRow, natural, rows_of
from framework.runs.stored_runs import Incomplete, Record, find_records, read_yaml
from framework.runs.sweep_file import SWEEP, asked_runs, sweep_rows
from framework.tables.published import (
    DATASET,
    MADE_UP,
    NOTHING_PUBLISHED,
    Key,
    Published,
    PublishedRow,
    read_published,
)

PLAIN = (
    *("instances.ap50", "instances.ap50_agnostic", "instances.ap25", "instances.ap", "instances.mean_iou"),
    *("instances.count", "trajectory.ate_rmse_m", "frames_lost", "fps"),
    *("stage_ms.refine.median", "stage_ms.fuse.median"),
)
"""The columns of a table that no experiment describes, as far as its runs have such figures: keys of metrics.json."""


@dataclass(frozen=True)
class TableChoice:
    """What a table shows: the block `table` of an experiment.

    A line is a row and a column is a metric, averaged over the runs that differ in `average_over` alone. With
    `columns_by`, a column is a value of that key, such as a sequence, and a line ends with their mean. With `group_by`,
    each of its values has a group of lines.
    """

    # keys of the config, averaged over and paired by; runs that agree in the last of them are no independent evidence
    average_over: list[str] = field(default_factory=lambda: ["seed"])
    columns_by: str | None = None  # key of the config with a column for each value; None = columns are figures
    group_by: str | None = None  # key of the config with a group of lines for each value; None = a line is all of a row
    baseline: str | None = None  # name of the row that the others are compared with; None = the first
    columns: list[str] = field(default_factory=list)  # keys of metrics.json, at least one; with `columns_by`, just one
    names: dict[str, str] = field(default_factory=dict)  # what rows are called in the table; others go by their name
    # section of published.yaml, whose numbers stand below where all runs are of the real SceneNN; None = none
    published: str | None = None

    def __post_init__(self) -> None:
        for name in ("average_over", "columns"):
            if not getattr(self, name):
                raise ConfigError(f"table.{name} must name at least one key")
        if self.columns_by and self.group_by:
            raise ConfigError(
                f"table.columns_by={self.columns_by}, table.group_by={self.group_by}: expected one of them to be null"
            )
        if self.split_key in self.average_over:
            raise ConfigError(f"table.average_over: expected other keys than table.{self.layout}, got {self.split_key}")
        if self.columns_by and len(self.columns) > 1:
            raise ConfigError(
                f"table.columns must name one figure, the one that stands across {self.columns_by}, found "
                f"{len(self.columns)}; table.group_by={self.columns_by} shows several"
            )
        if self.published and read_published(self.published).layout != self.layout:
            raise ConfigError(
                f"table.published={self.published} has numbers for a table with another layout: "
                f"{read_published(self.published).layout}, found {self.layout}"
            )

    @property
    def layout(self) -> str:
        """`columns_by`, `group_by` or `rows`."""
        return "columns_by" if self.columns_by else "group_by" if self.group_by else "rows"

    @property
    def split_key(self) -> str | None:
        """The key whose values are shown one by one, as columns or as groups of lines."""
        return self.columns_by or self.group_by

    @classmethod
    def of(cls, node: Any) -> TableChoice:
        """The choice that a config's `table` describes. Raises ConfigError for keys and types that it does not have."""
        return cls(**checked_block(cls, "table", node))


@dataclass(frozen=True)
class ComparisonTable:
    """All that a table says, before it is written in one format or another."""

    title: str
    choice: TableChoice
    rows: list[RunRow]  # in their order, each with a run or more
    overrides: Mapping[str, Sequence[str]]  # of the experiment's rows, by name; some may have no run yet
    asked: list[Run]  # what the sweep was last asked for, of every row; some may not have begun
    incomplete: list[Incomplete]
    superseded: int  # records of runs that have a later one
    root: Path  # what the names of runs are relative to
    left_out: Sequence[str] = ()  # of PLAIN, what no run has a figure of; without an experiment only

    @classmethod
    def below(cls, directory: Path) -> ComparisonTable:
        """From the records at and below `directory`, as the experiment that ran there says, else with the figures of
        PLAIN that there are.

        Raises DataError when there is no complete record, or when the experiment's config cannot be read.
        """
        if not directory.is_dir():
            raise DataError(f"{directory} is not a folder with records of runs")
        sweep = read_yaml(directory / SWEEP) if (directory / SWEEP).exists() else {}
        choice = TableChoice.of(sweep.get("table") or {"columns": list(PLAIN)})
        overrides = sweep_rows(sweep)
        records, incomplete = find_records(directory)
        if not records:
            why = "; ".join(f"{one.directory.name}: {one.reason}" for one in incomplete[:3])
            raise DataError(f"there is no complete run below {directory}{f' ({why})' if why else ''}")
        keys = [*choice.average_over, choice.split_key] if choice.split_key else choice.average_over
        rows = rows_of(records, keys, overrides)
        asked = asked_runs(sweep, keys)
        superseded = len(records) - sum(len(row.records) for row in rows)
        left_out = () if sweep.get("table") else _without_figure(choice.columns, rows)
        if left_out:
            choice = replace(choice, columns=[key for key in choice.columns if key not in left_out])
        return cls(
            directory.resolve().name, choice, rows, overrides, asked, incomplete, superseded, directory, left_out
        )

    @property
    def judged(self) -> bool:
        """Whether a figure depends on the true instances, of whose annotation there may be several releases."""
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
        """What is shown one by one, in a word: `scene` for dataset.scene."""
        return (self.choice.split_key or "").rpartition(".")[2]

    def base_of(self, row: RunRow) -> RunRow | None:
        """The row that `row` is compared with, of the same poses and the like; None for that one, and without it."""
        named = [other for other in self.rows if other.name == self.base_name]
        bases = named or [r for r in self.rows if r.system == self.base_name and r.variant == row.variant]
        return bases[0] if bases and bases[0] is not row else None

    @property
    def has_base(self) -> bool:
        return any(self.base_name in (row.name, row.system) for row in self.rows)

    @property
    def compared(self) -> list[tuple[RunRow, RunRow]]:
        """The rows that have one to be compared with, and that one."""
        pairs = ((row, self.base_of(row)) for row in self.rows)
        return [(row, base) for row, base in pairs if base is not None]

    @property
    def records(self) -> list[Record]:
        return [record for row in self.rows for record in row.records.values()]

    @property
    def is_of_scenenn(self) -> bool:
        """Whether all runs are of the real SceneNN, as published numbers are, and not of rooms in its format."""
        datasets = {record.metrics.get(f"{CHOICE}dataset") for record in self.records}
        return datasets == {DATASET} and not any(record.annotation.startswith(MADE_UP) for record in self.records)

    @cached_property
    def published(self) -> Published:
        if self.choice.published is None or not self.is_of_scenenn:
            return NOTHING_PUBLISHED
        return read_published(self.choice.published)

    @property
    def published_rows(self) -> list[PublishedRow]:
        """Those of which a number that the table shows is known."""
        return [row for row in self.published.rows if row.knows(self._keys)]

    @property
    def published_unknown(self) -> list[PublishedRow]:
        """Those of which no number that the table shows is known, as nobody has looked them up."""
        return [row for row in self.published.rows if not row.knows(self._keys) and row.leaves_open(self._keys)]

    @property
    def _keys(self) -> list[Key]:
        """What the table shows, as published numbers are listed."""
        if self.choice.columns_by:
            return [(sequence,) for sequence in self.sequences]
        if self.choice.group_by:
            return [(sequence, key) for sequence in self.sequences for key in self.choice.columns]
        return [(key,) for key in self.choice.columns]

    @cached_property
    def sequences(self) -> list[str]:
        """The values that are shown one by one: those of published tables first, and those of the runs."""
        found = {run[-1] for run in self._runs} if self.choice.split_key else set()
        order = sorted(found, key=lambda value: natural((value,)))
        return list(dict.fromkeys([*self.published.sequences, *order]))

    def called(self, row: RunRow, without: str = "") -> str:
        """What a row is called, without the part of its name that says which `without` it has."""
        named = self.choice.names.get(row.system, row.system)
        variant = [part for part in row.variant if not without or not part.startswith(f"{without}=")]
        return ", ".join([named, *variant] if named else variant) or row.name

    def missing(self) -> Iterator[tuple[RunRow, list[Run]]]:
        """The runs that a row should have: they were asked for, or other rows have their seeds and sequences."""
        runs = self._runs
        if self.choice.split_key:
            seeds, sequences = (dict.fromkeys(run[:-1] for run in runs), dict.fromkeys(run[-1] for run in runs))
            runs = [(*seed, sequence) for seed in seeds for sequence in sequences]
        for row in self.rows:
            if missing := sorted(set(runs) - set(row.records), key=natural):
                yield row, missing

    @property
    def _runs(self) -> list[Run]:
        """All that a row has or that were asked for."""
        return [*(run for row in self.rows for run in row.records), *self.asked]


def _without_figure(columns: Sequence[str], rows: Sequence[RunRow]) -> list[str]:
    """The columns that would be empty; none of them where all would, as a table without a column says nothing."""
    empty = [key for key in columns if not any(row.values(key) for row in rows)]
    return empty if len(empty) < len(columns) else []
