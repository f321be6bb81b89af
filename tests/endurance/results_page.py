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
from framework.runtime.run_log import STAGES
from tests.endurance.growth import EXPIRY, Verdict, by_place, by_visit, errors_mm, first_compared, rms, visits_of
from tests.endurance.visits import BLOCK, REFERENCE_INTERVAL, Block

NAME = "endurance"
PANELS = 5
LEFT_MM, RIGHT_MM, BOTTOM_MM, PANEL_MM, GAP_MM = 13.0, 4.0, 7.0, 24.0, 5.0
LEGEND_MM, LEGEND_STEP_MM = 3.5, 24.0  # distance of the legend from the top, and between its names
KILO, MEGA = 1e3, 1e6
INTRODUCTION = """# Endurance

`make endurance` maps {frames:,} frames of {places} places in one process. It fails if memory, time per frame, the
number of instances or the position error grows in a place that is already mapped.

```console
make endurance
python -m tests.endurance --frames 1000 --out outputs/endurance
```

Both commands write this page and its figure. The second one takes a few minutes. Its visits are too short for the
bounds, because the maps are not complete after the first visit.

| place | frames | detector |
| --- | --- | --- |
| redkitchen | Kinect recording, forward and backward | `maskrcnn2go`, cached in the first visit |
| freiburg1_rpy | Kinect recording, forward and backward | `maskrcnn2go`, cached in the first visit |
| standing | first frame of redkitchen, with new sensor noise in each frame | `maskrcnn2go` |
| room | rendered room; on the way back, other chairs, backpacks and books | `simulated_maskrcnn2go` |

The places are visited in turn. Each place has its own map, which stays in memory.

![Processor time, heap, instances and position error over all frames](endurance.png)
"""
METHOD = f"""## Method

- Tentative instances, i.e. those with too few detections (`fuser.min_observations`), expire after {EXPIRY:,} frames
  (`fuser.tentative_max_age`). From the next visit on, visits are compared.
- A visit consists of blocks of about {BLOCK} frames. A block is compared with the block at the same position of each
  later visit. Growth is the median slope of these pairs, with the quartiles in parentheses.
- A bound is missed if three quarters of the slopes exceed it. A single disturbed visit affects at most half of the
  pairs.
- Processor time: all threads in `Mapper.add`. Relative time: divided by the time to render a map of one frame, which is
  measured after every {REFERENCE_INTERVAL} frames. Other programs on the machine slow down both.
- Heap: memory that Python and all libraries allocate in the visits of a place. Most arrays of the map are reserved at
  the start, and their use does not count. Process: unique set size. It has no bound, because the system adds and
  removes huge pages.
- Error: distance of the camera from its reference position, root mean square. The reference of the standing camera is
  its first position.
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
            "## Bounds\n",
            *bounds_table(verdicts),
            "\n## Visits\n",
            *visits_table(blocks),
            "\n## Stages\n\nMedian time of each stage, ms, in the first and in the last compared visit:\n",
            *stages_table(blocks),
            "",
            METHOD,
            f"{provenance}\n",
        ]
    )
    with atomic_write(folder / f"{NAME}.md") as temporary:
        temporary.write_text(page, "utf-8")
    return folder / f"{NAME}.md"


def bounds_table(verdicts: Iterable[Verdict]) -> list[str]:
    rows = []
    for verdict in verdicts:
        bound, measured = verdict.bound, verdict.measured
        spread = "" if measured.spread is None else " ({:.3g} to {:.3g})".format(*measured.spread)
        limit = f"{bound.limit:g} {bound.unit}"
        result = "met" if verdict.is_met else "**missed**"
        rows.append([bound.quantity, verdict.place, f"{measured.value:.3g}{spread}", limit, result, bound.reason])
    return table(["growth", "place", "measured", "bound", "verdict", "reason for the bound"], rows)


def visits_table(blocks: Sequence[Block]) -> list[str]:
    """Return one row for each place and visit."""
    rows = []
    for name, own in by_place(blocks).items():
        errors = errors_mm(own)
        for visit in range(visits_of(own)):
            of_visit = [block for block in own if block.visit == visit]
            cpu, last = np.concatenate([block.cpu_ms for block in of_visit]), of_visit[-1]
            relative = float(np.median([block.relative_time for block in of_visit]))
            rows.append(
                [
                    name, str(visit + 1), str(len(cpu)), str(sum(block.lost for block in of_visit)),
                    f"{errors[visit]:.1f}", f"{np.median(cpu):.0f}", f"{np.quantile(cpu, 0.95):.0f}", f"{relative:.2f}",
                    f"{last.heap / MEGA:.2f}", f"{last.map_bytes / MEGA:.2f}", f"{last.process / MEGA:.0f}",
                    str(last.confirmed), str(last.tentative),
                ]
            )  # fmt: skip
    head = [
        "place", "visit", "frames", "lost", "error, mm", "processor time, ms", "95 %, ms", "relative time", "heap, MB",
        "map, MB", "process, MB", "confirmed", "tentative",
    ]  # fmt: skip
    return table(head, rows)


def stages_table(blocks: Sequence[Block]) -> list[str]:
    shown = [k for k in range(len(STAGES)) if any(np.isfinite(block.stage_ms[:, k]).any() for block in blocks)]
    rows = []
    for name, own in by_place(blocks).items():
        for visit in (first_compared(own), visits_of(own) - 1):
            times = np.concatenate([block.stage_ms for block in own if block.visit == visit])
            rows.append([name, str(visit + 1), *(f"{np.nanmedian(times[:, k]):.1f}" for k in shown)])
    return table(["place", "visit", *(STAGES[k] for k in shown)], rows)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def figure(blocks: Sequence[Block], provenance: str) -> Page:
    """Draw the measurements of all blocks over the number of frames."""
    height = BOTTOM_MM + PANELS * (PANEL_MM + GAP_MM)
    page = Page(
        PAGE_MM,
        height,
        "One line for each visit of a place, one point for each block. Processor time: median (solid), 95 % (dotted). "
        "Heap: difference from the first compared visit. Instances: confirmed (solid) and tentative (dotted). "
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
    style_axes(error, "frames of all places", labels[-1], "y")
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
