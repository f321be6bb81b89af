"""Compare the ranks of an experiment's rows on several datasets: means, ranks and Spearman's rho.

Usage: `python docs/results/ranks.py DIR DIR... --metric instances.ap50`, with one folder of runs per dataset.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import combinations
from pathlib import Path

import numpy as np

from framework.commands.command_line import arguments, one_line_errors
from framework.data import Float64
from framework.errors import DataError
from framework.files.atomic_write import atomic_write
from framework.runs.run_rows import CHOICE, CONFIDENCE, Run, RunRow
from framework.tables.comparison import ComparisonTable, mean_by_sequence
from framework.tables.grid import TextTable, decimals, figure, markdown_grid
from framework.tables.layouts import NOTHING
from framework.tables.metric_columns import head
from framework.tables.table_notes import counted, digest

FEWEST = 3  # minimum rows; two rows have the same order by chance with probability 0.5
SAMPLES = 2000  # number of bootstrap samples
SEED = 0  # random seed, reset for each pair of folders
DIGITS = 9  # decimals of means for equal ranks
OTHERS = "mean of the others"


@dataclass(frozen=True)
class Place:
    """An experiment folder with the common rows of all folders."""

    name: str  # name of the folder
    comparison: ComparisonTable
    values: Float64  # (R, S) metric by row and by sequence or seed
    runs: int  # number of runs per row, averaged by sequence
    left_out: int  # number of omitted runs without results in all rows

    @property
    def means(self) -> Float64:
        """Mean (R,) of each row with equal weights of the sequences."""
        return np.asarray(self.values.mean(axis=1), np.float64)

    def drawn_means(self, rng: np.random.Generator) -> Float64:
        """Return the means (SAMPLES, R) of bootstrap samples of the sequences, with common samples for all rows."""
        drawn = rng.integers(self.values.shape[1], size=(SAMPLES, self.values.shape[1]))
        return np.asarray(self.values[:, drawn].mean(axis=2).T, np.float64)


@dataclass(frozen=True)
class Agreement:
    """Spearman's rank correlation of the rows in two folders; NaN = undefined, as for equal rows."""

    rho: float
    over_rows: tuple[float, float]  # 95% bootstrap interval over rows
    over_runs: tuple[float, float]  # 95% bootstrap interval over the runs of each folder; NaN for a single run

    @classmethod
    def of(cls, first: Place, others: Sequence[Place]) -> Agreement:
        """Return the agreement of a folder with the mean of one or more other folders."""
        ours, theirs = first.means, _mean([place.means for place in others])
        rng = np.random.default_rng(SEED)
        drawn = rng.integers(len(ours), size=(SAMPLES, len(ours)))
        over_rows = _interval(spearman(ours[drawn], theirs[drawn]))
        over_runs = (math.nan, math.nan)
        if all(place.values.shape[1] > 1 for place in (first, *others)):
            over_runs = _interval(spearman(first.drawn_means(rng), _mean([place.drawn_means(rng) for place in others])))
        return cls(float(spearman(ours[None], theirs[None])[0]), over_rows, over_runs)


@dataclass(frozen=True)
class Ranking:
    """One metric of the common rows of all folders."""

    key: str  # of metrics.json
    rows: list[str]  # names, in descending order in the first folder
    places: list[Place]
    absent: dict[str, list[str]]  # folders without the row, by name of an omitted row

    @classmethod
    def of(cls, key: str, comparisons: Sequence[ComparisonTable]) -> Ranking:
        """Return the ranking by a metric.

        Raises DataError for a folder without the metric, or for too few common rows or sequences.
        """
        names = _names(comparisons)
        found = [{row.name: row for row in one.rows if row.values(key)} for one in comparisons]
        for comparison, rows in zip(comparisons, found, strict=True):
            if not rows:
                raise DataError(_unknown(key, comparison))
        everywhere = dict.fromkeys(row for rows in found for row in rows)
        absent = {
            row: missing
            for row in everywhere
            if (missing := [name for name, rows in zip(names, found, strict=True) if row not in rows])
        }
        common = [row for row in everywhere if row not in absent]
        if len(common) < FEWEST:
            raise DataError(
                f"{key}: expected at least {FEWEST} common rows of all folders, got {len(common)} "
                f"({', '.join(common) or 'none'}); {_listed(absent)}"
            )
        places = [
            _place(name, comparison, [rows[row] for row in common], key)
            for name, comparison, rows in zip(names, comparisons, found, strict=True)
        ]
        order = np.argsort(-places[0].means, kind="stable")
        ordered = [replace(place, values=place.values[order]) for place in places]
        return cls(key, [common[k] for k in order], ordered, absent)

    @cached_property
    def columns(self) -> dict[str, Float64]:
        """Means of the rows by folder, and for more than two folders the mean over all folders except the first."""
        columns = {place.name: place.means for place in self.places}
        if len(self.places) > 2:
            columns[OTHERS] = _mean([place.means for place in self.places[1:]])
        return columns

    def agreements(self) -> Iterator[tuple[str, Agreement]]:
        """Yield the agreement of each pair of folders, and of the first folder with the mean of the others."""
        for one, other in combinations(self.places, 2):
            yield f"{one.name}, {other.name}", Agreement.of(one, [other])
        if OTHERS in self.columns:
            yield f"{self.places[0].name}, {OTHERS}", Agreement.of(self.places[0], self.places[1:])


def main() -> None:
    """Run `python docs/results/ranks.py`."""
    parser = argparse.ArgumentParser(
        description="Compare an experiment's rows across datasets: the mean and rank of each row on each dataset, and "
        "Spearman's rho between datasets with bootstrap intervals.",
    )
    parser.add_argument(
        "directory",
        metavar="DIR",
        nargs="+",
        type=Path,
        help="folder of the experiment's runs on one dataset; for three or more folders, the first is also compared "
        "with the mean of the others",
    )
    parser.add_argument(
        "--metric", metavar="KEY", nargs="+", default=["instances.ap50"], help="keys of metrics.json, one table each"
    )
    parser.add_argument("--out", metavar="FOLDER", type=Path, help="also write ranks.md and ranks.csv to this folder")
    options = arguments(parser)
    with one_line_errors():
        print(write_ranks(options.directory, options.metric, options.out), end="")


def write_ranks(directories: Sequence[Path], keys: Sequence[str], out: Path | None) -> str:
    """Compare the experiments in `directories` by each metric and return the Markdown.

    With `out`, ranks.md and ranks.csv are written into this folder. Raises DataError for incomparable folders.
    """
    if len(directories) < 2:
        raise DataError(f"DIR: expected at least two folders, got {len(directories)}")
    if len({directory.resolve() for directory in directories}) < len(directories):
        raise DataError(f"DIR: expected each folder once, got {', '.join(map(str, directories))}")
    comparisons = [ComparisonTable.below(directory) for directory in directories]
    rankings = [Ranking.of(key, comparisons) for key in keys]
    text = markdown(rankings)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        for name, content in (("ranks.md", text), ("ranks.csv", comma_separated(rankings))):
            with atomic_write(out / name) as temporary:
                temporary.write_text(content, "utf-8")
    return text


def markdown(rankings: Sequence[Ranking]) -> str:
    """Return the tables as Markdown."""
    parts = ["# Ranks"]
    for ranking in rankings:
        parts += [f"## {head(ranking.key)}", markdown_grid(rank_grid(ranking)), markdown_grid(agreement_grid(ranking))]
        parts.append("\n".join(f"- {' '.join(note.split())}" for note in _notes_of(ranking)))
    parts.append("\n".join(f"- {' '.join(note.split())}" for note in _notes(rankings[0])))
    return "\n\n".join(parts) + "\n"


def rank_grid(ranking: Ranking) -> TextTable:
    """Return a table with one line per row: mean and rank in each folder."""
    columns = [(means, ranks(means)) for means in ranking.columns.values()]
    digits = decimals(float(value) for means, _ in columns for value in means)
    body = [
        [
            row,
            *(text for means, rank in columns for text in (figure(float(means[k]), math.nan, digits), f"{rank[k]:g}")),
        ]
        for k, row in enumerate(ranking.rows)
    ]
    return TextTable(["row", *(text for name in ranking.columns for text in (name, "rank"))], body)


def agreement_grid(ranking: Ranking) -> TextTable:
    """Return a table with one line per pair of folders."""
    share = f"{CONFIDENCE:.0%}"
    body = [
        [pair, str(len(ranking.rows)), _signed(one.rho), _between(one.over_rows), _between(one.over_runs)]
        for pair, one in ranking.agreements()
    ]
    return TextTable(["Spearman's rho of", "rows", "rho", f"{share} over rows", f"{share} over runs"], body)


def comma_separated(rankings: Sequence[Ranking]) -> str:
    """Return one CSV line per metric, row and folder, with all digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["figure", "row", "place", "mean", "rank"])
    for ranking in rankings:
        for place, means in ranking.columns.items():
            for row, mean, rank in zip(ranking.rows, means, ranks(means), strict=True):
                writer.writerow([ranking.key, row, place, repr(float(mean)), f"{rank:g}"])
    return text.getvalue()


def ranks(means: Float64) -> Float64:
    """Return the rank (R,) of each row, 1 = highest; ties share the mean of their ranks."""
    from scipy.stats import rankdata

    return np.asarray(rankdata(-means.round(DIGITS)), np.float64)


def spearman(ours: Float64, theirs: Float64) -> Float64:
    """Return Spearman's rho (N,) for each line of two samples (N, R): Pearson's correlation of the ranks.

    Ties share the mean of their ranks. The result is NaN for a line of equal values.
    """
    from scipy.stats import rankdata

    x, y = (rankdata(values.round(DIGITS), axis=1) for values in (ours, theirs))
    x, y = (rank - rank.mean(axis=1, keepdims=True) for rank in (x, y))
    with np.errstate(invalid="ignore"):
        return np.asarray((x * y).sum(axis=1) / np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1)), np.float64)


def _interval(samples: Float64) -> tuple[float, float]:
    """Return the interval that contains the fraction CONFIDENCE of the finite samples."""
    defined = samples[~np.isnan(samples)]
    if not len(defined):
        return math.nan, math.nan
    low, high = np.quantile(defined, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def _mean(values: Sequence[Float64]) -> Float64:
    return np.asarray(np.mean(values, axis=0), np.float64)


def _place(name: str, comparison: ComparisonTable, rows: Sequence[RunRow], key: str) -> Place:
    """Return the folder with the common runs of all rows, because sequences and seeds differ in difficulty."""
    values = [row.values(key) for row in rows]
    shared: set[Run] = set(values[0]).intersection(*values)
    if not shared:
        raise DataError(f"{comparison.root}: expected a run with {key} in all rows, got none; run the missing rows")
    by_row = [mean_by_sequence({run: of_row[run] for run in sorted(shared)}) for of_row in values]
    sequences = sorted({run[-1] for run in shared})
    matrix = np.array([[means[sequence].value for sequence in sequences] for means in by_row], np.float64)
    return Place(name, comparison, matrix, len(shared), len(set().union(*values)) - len(shared))


def _names(comparisons: Sequence[ComparisonTable]) -> list[str]:
    """Return the titles of the folders, or their paths if titles are equal."""
    titles = [one.title for one in comparisons]
    return [one.title if titles.count(one.title) == 1 else str(one.root) for one in comparisons]


def _unknown(key: str, comparison: ComparisonTable) -> str:
    known = sorted({name for row in comparison.rows for one in row.records.values() for name in one.metrics})
    close = get_close_matches(key, known, n=1)
    suggestion = f"; did you mean {close[0]}?" if close and close[0] != key else ""
    return f"{comparison.root}: expected a run with the metric {key}, got none{suggestion}"


def _listed(absent: dict[str, list[str]]) -> str:
    return (
        "; ".join(f"{row}: not in {', '.join(places)}" for row, places in absent.items()) or "no folder has other rows"
    )


def _signed(value: float) -> str:
    return NOTHING if math.isnan(value) else figure(value, math.nan, 2, signed=True)


def _between(interval: tuple[float, float]) -> str:
    return NOTHING if math.isnan(interval[0]) else f"{_signed(interval[0])} to {_signed(interval[1])}"


def _notes_of(ranking: Ranking) -> Iterator[str]:
    """Return the notes on one metric."""
    counts = ", ".join(f"{place.name} {place.runs}" for place in ranking.places)
    yield f"Runs of each row: {counts}."
    if ranking.absent:
        yield f"Omitted rows, missing in some folders: {_listed(ranking.absent)}."
    if dropped := [f"{place.name} {place.left_out}" for place in ranking.places if place.left_out]:
        yield f"Omitted runs, without this metric in some rows: {', '.join(dropped)}."


def _notes(ranking: Ranking) -> Iterator[str]:
    yield "Rank 1 is the highest; ties share the mean of their ranks. Rows are matched by name."
    if OTHERS in ranking.columns:
        yield (
            f"Others: all folders except {ranking.places[0].name}, with equal weights. Folders with larger differences"
            " between rows have more influence on the order."
        )
    yield (
        f"{CONFIDENCE:.0%} intervals: percentiles of {SAMPLES} bootstrap samples, seed {SEED}. Over rows: rows are"
        " drawn with replacement. Over runs: the sequences of each folder are drawn with replacement, or the seeds of a"
        " single sequence, with common samples for all rows. Intervals over few runs are too narrow. Similar rows are"
        " not independent, and seeds do not represent other datasets."
    )
    for place in ranking.places:
        records = place.comparison.records
        chosen = ", ".join(
            f"{stage}={counted(str(record.metrics.get(f'{CHOICE}{stage}')) for record in records)}"
            for stage in ("dataset", "detector")
        )
        annotation = counted(record.annotation or "unknown" for record in records)
        code = counted(record.code for record in records)
        yield (
            f"{place.name}: {chosen}, poses {counted(row.poses for row in place.comparison.rows)}; annotation: "
            f"{annotation}; code {code}; SHA-256 of all configs: {digest(records)}."
        )


if __name__ == "__main__":
    main()
