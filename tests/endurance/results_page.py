"""Page and figure of an endurance run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from framework.data import Float64
from framework.figures.figure_page import INK, PAGE_MM, PNG_DPI, SMALL_PT, Page
from framework.figures.metric_axes import COLORS, style_axes
from framework.files.atomic_write import atomic_write
from tests.endurance.growth import Verdict, by_place, by_visit, first_compared, rms
from tests.endurance.visits import Block

NAME = "endurance"
PANELS = 5
LEFT_MM, RIGHT_MM, BOTTOM_MM, PANEL_MM, GAP_MM = 13.0, 4.0, 7.0, 24.0, 5.0
LEGEND_MM, LEGEND_STEP_MM = 3.5, 24.0  # distance of the legend from the top, and between its names
KILO, MEGA = 1e3, 1e6
INTRODUCTION = """# Endurance

Test a long run for growth of memory, processor time, instances and position errors:

```console
make endurance
python -m tests.endurance --frames 1000 --out outputs/endurance
```

The first command maps {frames:,} frames of {places} sequences in one process. The second is a short test that
may exceed the bounds. The first command overwrites this page. Real sequences are read from `redkitchen` and
`tum_fr1_rpy_a` in `../shared/data`. The process cycles through the sequences and maps each one several times:

- redkitchen, freiburg1_rpy: Kinect recordings, forward and backward
- standing: one frame of redkitchen, repeated with new noise
- room: rendered room, with different objects on the way back

![Processor time, heap, process memory, instances and position error over all frames](endurance.png)
"""
BOUNDS_INTRODUCTION = """Except for drift and lost frames, growth is the median slope over all pairs of passes
through a sequence, with quartiles in brackets. The first passes through each sequence are excluded, because tentative
instances have not expired yet. Values are bold if their lower quartile exceeds the bound, and italic if only their
median does.
"""
METHOD = """
Processor time is relative to a reference computation. For a more precise measurement, see `long_run_slowdown` in
[Acceptance](acceptance.md). Heap is the memory allocated while a sequence is mapped. Drift is the largest later
position error (RMS of a pass) minus that of the first compared pass. Sensor noise adds map blocks at depth edges.
Repeated images repeat detection errors, which add instances.
"""


def write_page(folder: Path, blocks: Sequence[Block], verdicts: Sequence[Verdict], provenance: str) -> Path:
    """Write the page and its figure, and return the path of the page.

    Args:
        folder: The folder of both files.
        blocks: The measurements.
        verdicts: The comparisons with the bounds.
        provenance: The commit, date and machine.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / f"{NAME}.png") as temporary:
        figure(blocks, provenance).figure.savefig(temporary, dpi=PNG_DPI)
    places = by_place(blocks)
    frames = max(block.all_frames for block in blocks)
    page = "\n".join(
        [
            INTRODUCTION.format(frames=frames, places=len(places)),
            BOUNDS_INTRODUCTION,
            *bounds_table(verdicts),
            METHOD,
            f"{provenance}\n",
        ]
    )
    with atomic_write(folder / f"{NAME}.md") as temporary:
        temporary.write_text(page, "utf-8")
    return folder / f"{NAME}.md"


def bounds_table(verdicts: Sequence[Verdict]) -> list[str]:
    """Return one row for each bound, with one column for each place."""
    places = list(dict.fromkeys(verdict.place for verdict in verdicts))
    rows = []
    for bound in dict.fromkeys(verdict.bound for verdict in verdicts):
        measured = {verdict.place: _measured_text(verdict) for verdict in verdicts if verdict.bound is bound}
        rows.append([bound.quantity, f"{bound.limit:g}{bound.unit}", *(measured[place] for place in places)])
    return table(["growth", "bound", *places], rows)


def _measured_text(verdict: Verdict) -> str:
    measured = verdict.measured
    spread = "" if measured.spread is None else " [{:.3g}, {:.3g}]".format(*measured.spread)
    text = f"{measured.value:.3g}{spread}"
    if not verdict.is_met:
        return f"**{text}**"
    return f"*{text}*" if measured.value > verdict.bound.limit else text


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    first, *others = (f"|{'|'.join(row)}|" for row in (head, *rows))
    return [first, f"|{'---|' * len(head)}", *others]


def figure(blocks: Sequence[Block], provenance: str) -> Page:
    """Draw the measurements of all blocks over the number of frames."""
    height = BOTTOM_MM + PANELS * (PANEL_MM + GAP_MM)
    page = Page(
        PAGE_MM,
        height,
        "One line for each pass through a sequence, one point for each block. "
        "Processor time: median (solid), 95% (dotted). "
        "Heap: difference from the first compared pass. Instances: confirmed (solid) and tentative (dotted). "
        f"Position error: root mean square. {provenance}",
    )
    labels = ("processor time, ms", "heap growth, KB", "process, MB", "instances", "position error, mm")
    cost, heap, process, instances, error = (
        page.axes(LEFT_MM, BOTTOM_MM + k * (PANEL_MM + GAP_MM), PAGE_MM - LEFT_MM - RIGHT_MM, PANEL_MM)
        for k in reversed(range(PANELS))
    )
    for axes, label in zip((cost, heap, process, instances, error), labels, strict=True):
        style_axes(axes, "", label, "y")
        axes.set_xlim(0, max(block.all_frames for block in blocks))
    style_axes(error, "frames of all sequences", labels[-1], "y")
    frames, sizes = zip(*((block.all_frames, block.process / MEGA) for block in blocks), strict=True)
    process.plot(frames, sizes, color=INK, linewidth=0.8)
    for k, (color, own) in enumerate(zip(COLORS, by_place(blocks).values(), strict=False)):
        draw = partial(_draw, blocks=own, color=color)
        draw(cost, by_visit(own, lambda block: float(np.median(block.cpu_ms))))
        draw(cost, by_visit(own, lambda block: float(np.quantile(block.cpu_ms, 0.95))), style=":")
        first = first_compared(own)
        heap_kb = by_visit(own, lambda block: block.heap / KILO)
        draw(heap, heap_kb - heap_kb[first], first=first)
        draw(instances, by_visit(own, lambda block: block.confirmed))
        draw(instances, by_visit(own, lambda block: block.tentative), style=":")
        draw(error, by_visit(own, lambda block: rms(block.errors_mm)))
        left, top = LEFT_MM + LEGEND_STEP_MM * k, height - LEGEND_MM
        page.text(left, top, f"\u2014 {own[0].place}", fontsize=SMALL_PT, color=color)
    for axes in (cost, process, instances, error):
        axes.set_ylim(bottom=0)
    return page


def _draw(
    axes: Axes, values: Float64, *, blocks: Sequence[Block], color: str, style: str = "-", first: int = 0
) -> None:
    """Draw the values (visits, positions) of a place, from the visit `first` on."""
    frames = by_visit(blocks, lambda block: block.all_frames)
    for visit in range(first, len(values)):
        axes.plot(frames[visit], values[visit], style, color=color, linewidth=0.8, marker=".", markersize=1.6)
