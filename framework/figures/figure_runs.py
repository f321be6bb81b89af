"""The runs shown in a figure, in groups."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_type_hints

from framework.config.text_values import literal_in_block
from framework.config.validation import checked_rows
from framework.errors import DataError
from framework.figures.figure_choice import OF_RUNS, FigureChoice
from framework.runs.run_rows import Run, RunRow, is_below, natural, rows_of, value_of
from framework.runs.stored_runs import Incomplete, Record, completed_runs
from framework.runs.sweep_file import asked_keys, command_line, read_sweep, requested_runs
from framework.tables.table_notes import counted, data, machines

BLOCK = "figure"  # name of the config block


@dataclass(frozen=True)
class Pictured:
    """The runs shown in a figure."""

    choice: FigureChoice
    rows: Mapping[str, RunRow | None]  # requested rows and rows with runs, by display name; None = no complete run
    incomplete: Sequence[Incomplete]
    requested: Mapping[str, Sequence[str]] = field(default_factory=dict)  # values that the sweep requested, by KEY
    command_line: Sequence[str] = ()  # overrides of the sweep on the command line
    asked: Collection[str] | None = None  # keys in the overrides of the sweep; None = unknown

    @classmethod
    def below(cls, directory: Path, overrides: Sequence[str] = ()) -> Pictured:
        """Read the runs in and below `directory`, as defined by the sweep's config and by `overrides` of its figure.

        Raises DataError if there is no figure or no complete run, and ConfigError if the figure is invalid.
        """
        if not directory.is_dir():
            raise DataError(f"{directory}: expected a folder of runs, got no folder")
        sweep = read_sweep(directory, literal_in_block(BLOCK, get_type_hints(FigureChoice), overrides))
        if not sweep.get(BLOCK):
            raise DataError(f"{directory}: expected a sweep with a figure, got none; add figure.kind=bar, for example")
        choice = FigureChoice.of(sweep[BLOCK])
        changes, asked = checked_rows(sweep.get("rows")), asked_keys(sweep)
        records, incomplete = completed_runs(directory)
        choice.check_keys({key for record in records for key in record.settings} | (asked or set()))
        found = rows_of(records, choice.over, changes, asked)
        chosen = {row for (row,) in requested_runs(sweep, ["row"])} or {*changes}
        expected = [name for name in changes if name in chosen or any(row.system == name for row in found)]
        rows: dict[str, RunRow | None] = {}
        for system in dict.fromkeys([*expected, *(row.system for row in found)]):
            of_system: dict[str, RunRow | None] = {
                choice.called(", ".join(filter(None, [choice.called(system), *row.variant])) or row.name): row
                for row in found
                if row.system == system
            }
            rows |= of_system or {choice.called(system): None}
        keys = filter(None, (choice.by, choice.color_by))
        requested = {key: [value for (value,) in requested_runs(sweep, [key])] for key in keys} | {"row": expected}
        return cls(choice, rows, incomplete, requested, command_line(sweep), asked)

    @property
    def groups(self) -> dict[str, list[Record]]:
        """The runs of each row, or of each value of figure.by, by display name; [] = no complete run."""
        if self.choice.by is None:
            return {name: list(row.records.values()) if row else [] for name, row in self.rows.items()}
        return {self.choice.called(value): records for value, records in self._split(self.choice.by).items()}

    def _split(self, key: str) -> dict[str, list[Record]]:
        """Return the runs of each value of a KEY: numbers by value, then other values in the order of the sweep."""
        found: dict[str, list[Record]] = {value: [] for value in self.requested.get(key, ())}
        for record in sorted(self.records, key=lambda record: value_of(record, key)):
            found.setdefault(value_of(record, key), []).append(record)
        return {value: found[value] for value in sorted(found, key=_number)}

    @property
    def colors(self) -> list[str]:
        """Values of figure.color_by, in order; one empty value without it."""
        key = self.choice.color_by
        return [""] if key is None else list(self._split(key))

    @property
    def color_names(self) -> list[str]:
        """Display names of `colors`, such as detector=simulated."""
        names, key = self.choice.names, self.choice.color_by
        return [names.get(color, f"{key}={color}") for color in self.colors]

    @property
    def unit(self) -> str:
        """Name of a group: "row", or the KEY of figure.by."""
        return self.choice.by or "row"

    def of_color(self, records: Sequence[Record], color: str) -> list[Record]:
        """Return the runs with a value of figure.color_by."""
        key = self.choice.color_by
        return list(records) if key is None else [one for one in records if value_of(one, key) == color]

    def varied(self, groups: Iterable[Sequence[Record]]) -> list[str]:
        """Return the options and parameters that differ within a group and that the sweep sets."""
        keys = set()
        for records in groups:
            for key in {key for record in records for key in record.settings}:
                if len({value_of(record, key) for record in records}) > 1:
                    keys.add(key)
        asked = {key for key in keys if self.asked is None or key in self.asked}
        return sorted(key for key in asked if key == "row" or not is_below(key, keys - {key}))

    @property
    def runs(self) -> list[Run]:
        """All runs of the rows, sorted by sequence."""
        found = {run for row in self.rows.values() if row for run in row.records}
        return sorted(found, key=lambda run: natural(run[::-1]))

    @property
    def records(self) -> list[Record]:
        return [record for row in self.rows.values() if row for record in row.records.values()]

    @property
    def origin(self) -> str:
        """Return the data, the overrides on the command line, the machine and the code of the runs."""
        chosen = f" Command line: {' '.join(self.command_line)}." if self.command_line else ""
        runs = self.records
        code = counted(record.commit for record in runs)
        origin = "; ".join(filter(None, (machines(runs), f"code {code}")))
        return f"Data: {data(runs)}.{chosen} {origin}."

    def called(self, run: Run) -> str:
        """Return the name of the run's sequence, with the seed if the runs have several seeds."""
        seeds = {other[0] for other in self.runs}
        return run[-1] if len(run) == 1 or len(seeds) == 1 else f"{run[-1]}, seed {run[0]}"

    def missing(self) -> Iterator[str]:
        """Yield incomplete runs with their reasons, and the missing runs of each row, or the groups without runs."""
        for one in self.incomplete:
            yield f"{one.directory.name}: {one.reason}"
        if self.choice.kind not in OF_RUNS:
            yield from (f"{name} without runs" for name, records in self.groups.items() if not records)
            return
        for name, row in self.rows.items():
            if absent := [self.called(run) for run in self.runs if row is None or run not in row.records]:
                yield f"{name} without {', '.join(absent)}"


def _number(value: str) -> float:
    """Return the number in a text; infinity for other texts."""
    try:
        return float(value)
    except ValueError:
        return math.inf
