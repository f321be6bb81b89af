"""What the colours of an exported mesh say, and how formats have them."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from framework.data import Float32, UInt8
from framework.exporting.object_meshes import Part

GREY = (176, 176, 172)  # of what is no object, where colours tell objects or classes


class Coloring(Enum):
    """What vertices are coloured by."""

    APPEARANCE = "appearance"  # as the camera saw them
    INSTANCE = "instance"
    CLASS = "class"


def part_colors(parts: Sequence[Part], coloring: Coloring) -> list[UInt8]:
    """For each part the colours (V, 3) of its vertices, sRGB."""
    if coloring is Coloring.APPEARANCE:
        return [part.mesh.colors for part in parts]
    grey = np.array(GREY, np.uint8)
    found = []
    for part in parts:
        one = part.object
        own = grey if one is None else one.color if coloring is Coloring.INSTANCE else one.class_color
        found.append(np.tile(own, (len(part.mesh.vertices), 1)))
    return found


def linear(colors: UInt8) -> Float32:
    """Colours in [0, 1] in proportion to light, of sRGB ones (IEC 61966-2-1): what glTF and USD mean by a colour."""
    return _LINEAR[colors]


def _decoded() -> Float32:
    encoded = np.arange(256) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _decoded()  # (256,)
