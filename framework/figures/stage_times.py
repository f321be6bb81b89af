"""Stage times over the frames of a sequence, averaged over sequences (Figure 3 of the paper)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from framework.data import Float64, Int64
from framework.figures.figure_page import COLUMN_MM, FAINT_INK, INK, NOTE_PT, SMALL_PT, TEXT_PT, Page, write_message
from framework.figures.metric_axes import spread, style_axes
from framework.runs.timings_file import StageTimes

WINDOW = 9  # number of frames in the window of the running median
COLUMNS = {
    "Mask R-CNN": ("detection",),
    "data association": ("lifting", "association"),
    "GMM": ("refinement",),
    "map integration": ("update", "integration"),
}
"""Stages of each line, by the name of the line in the paper. The assignment of the stages is our interpretation."""
COLORS = dict(zip(COLUMNS, ("#0072b2", "#8c6bb1", "#d55e00", "#b5830a"), strict=True))  # color-blind safe
RATES = {1000 / 30: "30 Hz", 100.0: "10 Hz"}  # names of the reference lines, by ms per frame
PLOT_MM, HEAD_MM, AXIS_MM = 48.0, 5.0, 6.5  # heights of a diagram, its heading and its axis labels
LEFT_MM, RIGHT_MM = 9.5, 25.5  # margins of the diagram
PLOT_WIDTH_MM = COLUMN_MM - LEFT_MM - RIGHT_MM
LABEL_PLACES_MM = (2.2, 2.8, 12.5)  # distances from the right edge of the diagram: line end, name and median, growth
LABEL_MM, LABEL_LINE_MM = 6.4, 2.6  # spacing of the labels and of their two lines
LOWEST_MS = 0.1  # lower limit of drawn times


@dataclass(frozen=True)
class MeanTimes:
    """The smoothed times of several sequences, up to the end of the shortest sequence."""

    frames: Int64  # (G,) frame numbers
    mean: Mapping[str, Float64]  # by name in COLUMNS: (G,) ms, NaN = unknown
    lowest: Mapping[str, Float64]  # by name: (G,) ms, of the fastest sequence at each frame
    highest: Mapping[str, Float64]  # by name: (G,) ms, of the slowest sequence at each frame
    count: int  # number of sequences
    longest: int  # last frame number of the longest sequence

    @classmethod
    def of(cls, runs: Sequence[StageTimes]) -> MeanTimes:
        """Return the mean times of one or more runs, each with at least one frame."""
        end = min(int(run.frames[-1]) for run in runs)
        frames = np.unique(np.concatenate([run.frames[run.frames <= end] for run in runs]))
        mean, lowest, highest = {}, {}, {}
        for name in COLUMNS:
            smooth = np.full((len(runs), len(frames)), np.nan)
            for line, run in zip(smooth, runs, strict=True):
                line[np.searchsorted(frames, run.frames[run.frames <= end])] = running_median(
                    _column(run, name), WINDOW
                )[run.frames <= end]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # all values may be NaN
                mean[name] = np.nanmean(smooth, axis=0)
                lowest[name], highest[name] = np.nanmin(smooth, axis=0), np.nanmax(smooth, axis=0)
        return cls(frames, mean, lowest, highest, len(runs), max(int(run.frames[-1]) for run in runs))

    @property
    def columns(self) -> list[str]:
        """Names in COLUMNS with known times."""
        return [name for name, values in self.mean.items() if np.isfinite(values).any()]

    def growth(self, name: str) -> float:
        """Return the median time of the last third of the frames divided by the median time of the first third.

        Return NaN if a median is unknown.
        """
        third = max(1, len(self.frames) // 3)
        first, last = self.mean[name][:third], self.mean[name][-third:]
        if not np.isfinite(first).any() or not np.isfinite(last).any():
            return float("nan")
        return float(np.nanmedian(last) / max(np.nanmedian(first), 1e-9))


def running_median(values: Float64, window: int) -> Float64:
    """Return the running median (F,) over `window` values, or fewer at both ends. NaN values stay NaN.

    `window` is odd.
    """
    half = window // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, half, constant_values=np.nan), window)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # windows may contain only NaN
        medians = np.nanmedian(around, axis=1)
    return np.where(np.isnan(values), np.nan, medians)


def stage_times_figure(rows: Mapping[str, MeanTimes | None], note: str) -> Page:
    """Return a page with one diagram per row (None = no run) and `note` at the bottom."""
    step = HEAD_MM + PLOT_MM + AXIS_MM
    page = Page(COLUMN_MM, step * len(rows), note)
    for k, (name, times) in enumerate(rows.items(), start=1):
        axes = page.axes(LEFT_MM, step * (len(rows) - k) + AXIS_MM, PLOT_WIDTH_MM, PLOT_MM)
        axes.set_title(name, fontsize=TEXT_PT, loc="left", pad=3, color=INK)
        if times is None:
            write_message(axes, "incomplete")
        else:
            _draw(axes, times)
    return page


def _column(run: StageTimes, name: str) -> Float64:
    """Return the total time (F,), ms, of the stages of a column; NaN if a stage did not run."""
    nothing = np.full(len(run.frames), np.nan)
    return np.asarray(np.sum([run.milliseconds.get(stage, nothing) for stage in COLUMNS[name]], axis=0), np.float64)


def _draw(axes: Axes, times: MeanTimes) -> None:
    for name in times.columns:
        low, mean, high = (np.maximum(one[name], LOWEST_MS) for one in (times.lowest, times.mean, times.highest))
        color = COLORS[name]
        axes.fill_between(times.frames, low, high, color=color, alpha=0.14, linewidth=0)
        axes.plot(times.frames, mean, color=color, linewidth=0.9, solid_capstyle="round")
    axes.set_yscale("log")
    axes.set_xlim(times.frames[0], max(times.frames[-1], times.frames[0] + 1))
    lowest, highest = axes.get_ylim()
    axes.set_ylim(lowest, max(highest, 1.25 * max(RATES)))
    style_axes(axes, "frame", "milliseconds per frame", "y")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(LogLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.tick_params(which="minor", width=0.3, length=1.2, color=FAINT_INK)
    for milliseconds, rate in RATES.items():
        axes.axhline(milliseconds, color=FAINT_INK, linewidth=0.5, dashes=(1.5, 2))
        halo = [withStroke(linewidth=1.2, foreground="white")]
        place: dict[str, Any] = {"xycoords": axes.get_yaxis_transform(), "textcoords": "offset points"}
        axes.annotate(rate, (0, milliseconds), (2, 1.2), fontsize=NOTE_PT, color=FAINT_INK, path_effects=halo, **place)
    _draw_labels(axes, times)


def _draw_labels(axes: Axes, times: MeanTimes) -> None:
    """Draw the name, the median and the growth at the right end of each line."""
    low, high = np.log10(axes.get_ylim())
    ends = [np.maximum(times.mean[name][np.isfinite(times.mean[name])][-1], LOWEST_MS) for name in times.columns]
    heights = [float((np.log10(end) - low) / (high - low)) for end in ends]  # relative to the height of the diagram
    line_x, name_x, growth_x = (1 + place / PLOT_WIDTH_MM for place in LABEL_PLACES_MM)
    half = LABEL_LINE_MM / 2 / PLOT_MM
    for name, height, place in zip(times.columns, heights, spread(heights, LABEL_MM / PLOT_MM), strict=True):
        color = COLORS[name]
        axes.plot([1, line_x], [height, place], color=color, linewidth=0.5, transform=axes.transAxes, clip_on=False)
        style: dict[str, Any] = {"va": "center", "transform": axes.transAxes}
        axes.text(name_x, place + half, name, fontsize=SMALL_PT, color=color, weight="bold", **style)
        median, growth = float(np.nanmedian(times.mean[name])), times.growth(name)
        axes.text(name_x, place - half, _short(median), fontsize=SMALL_PT, color=color, **style)
        if np.isfinite(growth):
            axes.text(growth_x, place - half, f"×{growth:.2f}", fontsize=NOTE_PT, color=FAINT_INK, **style)


def _short(milliseconds: float) -> str:
    return f"{milliseconds:.0f} ms" if milliseconds >= 9.95 else f"{milliseconds:.1f} ms"
