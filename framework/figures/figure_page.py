"""A page for a printed figure, with a note at the bottom, written as PNG and PDF."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patheffects import withStroke
from matplotlib.textpath import text_to_path

from framework.data import Int32
from framework.files.atomic_write import atomic_write
from framework.rendering.labels import place_labels
from framework.runtime.plain_output import plain

COLUMN_MM, PAGE_MM = 88.0, 181.0  # widths of one and two columns of a journal
TEXT_PT, SMALL_PT, NOTE_PT = 7.0, 6.0, 5.0  # font sizes
INK, FAINT_INK = "#20242a", "#787e86"
INCH_MM = 25.4
PNG_DPI = 200
PDF_DPI = 300  # resolution of raster images in a PDF
NOTE_LINE_MM = 2.35  # line spacing of the note
MARGIN_MM = 1.0
BREAKS = "_=,/-"  # characters after which a long word is broken
HINTED = 1.03  # maximum ratio of the width of hinted text in a PNG to the width of its outlines

logging.getLogger("fontTools").setLevel(logging.WARNING)  # fontTools logs a hundred lines about each font in a PDF


class Page:
    """A white page with a note at the bottom. Coordinates are in mm from the lower left corner above the note."""

    def __init__(self, width: float, height: float, note: str) -> None:
        lines = wrapped(note, (width - 2 * MARGIN_MM) / HINTED, NOTE_PT)
        self._foot = NOTE_LINE_MM * len(lines) + 2 * MARGIN_MM
        self._size = width, height + self._foot
        self.figure = Figure((self._size[0] / INCH_MM, self._size[1] / INCH_MM), facecolor="white")
        self.text(MARGIN_MM, MARGIN_MM - self._foot, "\n".join(lines), fontsize=NOTE_PT, color=FAINT_INK, va="bottom")

    def axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        """Add axes without ticks, in a thin frame; the arguments are in mm."""
        x, y = self._fraction(left, bottom)
        axes = self.figure.add_axes((x, y, width / self._size[0], height / self._size[1]))
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set(color=FAINT_INK, linewidth=0.3)
        return axes

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        self.figure.text(*self._fraction(x, y), plain(text), parse_math=False, **style)

    def write(self, path: Path) -> list[Path]:
        """Write the page to `path` with the suffixes .png and .pdf, and return both paths.

        Repeated calls write byte-identical files.
        """
        png, pdf = path.with_suffix(".png"), path.with_suffix(".pdf")
        with atomic_write(png) as temporary:
            self.figure.savefig(temporary, dpi=PNG_DPI)
        with atomic_write(pdf) as temporary, rc_context({"pdf.fonttype": 42}):  # keeps the text searchable
            self.figure.savefig(temporary, dpi=PDF_DPI, metadata={"CreationDate": None})
        return [png, pdf]

    def _fraction(self, x: float, y: float) -> tuple[float, float]:
        return x / self._size[0], (y + self._foot) / self._size[1]


def text_width(text: str, size: float) -> float:
    """Return the printed width, mm, of a text with font size `size`, pt."""
    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return float(width) / 72 * INCH_MM


def wrapped(text: str, width: float, size: float) -> list[str]:
    """Return the text as lines that are at most `width` mm wide with font size `size`, pt.

    Lines break at spaces, and after the characters in BREAKS or anywhere in a word that is wider than a line.
    """
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(longer, size) <= width:
            lines[-1] = longer
            continue
        while text_width(word, size) > width and len(word) > 1:
            fitting = next(k for k in range(len(word) - 1, 0, -1) if k == 1 or text_width(word[:k], size) <= width)
            end = max((k for k in range(1, fitting + 1) if word[k - 1] in BREAKS), default=fitting)
            lines.append(word[:end])
            word = word[end:]
        lines.append(word)
    return lines


def draw_names(axes: Axes, ids: Int32, names: Mapping[int, str], size: float, width_mm: float) -> None:
    """Write names on the objects of an image, or next to small objects with a leader line.

    Args:
        axes: Axes of the image; their unit is px.
        ids: (H, W) object ids of the pixels, 0 = none.
        names: Name by object id; names that do not fit are omitted.
        size: Font size, pt.
        width_mm: Width of the printed image, mm.
    """
    scale = ids.shape[1] / width_mm  # px per mm
    halo = [withStroke(linewidth=0.25 * size, foreground="white", alpha=0.85)]
    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": size, "color": INK, "path_effects": halo}
    style["parse_math"] = False
    line = {"arrowstyle": "-", "color": INK, "linewidth": 0.07 * size, "shrinkA": 0, "shrinkB": 0}
    height = size / 72 * INCH_MM
    for label in place_labels(ids, names, lambda text: (text_width(text, size) * scale, height * scale)):
        if label.target is None:
            axes.text(label.u, label.v, label.text, **style)
        else:
            axes.annotate(label.text, label.target, (label.u, label.v), arrowprops=line, **style)


def write_message(axes: Axes, text: str) -> None:
    """Write a message into empty axes, smaller in narrow axes."""
    width = axes.bbox.width / axes.figure.dpi * INCH_MM
    size = TEXT_PT * min(1.0, (width - MARGIN_MM) / text_width(text, TEXT_PT) / HINTED)
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=size, color=FAINT_INK)
