"""Table of the 2D metrics of several detectors, for sweeps of `instancemap detect`."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.evaluation.detection_ap import DetectionAp
from framework.evaluation.detection_errors import FOUND_IOU, DetectionErrors
from framework.files.atomic_write import atomic_write
from framework.files.json_file import read_json, write_json
from framework.runs.data_frame import plain_cell
from framework.runs.stored_runs import is_number
from framework.tables.grid import TextTable, decimals, figure, markdown_page
from framework.tables.latex_table import LatexTable, escaped, latex_file, latex_label
from framework.tables.metric_columns import Direction

METRICS = "detection_metrics.json"  # file in the folder of each job
OVERRIDES = "overrides"  # key of the overrides in this file

DetectionMetrics = Mapping[str, float | int | str]
"""Metrics of one result file by name. Undefined values are NaN."""

COLUMNS = {
    "mask_ap": "mask AP",
    "mask_ap50": "mask AP50",
    "box_ap": "box AP",
    "box_ap50": "box AP50",
    "found": "found",
    "correct class": "correct class",
    "false detections per image": "false per image",
}
"""Column headings by metric."""

DIRECTIONS = [Direction.HIGHER] * 6 + [Direction.LOWER]
"""Directions of better values, in the order of COLUMNS."""

COUNTS = ("frames", "detections", "objects", "classes")


@dataclass(frozen=True)
class Job:
    """A completed job of a sweep."""

    folder: str  # relative to the sweep
    overrides: Sequence[str]
    metrics: Mapping[str, Any]  # by name; a value of None = undefined

    def called(self, swept: Collection[str]) -> str:
        """Return the overrides of the swept keys, or the folder of the job if there are none."""
        chosen = [one.lstrip("+") for one in self.overrides if one.lstrip("+~").partition("=")[0] in swept]
        return re.sub(r"\\(.)", r"\1", " ".join(chosen)) or self.folder

    def value(self, key: str) -> float:
        """Return a metric, or NaN if it is undefined."""
        return float(found) if is_number(found := self.metrics.get(key)) else math.nan


def detection_metrics(
    sequence: str, frames: int, detections: int, precision: DetectionAp, errors: DetectionErrors
) -> DetectionMetrics:
    """Return the metrics of a result file. Without evaluated objects, only the counts are defined."""
    return {
        "sequence": sequence,
        "frames": frames,
        "detections": detections,
        "objects": precision.masks.objects,
        "classes": sum(not math.isnan(ap) for ap in precision.masks.ap50_by_class.values()),
        "mask_ap": precision.masks.ap,
        "mask_ap50": precision.masks.ap50,
        "box_ap": precision.boxes.ap,
        "box_ap50": precision.boxes.ap50,
        **errors.table(),
        **{f"mask_ap50.{name}": ap for name, ap in precision.masks.ap50_by_class.items() if not math.isnan(ap)},
        **{f"box_ap50.{name}": ap for name, ap in precision.boxes.ap50_by_class.items() if not math.isnan(ap)},
    }


def write_metrics(folder: Path, overrides: Sequence[str], metrics: DetectionMetrics) -> None:
    """Write the metrics of a job to its folder."""
    write_json(folder / METRICS, {OVERRIDES: list(overrides), **metrics})


def write_detection_table(directory: Path, swept: Collection[str], min_pixels: int) -> str:
    """Write table.md, table.tex and table.csv of a sweep into its folder.

    Args:
        directory: The folder of the sweep.
        swept: The keys with several values. Their overrides are the names of the rows.
        min_pixels: The minimum area of an evaluated object, px, for the notes.

    Returns:
        The Markdown text.

    Raises:
        DataError: No job is complete, or the metrics of a job are invalid.
    """
    jobs = [_read(path) for path in sorted(directory.glob(f"*/{METRICS}"))]
    if not jobs:
        raise DataError(f"{directory}: expected a completed job, got none; the log lists the reasons")
    incomplete = sorted(path.name for path in directory.iterdir() if path.is_dir() and not (path / METRICS).exists())
    grid = _grid(jobs, swept)
    notes = list(_notes(jobs, incomplete, min_pixels))
    text = markdown_page(directory.name, [grid], notes)
    caption = escaped(f"{directory.name}: 2D metrics of detections. {notes[0]}")
    latex = latex_file([LatexTable(grid, caption, latex_label(directory.name))], notes)
    for name, content in (("md", text), ("tex", latex), ("csv", _comma_separated(jobs))):
        with atomic_write(directory / f"table.{name}") as temporary:
            temporary.write_text(content, "utf-8")
    return text


def _read(path: Path) -> Job:
    content = read_json(path)
    overrides = content.pop(OVERRIDES, None) if isinstance(content, dict) else None
    if not isinstance(overrides, list):
        raise DataError(f"{path}: expected the metrics of `instancemap detect`, got other content; repeat the job")
    return Job(path.parent.name, [str(one) for one in overrides], content)


def _grid(jobs: Sequence[Job], swept: Collection[str]) -> TextTable:
    digits = {key: decimals(job.value(key) for job in jobs) for key in COLUMNS}
    body = []
    for job in jobs:
        counts = [f"{job.value(key):.0f}" for key in COUNTS]
        values = [(key, job.value(key)) for key in COLUMNS]
        cells = ["–" if math.isnan(value) else figure(value, math.nan, digits[key]) for key, value in values]
        body.append([job.called(swept), str(job.metrics.get("sequence")), *counts, *cells])
    heads = ["row", "sequence", *COUNTS]
    directions = {len(heads) + k: direction for k, direction in enumerate(DIRECTIONS)}
    return TextTable([*heads, *COLUMNS.values()], body, 2, directions=directions)


def _notes(jobs: Sequence[Job], incomplete: Sequence[str], min_pixels: int) -> Iterator[str]:
    if any(job.value("objects") for job in jobs):
        yield (
            "AP: COCO, in [0, 1], by the IoU of masks or boxes, mean over IoU 0.5 to 0.95 and the classes. AP50: at "
            f"IoU 0.5. objects: number of ground-truth objects of at least {min_pixels} px, summed over the frames. "
            "classes: number of their classes."
        )
        yield (
            f"found: fraction of the objects with a mask IoU of at least {FOUND_IOU:g}, regardless of class. correct "
            "class: fraction of these whose most likely class is that of the ground truth."
        )
    if not all(job.value("objects") for job in jobs):
        yield "–: the sequence has no ground-truth instances of the detector's classes."
    evaluated: dict[str, set[tuple[float, float]]] = {}
    for job in jobs:
        counts = (job.value("objects"), job.value("classes"))
        evaluated.setdefault(str(job.metrics.get("sequence")), set()).add(counts)
    for sequence, different in evaluated.items():
        if len(different) > 1:
            yield (
                f"Rows of {sequence} with different objects or classes are not comparable: each detector is evaluated "
                "on its own classes."
            )
    if incomplete:
        yield f"Jobs without result: {'; '.join(incomplete)}."


def _comma_separated(jobs: Sequence[Job]) -> str:
    """Return a CSV table of all metrics with one line per job. Undefined values are empty."""
    keys = list(dict.fromkeys(key for job in jobs for key in job.metrics))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["folder", OVERRIDES, *keys])
    for job in jobs:
        values = ["" if (one := job.metrics.get(key)) is None else one for key in keys]
        row = [job.folder, " ".join(job.overrides), *values]
        writer.writerow([plain_cell(one) if isinstance(one, str) else one for one in row])
    return text.getvalue()
