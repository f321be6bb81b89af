"""What the colours of an exported mesh say, and how formats have them."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from framework.data import Float32, UInt8
from framework.exporting.object_meshes import Part
from framework.rendering.palette import instance_colors

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
    objects = [part.object for part in parts if part.object is not None]
    if coloring is Coloring.INSTANCE:
        centers = np.array([one.box.center for one in objects]).reshape(-1, 3)
        chosen = {one.id: color for one, color in zip(objects, instance_colors(centers), strict=True)}
    else:
        names = sorted({one.class_name for one in objects})
        # all in one place: each is to differ from all others
        of_class = dict(zip(names, instance_colors(np.zeros((len(names), 3))), strict=True))
        chosen = {one.id: of_class[one.class_name] for one in objects}
    grey = np.array(GREY, np.uint8)
    return [
        np.tile(grey if part.object is None else chosen[part.object.id], (len(part.mesh.vertices), 1)) for part in parts
    ]


def linear(colors: UInt8) -> Float32:
    """Colours in [0, 1] in proportion to light, of sRGB ones (IEC 61966-2-1): what glTF and USD mean by a colour."""
    return _LINEAR[colors]


def _decoded() -> Float32:
    encoded = np.arange(256) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _decoded()  # (256,)
