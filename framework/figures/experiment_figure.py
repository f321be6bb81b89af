"""Figure of an experiment's runs, as PNG and PDF."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from matplotlib import rc_context
from tqdm import tqdm

from framework.data import SceneTruth
from framework.errors import DataError, InstanceMapError
from framework.figures.class_heatmap import class_heatmap
from framework.figures.curve_figure import curve_figure, progress_figure
from framework.figures.distribution_figure import bar_figure, box_figure
from framework.figures.figure_page import Page
from framework.figures.figure_runs import Pictured
from framework.figures.map_figure import CaptionedLine, map_figure, panel_size
from framework.figures.map_panels import panel_line
from framework.figures.stage_times import COLUMNS, WINDOW, MeanTimes, stage_times_figure
from framework.figures.tradeoff_figure import tradeoff_figure
from framework.runs.reevaluation import Truth, classes_of, read_predictions
from framework.runs.run_rows import Run, RunRow
from framework.runs.stored_map import StoredMap
from framework.runs.stored_runs import Record
from framework.runs.timings_file import StageTimes, read_timings

log = logging.getLogger(__name__)

Read = TypeVar("Read")


@rc_context({"text.parse_math": False})  # names can contain $
def write_figure(directory: Path, overrides: Sequence[str] = ()) -> list[Path]:
    """Write figure.png and figure.pdf of the runs below `directory` into it, and return their paths.

    `overrides` change the settings of the figure, such as figure.kind=bar; figure.file_name names other files.
    Incomplete or unreadable runs are logged and omitted. Raises DataError if no run remains, and ConfigError for an
    invalid figure.
    """
    pictured = Pictured.below(directory, overrides)
    if missing := list(pictured.missing()):
        log.warning("omitted from the figure: %s", "; ".join(missing))
    return DRAWN[pictured.choice.kind](pictured).write(directory / pictured.choice.file_name)


def _stage_times(pictured: Pictured) -> Page:
    read = {name: _times_of(row) for name, row in pictured.rows.items()}
    means = {name: MeanTimes.of(list(times.values())) if times else None for name, times in read.items()}
    shown = [one for one in means.values() if one is not None]
    if not shown:
        raise DataError("timings.csv: expected a readable file, got none; see the log for the reasons")
    counts = "/".join(map(str, dict.fromkeys(one.count for one in shown)))
    sequences = [pictured.called(run) for run in pictured.runs if any(run in times for times in read.values())]
    stages = "; ".join(f"{name}: {' and '.join(added)}" for name, added in COLUMNS.items())
    note = (
        f"{stages}. Lines: mean over {counts} sequences ({', '.join(sequences)}) of running medians over {WINDOW} "
        "frames. Bands: fastest to slowest sequence. Right: median over all frames. ×: median of the last third of the "
        "frames divided by the median of the first third."
    )
    if any(one.longest > one.frames[-1] for one in shown):
        note += " Lines end at the last frame of the shortest sequence."
    return stage_times_figure(means, f"{note} {pictured.origin}")


def _times_of(row: RunRow | None) -> dict[Run, StageTimes]:
    """Return the times of the readable runs."""
    records = row.records if row else {}
    read = {run: _if_readable(_times, record) for run, record in records.items()}
    return {run: times for run, times in read.items() if times is not None}


def _times(record: Record) -> StageTimes:
    return read_timings(record.directory / "timings.csv")


def _maps(pictured: Pictured) -> Page:
    heads = [*pictured.rows, "ground truth"]
    with_frames = len({record.metrics.get("frames") for record in pictured.records}) > 1
    lines = []
    for run in tqdm(pictured.runs, unit=" lines", disable=None, dynamic_ncols=True):
        records = [row.records.get(run) if row else None for row in pictured.rows.values()]
        maps = [_if_readable(StoredMap.of, record) if record else None for record in records]
        shown = [one for one in maps if one is not None]
        if not shown:
            continue
        truth = _if_readable(_truth, shown[-1].record)
        line = panel_line(maps, truth, panel_size(len(heads)), pictured.choice.zoom)
        captions = [_caption(one, with_frames) for one in maps]
        captions.append(f"{line.true_count} instances" if truth else "")
        lines.append(CaptionedLine(pictured.called(run), line, captions))
    if not lines:
        raise DataError("map.npz: expected a readable map, got none; see the log for the reasons")
    note = (
        "An object has the same color in all images of a row. Dark: no match with a ground-truth object. "
        "Beige: ground-truth object of unknown class, not evaluated."
    )
    return map_figure(heads, lines, f"{note} {pictured.origin}")


DRAWN: Mapping[str, Callable[[Pictured], Page]] = {
    "stage_times": _stage_times,
    "maps": _maps,
    "bar": bar_figure,
    "box": box_figure,
    "tradeoff": tradeoff_figure,
    "curve": curve_figure,
    "progress": progress_figure,
    "class_heatmap": class_heatmap,
}
"""Drawing functions by FigureChoice.kind."""


def _truth(record: Record) -> SceneTruth | None:
    """Return the ground truth in the label space of the evaluation, or None for an unlabeled dataset."""
    truth = Truth.of(record.dataset).in_world_of(record)
    return None if truth is None else classes_of(record).compare(read_predictions(record), truth).truth


def _caption(stored: StoredMap | None, with_frames: bool) -> str:
    """Return the caption of a map: the number of frames (optional) and of instances, and AP50."""
    if stored is None:
        return ""
    metrics = stored.record.metrics
    ap50 = metrics.get("instances.ap50")
    parts = [f"{metrics.get('frames')} frames"] if with_frames else []
    parts.append(f"{len(stored.class_names)} instances")
    if ap50 is not None:
        parts.append(f"AP50 {ap50:.2f}")
    return ", ".join(parts)


def _if_readable(read: Callable[[Record], Read], record: Record) -> Read | None:
    """Return the result of `read`. If files cannot be read, log the reason and return None."""
    try:
        return read(record)
    except InstanceMapError as error:
        log.warning("omitted from the figure: %s", error)
        return None
