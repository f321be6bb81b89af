"""What the parts of the picture of a refinement share: sizes, letters, colours."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from framework.data import Array, UInt8
from framework.rendering.palette import INK, PAPER

WIDTH, MARGIN, GAP = 1640, 20, 16  # px, of the whole picture
PANEL_WIDTH = (WIDTH - 2 * MARGIN - GAP) // 2
TITLE_PX, TEXT_PX, TAG_PX = 22, 17, 15
SUPERSAMPLING = 2  # pixels that are drawn for one, in either direction
DROPPED = (214, 28, 44)  # points that no cluster holds any longer


def font_of(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font that comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / name), size)


def shortened(text: str, canvas: ImageDraw.ImageDraw, font: ImageFont.FreeTypeFont, room: float) -> str:
    """The text, or its beginning and an ellipsis where the room, px, is too small."""
    if canvas.textlength(text, font) <= room:
        return text
    while text and canvas.textlength(f"{text}…", font) > room:
        text = text[:-1]
    return f"{text}…"


def draw_heading(panel: Image.Image, text: str, left: int = 0) -> None:
    """Says what a panel shows, in its upper left corner."""
    canvas, font = ImageDraw.Draw(panel), font_of(TEXT_PX, bold=True)
    width = canvas.textlength(text, font) + 20
    canvas.rounded_rectangle((left + 8, 8, left + 8 + width, 36), 4, fill=PAPER)
    canvas.text((left + 18, 22), text, INK, font, anchor="lm")


def downsampled(drawn: Array, size: tuple[int, int]) -> UInt8:
    """What was drawn too large, (h, w, 3), at its height and width in the picture."""
    return np.asarray(cv2.resize(drawn, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)


def rgb_of(color: Array) -> tuple[int, int, int]:
    """A colour (3,) as PIL and OpenCV take it."""
    red, green, blue = np.rint(color).astype(int).tolist()
    return red, green, blue
