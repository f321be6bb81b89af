"""Placement of object names in an image.

Names are on large objects. Names of small objects are next to the object, with a leader line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from framework.data import Bool, Int32
from framework.rendering.palette import INK, PAPER
from framework.runtime.plain_output import plain_line

MIN_PIXELS = 60  # px, minimum area of an object with a name
ROOM = 0.75  # minimum distance from the center of a name to the border of its object, relative to the text height
NEAREST, FARTHEST, STEP = 24, 160, 8  # px, start, end (exclusive) and step of the distances from an object to its name
DIRECTIONS = 32  # number of directions from an object to its name
ABOUT = 0.9  # minimum distance of a candidate point from the border of the object, relative to the largest distance
ON_OTHERS = 0.1  # maximum fraction of the area of a name over other objects, for a name on its object
COVERING = 150.0  # px, cost of a name whose whole area is over objects
CROSSING = 100.0  # px, cost of a leader line whose whole length is over other objects
SAMPLES = 24  # number of sampled points of a leader line
DOT = 2.5  # px, radius of the dot at the end of a leader line
AROUND = 3  # px, margin around a name
HALO = 3  # px, width of the halo around the letters of a name

Box = tuple[float, float, float, float]  # left, top, right, bottom, px


@dataclass(frozen=True)
class Label:
    """A name and its position."""

    text: str
    u: float  # px, column of the center
    v: float  # px, row of the center
    target: tuple[float, float] | None = None  # u, v, px, end of the leader line; None = the name is on its object


def place_labels(ids: Int32, names: Mapping[int, str], size: Callable[[str], tuple[float, float]]) -> list[Label]:
    """Return the labels of the objects in an image, largest object first.

    Labels do not overlap. Names that do not fit are omitted.

    Args:
        ids: The object (H, W) at each pixel, 0 = none.
        names: The name of each object by id.
        size: A function that returns the width and height of a text, px.
    """
    names = {key: plain_line(name) for key, name in names.items()}
    pixels = np.bincount(ids.ravel(), minlength=max([0, *names]) + 1)
    shown = sorted((key for key in names if pixels[key] >= MIN_PIXELS), key=lambda key: (-pixels[key], key))
    widest = {key: _widest_part(ids == key) for key in shown}
    objects = np.isin(ids, shown)
    boxes: list[Box] = []
    labels: dict[int, Label] = {}
    for key in shown:
        u, v, room = widest[key]
        width, height = size(names[key])
        box = _box(u, v, width, height)
        if room < ROOM * height or not _is_free(box, boxes, ids.shape):
            continue
        if (objects & (ids != key))[_pixels(box)].mean() <= ON_OTHERS:
            boxes.append(box)
            labels[key] = Label(names[key], u, v)
    for key in shown:
        if key not in labels:
            u, v, _ = widest[key]
            if place := _place_next_to(u, v, size(names[key]), boxes, objects, objects & (ids != key)):
                boxes.append(_box(*place, *size(names[key])))
                labels[key] = Label(names[key], *place, (u, v))
    return [labels[key] for key in shown if key in labels]


def draw_labels(image: Image.Image, labels: Sequence[Label], font: ImageFont.FreeTypeFont) -> None:
    """Draw the names and their leader lines into `image`."""
    canvas = ImageDraw.Draw(image)
    for label in labels:
        if label.target is not None:
            u, v = label.target
            end = _nearest_point(_box(label.u, label.v, *text_size(label.text, font)), u, v)
            canvas.line([(u, v), end], PAPER, 4)
            canvas.line([(u, v), end], INK, 1)
            canvas.ellipse((u - DOT, v - DOT, u + DOT, v + DOT), INK, PAPER)
    for label in labels:
        canvas.text((label.u, label.v), label.text, INK, font, anchor="mm", stroke_width=HALO, stroke_fill=PAPER)


def text_size(text: str, font: ImageFont.FreeTypeFont) -> tuple[float, float]:
    """Return the width and height of a text, px."""
    left, _, right, _ = font.getbbox(text, anchor="mm")
    return right - left, float(font.size)


def _widest_part(mask: Bool) -> tuple[float, float, float]:
    """Return a point (u, v) far from the border of a mask, and its distance to the border, px.

    Of all points with about the largest distance, the nearest one to the centroid is returned.
    """
    u, v, width, height = cv2.boundingRect(mask.astype(np.uint8))
    framed = np.pad(mask[v : v + height, u : u + width], 1).astype(np.uint8)
    distance = cv2.distanceTransform(framed, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    wide = np.argwhere(distance >= ABOUT * distance.max())
    row, column = wide[np.linalg.norm(wide - np.argwhere(framed).mean(axis=0), axis=1).argmin()]
    return float(u + column - 1), float(v + row - 1), float(distance[row, column])


def _place_next_to(
    u: float, v: float, size: tuple[float, float], boxes: Sequence[Box], objects: Bool, others: Bool
) -> tuple[float, float] | None:
    """Return the best center (u, v) for a name next to its object, px.

    Return None if there is no free position.

    Args:
        u: The column of the point on the object, px.
        v: The row of the point on the object, px.
        size: The width and height of the name, px.
        boxes: The boxes of the names that are already placed.
        objects: A Boolean array (H, W), True on any object.
        others: A Boolean array (H, W), True on other objects.
    """
    best, least = None, np.inf
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    for distance, angle in product(range(NEAREST, FARTHEST, STEP), angles):
        a, b = u + np.cos(angle) * (distance + size[0] / 2), v - np.sin(angle) * distance
        box = _box(a, b, *size)
        if distance >= least or not _is_free(box, boxes, others.shape):
            continue
        line = np.linspace((u, v), _nearest_point(box, u, v), SAMPLES)
        if any(((line >= other[:2]) & (line <= other[2:])).all(axis=1).any() for other in boxes):
            continue
        columns, rows = np.rint(line).astype(int).T
        # prefer short lines, and names and lines that are not over objects
        cost = distance + COVERING * objects[_pixels(box)].mean() + CROSSING * others[rows, columns].mean()
        if cost < least:
            best, least = (a, b), cost
    return best


def _box(u: float, v: float, width: float, height: float) -> Box:
    return (u - width / 2 - AROUND, v - height / 2 - AROUND, u + width / 2 + AROUND, v + height / 2 + AROUND)


def _pixels(box: Box) -> tuple[slice, slice]:
    left, top, right, bottom = (round(edge) for edge in box)
    return slice(top, bottom), slice(left, right)


def _is_free(box: Box, taken: Sequence[Box], shape: tuple[int, ...]) -> bool:
    left, top, right, bottom = box
    inside = left >= 0 and top >= 0 and right <= shape[1] - 1 and bottom <= shape[0] - 1
    return inside and not any(left < o[2] and o[0] < right and top < o[3] and o[1] < bottom for o in taken)


def _nearest_point(box: Box, u: float, v: float) -> tuple[float, float]:
    """Return the point of a box that is nearest to (u, v), px."""
    return min(max(u, box[0]), box[2]), min(max(v, box[1]), box[3])
