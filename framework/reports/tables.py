"""Tables of runs: from the records below a directory to Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from framework.atomic_files import written_whole
from framework.build import STAGES
from framework.command_line import CONF
from framework.errors import DataError
from framework.reports.comparison import CHOICE, CONFIDENCE, Mean, Row, TableChoice, rows_of
from framework.reports.records import Incomplete, Record, find_records, read_yaml

SWEEP = "multirun.yaml"  # Hydra's sweeper leaves the experiment's config under this name
DEFAULT_CHOICE = CONF / "parts" / "experiment.yaml"
NOTHING = "–"

HEADS = {
    "instances.ap": "AP",
    "instances.ap25": "AP25",
    "instances.ap50": "AP50",
    "instances.ap25_agnostic": "AP25 agnostic",
    "instances.ap50_agnostic": "AP50 agnostic",
    "instances.mean_iou": "mean IoU",
    "instances.count": "instances",
    "fps": "frames/s",
    "trajectory.ate_rmse_m": "ATE (m)",
    "trajectory.rpe_rmse_m": "RPE (m)",
    "map.bytes": "map (bytes)",
    "peak_rss_bytes": "peak memory (bytes)",
}
"""What columns are called; others get the name of their key."""


@dataclass(frozen=True)
class Comparison:
    """All that a table says, before it is written in one format or another."""

    title: str
    choice: TableChoice
    rows: list[Row]  # in their order, each with a run or more
    overrides: Mapping[str, Sequence[str]]  # of the experiment's rows, by name; some may have no run yet
    incomplete: list[Incomplete]
    superseded: int  # records of runs that have a later one
    root: Path  # what the names of runs are relative to

    @classmethod
    def below(cls, directory: Path) -> Comparison:
        """From the records at and below `directory`, as the experiment that ran there says, else as all do.

        Raises DataError when there is no complete record, or when the experiment's config cannot be read.
        """
        if not directory.is_dir():
            raise DataError(f"{directory} is not a folder with records of runs")
        sweep = read_yaml(directory / SWEEP) if (directory / SWEEP).exists() else {}
        choice = TableChoice.of(sweep.get("table") or read_yaml(DEFAULT_CHOICE)["table"])
        overrides = sweep.get("rows") or {}
        records, incomplete = find_records(directory)
        if not records:
            why = "; ".join(f"{one.directory.name}: {one.reason}" for one in incomplete[:3])
            raise DataError(f"there is no complete run below {directory}{f' ({why})' if why else ''}")
        rows = rows_of(records, choice.over, list(overrides))
        superseded = len(records) - sum(len(row.records) for row in rows)
        return cls(directory.resolve().name, choice, rows, overrides, incomplete, superseded, directory)

    @property
    def base(self) -> Row | None:
        """The row that the others are compared with; None while it has no run."""
        return next((row for row in self.rows if row.name == self._base_name), None)

    @property
    def _base_name(self) -> str:
        return self.choice.base or next(iter(self.overrides), self.rows[0].name)

    @property
    def records(self) -> list[Record]:
        return [record for row in self.rows for record in row.records.values()]

    def means(self) -> Grid:
        """Each row's mean and deviation."""
        columns = [_Column(key, [row.mean(key) for row in self.rows]) for key in self.choice.columns]
        body = [
            [
                *(row.name, str(len(row.records))),
                *(column.cell(k, column.means[k].deviation, len(row.records)) for column in columns),
                row.pose_source,
            ]
            for k, row in enumerate(self.rows)
        ]
        return Grid(heads=["row", "runs", *(column.head for column in columns), "poses"], body=body)

    def differences(self) -> Grid | None:
        """Each row's mean difference to the base with its standard error; None without a base or another row."""
        base = self.base
        others = [row for row in self.rows if row is not base]
        if base is None or not others:
            return None
        columns = [_Column(key, [row.difference(base, key) for row in others]) for key in self.choice.columns]
        pairs = [len(set(row.records) & set(base.records)) for row in others]
        body = [
            [row.name, str(n), *(c.cell(k, c.means[k].error, n, signed=True) for c in columns)]
            for k, (row, n) in enumerate(zip(others, pairs, strict=True))
        ]
        return Grid(heads=[f"less {base.name}", "pairs", *(c.head for c in columns)], body=body)

    def notes(self) -> Iterator[str]:
        """What a reader must know to trust the figures."""
        over = ", ".join(self.choice.over)
        yield f"Mean ± sample standard deviation over {over}; runs: how many are complete."
        if self.base is None:
            yield f"No differences: {self._base_name} is no row with a complete run; table.base=ROW names another."
        elif len(self.rows) > 1:
            yield (
                f"Differences are paired by {over}: mean ± standard error; "
                f"* where the {CONFIDENCE:.0%} interval of Student's t is without 0."
            )
        if self.overrides:
            changes = (f"{name}: {' '.join(changes) or 'nothing'}" for name, changes in self.overrides.items())
            yield f"What each row changes: {'; '.join(changes)}."
        if fixed := _same(self.records):
            yield f"In all: {fixed}."
        yield f"Code: {_counted(record.commit for record in self.records)}."
        yield f"Machine: {_counted(_machine(record) for record in self.records)}."
        yield f"Config: config.yaml beside each run; SHA-256 of all their hashes: {digest(self.records)}."
        yield from self._missing()
        if self.superseded:
            yield f"Left out, older records of the same runs: {self.superseded}."
        for one in self.incomplete:
            yield f"Not complete: {one.directory.relative_to(self.root)}: {one.reason.rstrip('.')}."

    def _missing(self) -> Iterator[str]:
        """The rows, and the runs that only other rows have, of which there is no record."""
        begun = {str(record.config.get("row")) for record in self.records}
        if absent := [name for name in self.overrides if name not in begun]:
            yield f"Without a complete run: {', '.join(absent)}."
        runs = dict.fromkeys(run for row in self.rows for run in row.records)
        for row in self.rows:
            if missing := [run for run in runs if run not in row.records]:
                told = "; ".join(" ".join(map("{}={}".format, self.choice.over, run)) for run in missing)
                yield f"Missing in {row.name}: {told}."


@dataclass(frozen=True)
class Grid:
    """Cells of text under heads."""

    heads: list[str]
    body: list[list[str]]


@dataclass(frozen=True)
class _Column:
    """One figure down the rows, with as many decimals as its largest needs."""

    key: str
    means: list[Mean]

    @property
    def head(self) -> str:
        return head(self.key)

    @property
    def decimals(self) -> int:
        largest = max((abs(mean.value) for mean in self.means if mean.count), default=0.0)
        return next((3 - k for k, limit in enumerate((2, 20, 200)) if largest < limit), 0)

    def cell(self, k: int, spread: float, expected: int, signed: bool = False) -> str:
        """Mean ± spread; with their number where it is not that of the row's runs."""
        mean = self.means[k]
        if not mean.count:
            return NOTHING
        text = f"{mean.value:{'+' if signed else ''}.{self.decimals}f}"
        if not math.isnan(spread):
            text += f" ± {spread:.{self.decimals}f}"
        if signed and mean.is_not_zero:
            text += " *"
        return text if mean.count == expected else f"{text} ({mean.count} of {expected})"


def head(key: str) -> str:
    """What a figure is called, with its unit."""
    parts = key.split(".")
    if parts[0] == "stage_ms" and len(parts) == 3:
        return f"{parts[1]} (ms{'' if parts[2] == 'median' else f', {parts[2]}'})"
    return HEADS.get(key, key)


def write_tables(directory: Path) -> str:
    """Writes table.md, table.tex and table.csv into `directory`, from the records below it; returns the Markdown.

    Raises DataError when there is no complete record.
    """
    comparison = Comparison.below(directory)
    text = markdown(comparison)
    for name, content in (("md", text), ("tex", latex(comparison)), ("csv", comma_separated(comparison))):
        with written_whole(directory / f"table.{name}") as temporary:
            temporary.write_text(content, "utf-8")
    return text


def markdown(comparison: Comparison) -> str:
    grids = [grid for grid in (comparison.means(), comparison.differences()) if grid]
    parts = [f"# {comparison.title}", *map(_markdown_grid, grids)]
    parts.append("\n".join(f"- {note}" for note in comparison.notes()))
    return "\n\n".join(parts) + "\n"


def _markdown_grid(grid: Grid) -> str:
    """Padded, so that it reads as a table in a terminal, too."""
    cells = [[cell.replace("|", "\\|") for cell in line] for line in (grid.heads, *grid.body)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    first, *lines = ["| " + " | ".join(_padded(line, widths)) + " |" for line in cells]
    rule = "| " + " | ".join(["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]) + " |"
    return "\n".join([first, rule, *lines])


def _padded(line: list[str], widths: list[int]) -> list[str]:
    return [line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))]


def latex(comparison: Comparison) -> str:
    """Tabulars for `\\usepackage{booktabs}`, with the notes as comments."""
    lines = [f"% {note}" for note in comparison.notes()]
    for grid in (comparison.means(), comparison.differences()):
        if grid is not None:
            lines += [f"\\begin{{tabular}}{{l{'r' * (len(grid.heads) - 1)}}}", "\\toprule", _latex_line(grid.heads)]
            lines += ["\\midrule", *map(_latex_line, grid.body), "\\bottomrule", "\\end{tabular}", ""]
    return "\n".join(lines)


_LATEX = str.maketrans(
    {
        **{mark: f"\\{mark}" for mark in "&%$#_{}"},
        **{"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}"},
        **{"±": "$\\pm$", "–": "--"},
    }
)


def _latex_line(cells: list[str]) -> str:
    return " & ".join(cell.translate(_LATEX) for cell in cells) + " \\\\"


def comma_separated(comparison: Comparison) -> str:
    """One line a row, all digits; empty where nothing is known."""
    base = comparison.base
    figures: dict[str, Callable[[Mean], float]] = {"mean": lambda m: m.value, "sd": lambda m: m.deviation}
    figures["n"] = lambda m: m.count
    paired: dict[str, Callable[[Mean], float]] = {"difference": lambda m: m.value, "se": lambda m: m.error}
    paired["pairs"] = lambda m: m.count
    keys = [f"{column}.{name}" for column in comparison.choice.columns for name in (*figures, *paired)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["row", "runs", "poses", *keys, "code", "config"])
    for row in comparison.rows:
        line: list[float] = []
        for column in comparison.choice.columns:
            line += [figure(row.mean(column)) for figure in figures.values()]
            difference = row.difference(base, column) if base else Mean.of(())
            line += [figure(difference) for figure in paired.values()]
        records = list(row.records.values())
        told = [_counted(record.commit for record in records), digest(records)]
        writer.writerow(
            [row.name, len(records), row.pose_source, *("" if math.isnan(x) else repr(x) for x in line), *told]
        )
    return text.getvalue()


def digest(records: Sequence[Record]) -> str:
    """One short hash of the configs of several runs, whatever their order."""
    hashes = sorted(str(record.metrics["config_hash"]) for record in records)
    return hashlib.sha256("".join(hashes).encode()).hexdigest()[:12]


def _same(records: Sequence[Record]) -> str:
    """What all runs have chosen, stage by stage."""
    chosen = {stage: {record.metrics.get(f"{CHOICE}{stage}") for record in records} for stage in STAGES}
    agreed = {stage: names for stage, names in chosen.items() if len(names) == 1 and None not in names}
    return ", ".join(f"{stage}={names.pop()}" for stage, names in agreed.items())


def _machine(record: Record) -> str:
    cores = f"{record.metrics.get('environment.cpus')} cores of {record.metrics.get('environment.processor')}"
    threads = record.config.get("threads")
    return f"{cores}, threads={threads}" if threads else cores


def _counted(words: Iterable[str]) -> str:
    counts = Counter(words).most_common()
    if len(counts) == 1:
        return counts[0][0]
    return ", ".join(f"{word} ({count} run{'s' * (count > 1)})" for word, count in counts)
