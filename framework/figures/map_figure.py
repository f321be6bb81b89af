"""Maps side by side with the ground truth (after Figures 4 and 5 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle

from framework.figures.figure_page import (
    FAINT_INK,
    HINTED,
    INCH_MM,
    INK,
    NOTE_PT,
    PAGE_MM,
    PDF_DPI,
    SMALL_PT,
    TEXT_PT,
    Page,
    draw_names,
    text_width,
    wrapped,
    write_message,
)
from framework.figures.map_panels import Panel, PanelLine
from framework.rendering.camera_path import ProjectedPath

HEAD_MM, CAPTION_MM, GAP_MM = 4.5, 4.0, 1.2  # space above the columns, below a line of panels, and between panels
LEFT_MM, RIGHT_MM = 3.5, 0.3  # space to the left and to the right of the panels
TEXT_LINE_MM, SMALL_LINE_MM = 3.0, 2.6  # line spacing of headings and captions
ASPECT = 0.78  # height of a panel divided by its width


@dataclass(frozen=True)
class CaptionedLine:
    """A line of panels with its name and captions."""

    name: str  # name of the sequence
    panels: PanelLine
    captions: Sequence[str]  # caption below each map; the last caption is for the ground truth

    @property
    def rows(self) -> int:
        """Number of rows of panels."""
        return 2 if self.panels.window else 1


def panel_size(columns: int) -> tuple[int, int]:
    """Return the width and height of a panel, px, in a figure with this number of columns."""
    width = _panel_mm(columns)
    return round(width * PDF_DPI / INCH_MM), round(width * ASPECT * PDF_DPI / INCH_MM)


def map_figure(heads: Sequence[str], lines: Sequence[CaptionedLine], note: str) -> Page:
    """Return the page with maps side by side.

    Args:
        heads: Column headings; the last column is the ground truth.
        lines: One line per sequence.
        note: Note at the bottom of the page.
    """
    width = _panel_mm(len(heads))
    height = width * ASPECT
    lefts = [LEFT_MM + k * (width + GAP_MM) for k in range(len(heads))]
    headings = [wrapped(head, width / HINTED, TEXT_PT) for head in heads]
    captions = [[wrapped(text, width / HINTED, SMALL_PT) for text in line.captions] for line in lines]
    feet = [CAPTION_MM + SMALL_LINE_MM * (max([1, *map(len, texts)]) - 1) for texts in captions]
    top = sum(line.rows * (height + GAP_MM) - GAP_MM + foot for line, foot in zip(lines, feet, strict=True))
    page = Page(PAGE_MM, top + HEAD_MM + TEXT_LINE_MM * (max(map(len, headings)) - 1), note)
    for left, heading in zip(lefts, headings, strict=True):
        style: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": TEXT_PT, "color": INK}
        page.text(left + width / 2, top + 0.8, "\n".join(heading), **style)
    for line, texts, below in zip(lines, captions, feet, strict=True):
        foot = top - line.rows * (height + GAP_MM) + GAP_MM
        vertical = {"rotation": 90, "ha": "center", "va": "center"}
        size = TEXT_PT * (top - foot) / max(top - foot, text_width(line.name, TEXT_PT))
        page.text(LEFT_MM / 2 - 0.2, (top + foot) / 2, line.name, fontsize=size, color=INK, **vertical)
        for left, caption in zip(lefts, texts, strict=True):
            style = {"ha": "center", "va": "top", "fontsize": SMALL_PT, "color": FAINT_INK}
            page.text(left + width / 2, foot - 1, "\n".join(caption), **style)
        overall = [page.axes(left, top - height, width, height) for left in lefts]
        for axes, panel in zip(overall, line.panels.maps, strict=False):
            _draw(axes, panel, "incomplete")
        _draw(overall[-1], line.panels.truth, "no ground truth")
        if line.panels.truth:
            draw_names(overall[-1], line.panels.truth.objects, line.panels.truth.names, NOTE_PT, width)
        if window := line.panels.window:
            corner = window.left - 0.5, window.top - 0.5
            for left, axes, panel in zip(lefts, overall, line.panels.zoomed, strict=True):
                larger = page.axes(left, foot, width, height)
                _draw(larger, panel, "")
                if panel:
                    draw_names(larger, panel.objects, panel.names, NOTE_PT, width)
                    axes.add_patch(Rectangle(corner, window.width, window.height, fill=False, ec=INK, linewidth=0.5))
        top = foot - below
    return page


def _panel_mm(columns: int) -> float:
    return (PAGE_MM - LEFT_MM - RIGHT_MM - GAP_MM * (columns - 1)) / columns


def _draw(axes: Axes, panel: Panel | None, otherwise: str) -> None:
    if panel is None:
        write_message(axes, otherwise)
        return
    height, width = panel.image.shape[:2]
    axes.imshow(panel.image, interpolation="antialiased", aspect="auto")
    if panel.path is not None:
        _draw_path(axes, panel.path)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def _draw_path(axes: Axes, path: ProjectedPath) -> None:
    """Draw the camera path; occluded segments are thin."""
    shades = path.shades() / 255.0
    segments = [path.pixels[k : k + 2] for k in range(len(path.pixels) - 1)]
    widths = [0.4 if hidden else 0.9 for hidden in path.hidden[:-1]]
    axes.add_collection(LineCollection(segments, colors=shades[:-1], linewidths=widths, capstyle="round"))
    for k in (0, -1) if len(path.pixels) else ():
        axes.plot(*path.pixels[k], "o", color=shades[k], markersize=2.6, markeredgecolor="white", markeredgewidth=0.4)
