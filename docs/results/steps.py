"""Compare each row of an experiment with its baseline on several datasets: paired differences with intervals.

Usage: `python docs/results/steps.py DIR DIR... --out FOLDER`, with one folder of runs per dataset and detector. Rows
from `paper` to `default` are steps: each row is compared with the previous row. Later rows are compared with `default`.
In an experiment without `default`, all rows are compared with the first row.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from framework.commands.command_line import arguments, one_line_errors
from framework.data import Float64
from framework.errors import DataError
from framework.figures.figure_page import FAINT_INK, INK, MARGIN_MM, PAGE_MM, SMALL_PT, TEXT_PT, Page
from framework.runs.run_rows import CHOICE, CONFIDENCE, RunRow
from framework.tables.comparison import ComparisonTable
from framework.tables.grid import TextTable, figure, markdown_grid
from framework.tables.layouts import NOTHING
from framework.tables.metric_columns import head
from framework.tables.table_notes import counted, digest

SAMPLES = 10000  # number of bootstrap samples
SEED = 0  # random seed, reset for each row
SYNTHETIC = "synthetic"  # dataset with one scene per seed
START, END = "paper", "default"
BENEFIT = 0.005  # AP, minimum relevant mean difference
LINE_MM, HEAD_MM, AXIS_MM, NAMES_MM, GAP_MM = 3.4, 6.0, 5.0, 38.0, 3.0
REAL_COLOR, SYNTHETIC_COLOR = "#0072b2", "#d55e00"  # for color-blind readers


@dataclass(frozen=True)
class Scene:
    """One scene with one detector."""

    name: str
    synthetic: bool
    values: dict[str, dict[str, float]]  # by row and metric: mean over the common seeds of all rows


@dataclass(frozen=True)
class Difference:
    """Paired differences of a row from its baseline, one for each scene and detector."""

    values: Float64  # (n,)

    @property
    def mean(self) -> float:
        return float(self.values.mean()) if len(self.values) else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Bootstrap interval of the mean over scenes and detectors; NaN for fewer than two."""
        n = len(self.values)
        if n < 2:
            return math.nan, math.nan
        means = self.values[np.random.default_rng(SEED).integers(n, size=(SAMPLES, n))].mean(axis=1)
        low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
        return float(low), float(high)

    def __str__(self) -> str:
        if not len(self.values):
            return NOTHING
        low, high = self.interval
        text = _signed(self.mean)
        return f"{text} [{_signed(low)}, {_signed(high)}]" if len(self.values) > 1 else text


def main() -> None:
    """Run `python docs/results/steps.py`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "directory", metavar="DIR", nargs="+", type=Path, help="folder of the runs with one dataset and detector"
    )
    parser.add_argument(
        "--metric", metavar="KEY", nargs="+", default=["instances.ap50", "instances.ap50_agnostic"],
        help="keys of metrics.json; the figure shows the first key",
    )  # fmt: skip
    parser.add_argument("--out", metavar="FOLDER", type=Path, help="also write steps.md, steps.png and steps.pdf")
    options = arguments(parser)
    with one_line_errors():
        print(write_steps(options.directory, options.metric, options.out), end="")


def write_steps(directories: Sequence[Path], metrics: Sequence[str], out: Path | None) -> str:
    """Compare the rows and return the Markdown. With `out`, write the Markdown and the figure into this folder.

    Raises DataError if the folders have fewer than two common rows.
    """
    comparisons = [ComparisonTable.below(directory) for directory in directories]
    scenes = [scene for one in comparisons for scene in scenes_of(one, metrics)]
    rows = common_rows(scenes, comparisons[0])
    bases = bases_of(rows)
    text = markdown(scenes, bases, metrics, comparisons)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "steps.md").write_text(text, "utf-8")
        page(scenes, bases, metrics[0]).write(out / "steps")
    return text


def scenes_of(comparison: ComparisonTable, metrics: Sequence[str]) -> Iterator[Scene]:
    """Yield the scenes of a folder: one scene per seed for synthetic scenes, otherwise one scene."""
    choices = {
        key: {str(one.metrics.get(f"{CHOICE}{key}")) for one in comparison.records} for key in ("dataset", "detector")
    }
    if len(choices["dataset"]) > 1 or len(choices["detector"]) > 1:
        raise DataError(
            f"{comparison.root}: expected one dataset and one detector, got {choices}; use one folder per pair"
        )
    rows = {row.system or row.name: row for row in comparison.rows}
    seeds = set.intersection(*(set(row.records) for row in rows.values()))
    if not seeds:
        raise DataError(f"{comparison.root}: expected a complete seed in all rows, got none; run the missing rows")
    synthetic = choices["dataset"] == {SYNTHETIC}
    for group in [[seed] for seed in sorted(seeds)] if synthetic else [sorted(seeds)]:
        values = {name: {key: _mean(row, group, key) for key in metrics} for name, row in rows.items()}
        name = comparison.title + (f" {'-'.join(group[0])}" if synthetic else "")
        yield Scene(name, synthetic, values)


def common_rows(scenes: Sequence[Scene], comparison: ComparisonTable) -> list[str]:
    """Return the common rows of all scenes, in the order of the experiment."""
    order = [*comparison.overrides, *(row.name for row in comparison.rows if row.system not in comparison.overrides)]
    rows = [row for row in order if all(row in scene.values for scene in scenes)]
    if len(rows) < 2:
        raise DataError(f"DIR: expected at least two common rows of all folders, got {', '.join(rows) or 'none'}")
    return rows


def bases_of(rows: Sequence[str]) -> dict[str, str | None]:
    """Return the baseline of each row; None for the first row."""
    if START in rows and END in rows:
        end = rows.index(END)
        before: list[str | None] = [None, *rows[:end]]
        return dict(zip(rows, before + [END] * (len(rows) - end - 1), strict=True))
    return {row: rows[0] if k else None for k, row in enumerate(rows)}


def difference(scenes: Sequence[Scene], row: str, base: str, metric: str, *, synthetic: bool) -> Difference:
    """Return the paired differences of two rows over the scenes."""
    pairs = [(one.values[row][metric], one.values[base][metric]) for one in scenes if one.synthetic == synthetic]
    return Difference(np.array([value - other for value, other in pairs if not math.isnan(value - other)], np.float64))


def markdown(
    scenes: Sequence[Scene],
    bases: dict[str, str | None],
    metrics: Sequence[str],
    comparisons: Sequence[ComparisonTable],
) -> str:
    """Return the tables as Markdown."""
    parts = []
    for metric in metrics:
        header, body = ["row", "compared with"], []
        kinds = [synthetic for synthetic in (False, True) if any(one.synthetic == synthetic for one in scenes)]
        for synthetic in kinds:
            kind = "synthetic" if synthetic else "real"
            header += [f"mean, {kind}", f"difference, {kind}", "n"]
        for row, base in bases.items():
            line = [row, base or NOTHING]
            for synthetic in kinds:
                found = [one.values[row][metric] for one in scenes if one.synthetic == synthetic]
                paired = difference(scenes, row, base, metric, synthetic=synthetic) if base else Difference(np.empty(0))
                line += [
                    figure(float(np.nanmean(found)), math.nan, 3),
                    str(paired),
                    str(len(paired.values) or len(found)),
                ]
            body.append(line)
        parts += [f"## {head(metric)}", markdown_grid(TextTable(header, body))]
    absent = sorted({row for scene in scenes for row in scene.values} - set(bases))
    notes = [
        *([f"Omitted rows, missing in some folders: {', '.join(absent)}."] if absent else []),
        f"Intervals: {CONFIDENCE:.0%}, bootstrap over scenes and detectors, {SAMPLES} samples, seed {SEED}. n: pairs "
        "of scene and detector. Seeds of a real scene are averaged. Each seed of the synthetic dataset is one scene.",
        *(
            f"{one.title}: {counted(str(record.metrics.get('frames')) for record in one.records)} frames, code "
            f"{counted(record.code for record in one.records)}; SHA-256 of all configs: {digest(one.records)}."
            for one in comparisons
        ),
    ]
    return "\n\n".join([*parts, "\n".join(f"- {note}" for note in notes)]) + "\n"


def page(scenes: Sequence[Scene], bases: dict[str, str | None], metric: str) -> Page:
    """Draw the mean of each row and its difference from the baseline with the interval."""
    height = HEAD_MM + LINE_MM * len(bases) + AXIS_MM
    counts = [sum(one.synthetic == synthetic for one in scenes) for synthetic in (False, True)]
    compared = "the row above (below the line: default)" if END in bases.values() else next(iter(bases))
    groups = (("Blue: real scenes", counts[0]), ("Orange: synthetic scenes", counts[1]))
    colors = ". ".join(f"{name}, n = {count} pairs of scene and detector" for name, count in groups if count)
    note = (
        f"{head(metric)}. {colors}. Left: mean. Right: mean paired difference from {compared}, with its "
        f"{CONFIDENCE:.0%} interval. Gray band: differences below {BENEFIT}."
    )
    result = Page(PAGE_MM, height, note)
    width = (PAGE_MM - NAMES_MM - 3 * GAP_MM - MARGIN_MM) / 2
    lefts = (NAMES_MM, NAMES_MM + width + 2 * GAP_MM)
    means, differences = (result.axes(left, AXIS_MM, width, height - HEAD_MM - AXIS_MM) for left in lefts)
    rows = list(bases)
    differences.axvspan(-BENEFIT, BENEFIT, color="#e6e8eb", linewidth=0)
    for synthetic, color, shift in ((False, REAL_COLOR, -0.16), (True, SYNTHETIC_COLOR, 0.16)):
        group = [one for one in scenes if one.synthetic == synthetic]
        if not group:
            continue
        heights = np.arange(len(rows)) + shift
        values = [float(np.nanmean([one.values[row][metric] for one in group])) for row in rows]
        means.plot(values, heights, "o", color=color, markersize=2.4)
        for y, (row, base) in zip(heights, bases.items(), strict=True):
            if base:
                paired = difference(scenes, row, base, metric, synthetic=synthetic)
                differences.plot(paired.interval, (y, y), color=color, linewidth=0.8)
                differences.plot(paired.mean, y, "o", color=color, markersize=2.4)
    for k, row in enumerate(rows):
        means.annotate(
            row.replace("_", " "), (0, k), (-3, 0), xycoords=means.get_yaxis_transform(), textcoords="offset points",
            ha="right", va="center", fontsize=SMALL_PT, color=INK,
        )  # fmt: skip
    for axes, title in ((means, "mean"), (differences, "paired difference")):
        axes.set(ylim=(len(rows) - 0.4, -0.6))
        axes.set_title(title, fontsize=TEXT_PT, loc="left", pad=3, color=INK)
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.tick_params(axis="x", labelsize=SMALL_PT, width=0.4, length=2, pad=2, color=FAINT_INK, labelcolor=INK)
        axes.grid(axis="x", color="#e6e8eb", linewidth=0.4)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        if END in rows:
            axes.axhline(rows.index(END) + 0.5, color=FAINT_INK, linewidth=0.5)
    differences.axvline(0, color=FAINT_INK, linewidth=0.5)
    return result


def _mean(row: RunRow, seeds: Sequence[tuple[str, ...]], metric: str) -> float:
    """Return the mean of the runs with these seeds; NaN if the metric is missing in a run."""
    values = row.values(metric)
    return float(np.mean([values.get(seed, math.nan) for seed in seeds]))


def _signed(value: float) -> str:
    return NOTHING if math.isnan(value) else figure(value, math.nan, 3, signed=True)


if __name__ == "__main__":
    main()
