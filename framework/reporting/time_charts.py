"""How long the stages took, and how the map grew, over the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Float64
from framework.figures.stage_times import STAGES, WINDOW, running_median
from framework.reporting import svg
from framework.reporting.trajectory_chart import BOTTOM, LEFT, RIGHT, TOP, frame_axis
from framework.runs.timings_file import StageTimes

WIDTH, HEIGHT, GROWTH_HEIGHT = 560.0, 240.0, 390.0
MOST_POINTS = 240  # of a line: twice as many as it has pixels would not be seen
SHOWN = ("read", *STAGES)


@dataclass(frozen=True)
class StageRow:
    """One stage's times, ms."""

    stage: str
    lowest: float  # the 5th percentile
    median: float
    p95: float


def stage_rows(times: StageTimes) -> list[StageRow]:
    """Of the stages that ran, in their order."""
    rows = []
    for stage in SHOWN:
        values = times.milliseconds.get(stage, np.zeros(0))
        known = values[np.isfinite(values)]
        if len(known):
            low, median, high = np.percentile(known, [5, 50, 95]).tolist()
            rows.append(StageRow(stage, low, median, high))
    return rows


def stage_areas(times: StageTimes) -> str:
    """The stages' times on top of each other, running medians."""
    chosen = np.unique(np.linspace(0, len(times.frames) - 1, MOST_POINTS).astype(int))
    frames = times.frames[chosen].astype(float)
    layers = []
    for row in stage_rows(times):
        smooth = running_median(times.milliseconds[row.stage], WINDOW)
        layers.append((row.stage, np.nan_to_num(smooth)[chosen]))
    total = np.sum([values for _, values in layers], axis=0)
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    first, last = frames[0], max(frames[-1], frames[0] + 1)
    top = max(float(np.percentile(total, 98)) * 1.2, 1e-3)
    u = LEFT + (frames - first) / (last - first) * (right - LEFT)
    parts = []
    below = np.zeros(len(frames))
    for stage, values in layers:
        above = below + values
        line = np.stack([u, bottom - np.minimum(above, top) / top * (bottom - TOP)], axis=1)
        base = np.stack([u, bottom - np.minimum(below, top) / top * (bottom - TOP)], axis=1)
        parts += [svg.path(np.concatenate([line, base[::-1]]), closed=True, class_=f"area stage-{stage}")]
        below = above
    grid = []
    for value in svg.ticks(0, top, 4):
        y = bottom - value / top * (bottom - TOP)
        grid += [svg.path(np.array([[LEFT, y], [right, y]]), class_="grid")]
        grid += [svg.text(LEFT - 8, y + 4, svg.number(value), class_="tick", text_anchor="end")]
    label = svg.text(LEFT, 12, "ms, all stages on top of each other", class_="tick")
    parts += [*grid, frame_axis(first, last, LEFT, right, bottom), label]
    return svg.diagram(WIDTH, HEIGHT, "The stages' times over the frames", parts)


def growth(frames: Sequence[int], share: Float64, first_frames: Sequence[int], last_frame: int) -> str:
    """How much of the final surface had been in sight, and how many of the final objects were there, over the frames.

    Args:
        frames: that `share` (n,) is of.
        first_frames: of the objects.
        last_frame: of the video.
    """
    right, bottom, height = WIDTH - LEFT, GROWTH_HEIGHT - BOTTOM, GROWTH_HEIGHT - BOTTOM - TOP
    first, last = min([0, *frames]), max(last_frame, 1)
    highest = max(1, len(first_frames))

    def across(values: Sequence[float] | Float64) -> Float64:
        return np.asarray(LEFT + (np.asarray(values, np.float64) - first) / (last - first) * (right - LEFT))

    parts = []
    for percent in (0, 25, 50, 75, 100):
        y = bottom - percent / 100 * height
        parts += [svg.path(np.array([[LEFT, y], [right, y]]), class_="grid")]
        parts += [svg.text(LEFT - 8, y + 4, f"{percent}%", class_="tick", text_anchor="end")]
    for value in svg.ticks(0, highest, 4):
        y = bottom - value / highest * height
        parts += [svg.text(right + 8, y + 4, svg.number(value), class_="tick objects-tick")]
    line = np.stack([across(frames), bottom - share * height], axis=1)
    area = np.concatenate([line, [[line[-1, 0], bottom], [line[0, 0], bottom]]])
    parts += [svg.path(area, closed=True, class_="seen-area"), svg.path(line, class_="way seen")]
    steps = [(first, 0)]
    for count, frame in enumerate(sorted(first_frames), start=1):
        steps += [(frame, count - 1), (frame, count)]
    steps += [(last, len(first_frames))]
    corners = np.array(steps, np.float64)
    stairs = np.stack([across(corners[:, 0]), bottom - corners[:, 1] / highest * height], axis=1)
    parts += [svg.path(stairs, class_="way objects"), frame_axis(first, last, LEFT, right, bottom)]
    return svg.diagram(WIDTH, GROWTH_HEIGHT, "Surface in sight and objects found over the frames", parts)
