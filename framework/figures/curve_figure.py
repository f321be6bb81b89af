"""Curves of a metric against a numeric parameter, and of the number of detected objects over the frames."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import MaxNLocator

from framework.data import Float64
from framework.errors import DataError, InstanceMapError
from framework.figures.figure_page import MARGIN_MM, Page
from framework.figures.figure_runs import Pictured
from framework.figures.metric_axes import (
    LABEL_LEFT_MM,
    TICKS,
    Names,
    check_metrics,
    draw_labels,
    page_width,
    style_axes,
    styles,
    values_of,
)
from framework.runs.instances_file import read_instances
from framework.runs.stored_runs import INSTANCES, Record, is_number
from framework.runs.timings_file import read_timings
from framework.tables.metric_columns import described

LEFT_MM, AXIS_MM = 11.0, 6.5  # width and height of the axis labels
PLOT_MM = 46.0  # minimum height of the diagram
NAMES_PART = 0.34  # maximum width of the names, relative to the width of the page

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Curve:
    """Values of a metric by the value of a parameter or frame, over the runs of a group."""

    x: Float64  # (G,) ascending
    mean: Float64  # (G,)
    lowest: Float64  # (G,)
    highest: Float64  # (G,)
    count: tuple[int, int]  # least and largest number of runs of a point

    @classmethod
    def of(cls, samples: Mapping[float, Sequence[float]]) -> Curve:
        """Return the curve of the values of the runs by x; at least one x."""
        x = sorted(samples)
        values = [np.array(samples[one], np.float64) for one in x]
        counts = [len(one) for one in values]
        return cls(
            np.array(x, np.float64),
            np.array([one.mean() for one in values]),
            np.array([one.min() for one in values]),
            np.array([one.max() for one in values]),
            (min(counts), max(counts)),
        )


def curve_figure(pictured: Pictured) -> Page:
    """Return a page with one curve of the metric against a numeric parameter for each group.

    Runs without a number in the parameter are logged and omitted. Raises DataError if no run remains.
    """
    key, metric = pictured.choice.x_key, pictured.choice.shown_metric
    check_metrics(pictured, metric)
    curves = {}
    for name, records in pictured.groups.items():
        samples: dict[float, list[float]] = {}
        for record in records:
            x = record.settings.get(key)
            if is_number(x):
                samples.setdefault(float(x), []).extend(values_of([record], metric))
            else:
                log.warning("omitted from the figure: %s: %s is %s, not a number", record.directory.name, key, x)
        if samples := {x: values for x, values in samples.items() if values}:
            curves[name] = Curve.of(samples)
    if not curves:
        raise DataError(f"figure.x: expected numbers of {key} in at least one run, got none; choose a numeric key")
    lines = f"Lines: mean over the runs of each {pictured.unit} and point. Bands: lowest to highest run."
    return _figure(pictured, curves, key, described(metric), lines, with_markers=True)


def progress_figure(pictured: Pictured) -> Page:
    """Return a page with the number of objects of the final map that were detected up to each frame.

    Unreadable runs are logged and omitted. Raises DataError if no run remains.
    """
    curves = {}
    for name, records in pictured.groups.items():
        found = []
        for record in records:
            try:
                found.append(DetectedObjects.of(record))
            except InstanceMapError as error:
                log.warning("omitted from the figure: %s", error)
        if found:
            curves[name] = mean_progress(found)
    if not curves:
        raise DataError(f"{INSTANCES}: expected a readable file, got none; see the log for the reasons")
    lines = (
        "Lines: number of objects of the final map with a detection up to the frame, mean over the runs of each "
        f"{pictured.unit}, to the end of the shortest run. Bands: lowest to highest run."
    )
    return _figure(pictured, curves, "frame", "detected objects", lines, with_markers=False)


@dataclass(frozen=True)
class DetectedObjects:
    """Frames of a run, and of the first detections of the objects in its final map."""

    frames: Float64  # (F,) frame numbers, ascending
    first: Float64  # (N,) frame number of the first detection of each object, ascending

    @classmethod
    def of(cls, record: Record) -> DetectedObjects:
        """Read the objects of a run. Raises DataError if a file cannot be read."""
        instances = read_instances(record.directory / INSTANCES)
        frames = read_timings(record.directory / "timings.csv").frames
        return cls(frames.astype(np.float64), np.sort([float(one.first_frame) for one in instances]))


def mean_progress(runs: Sequence[DetectedObjects]) -> Curve:
    """Return the number of detected objects over the frames of one or more runs, to the end of the shortest run."""
    end = min(run.frames[-1] for run in runs)
    frames = np.unique(np.concatenate([run.frames[run.frames <= end] for run in runs]))
    counts = np.stack([np.searchsorted(run.first, frames, side="right") for run in runs]).astype(np.float64)
    return Curve(frames, counts.mean(axis=0), counts.min(axis=0), counts.max(axis=0), (len(runs), len(runs)))


def _figure(
    pictured: Pictured, curves: Mapping[str, Curve], x_label: str, y_label: str, lines: str, with_markers: bool
) -> Page:
    width = page_width(pictured)
    names = Names(list(curves), NAMES_PART * width)
    size = width - LEFT_MM - names.width - LABEL_LEFT_MM - 2 * MARGIN_MM, max(PLOT_MM, len(curves) * max(names.heights))
    counts = [number for curve in curves.values() for number in curve.count]
    runs = " to ".join(map(str, dict.fromkeys([min(counts), max(counts)])))
    page = Page(width, AXIS_MM + size[1] + 2 * MARGIN_MM, f"{lines} n = {runs} runs. {pictured.origin}")
    axes = page.axes(LEFT_MM, AXIS_MM, *size)
    style_axes(axes, x_label, y_label, "y")
    whole = all((curve.x % 1 == 0).all() for curve in curves.values())
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=TICKS, integer=whole))
    of_curve = styles(len(curves))
    for curve, style in zip(curves.values(), of_curve, strict=True):
        axes.fill_between(curve.x, curve.lowest, curve.highest, color=style.color, alpha=0.14, linewidth=0)
        marker = style.marker if with_markers else ""
        axes.plot(
            curve.x, curve.mean, style.line, marker=marker, color=style.color, linewidth=0.9, markersize=2.4, zorder=3
        )
    ends = [(float(curve.x[-1]), float(curve.mean[-1])) for curve in curves.values()]
    draw_labels(axes, ends, names, [style.color for style in of_curve], size)
    return page
