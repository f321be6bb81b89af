"""What colour the things of a room have, as people would say: by their materials, whatever the light."""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Int32
from framework.synthetic.textures import PAINTING, SCREEN, SKY
from framework.vocabulary.color_names import COLOR_NAMES, nearest_names

NO_NAME = -1
"""Of a material that is a picture: it has all colours."""

ONE_COLOR = 0.5  # share of an object's pixels from which their colour is the object's


def color_of_materials(table: Float32) -> Int32:
    """For each row of a material table (M, 14) the index in COLOR_NAMES of what it is, or NO_NAME.

    A material is named by the mean of its two colours in linear light: that is what it looks like from afar.
    """
    linear = (table[:, 1:4] + table[:, 4:7]) / 2
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)
    names = nearest_names(np.clip(srgb, 0, 1).astype(np.float32))
    return np.where(np.isin(table[:, 0], (PAINTING, SCREEN, SKY)), np.int32(NO_NAME), names)


def color_counts(color_of_pixel: Int32, ids: Int32, instance: int) -> Int32:
    """How many pixels of an instance have each colour of COLOR_NAMES, then how many have none: (C + 1,).

    color_of_pixel (H, W) as of color_of_materials, ids (H, W).
    """
    counts = np.bincount(color_of_pixel[ids == instance] + 1, minlength=len(COLOR_NAMES) + 1)
    return np.roll(counts, -1).astype(np.int32)


def one_color(counts: Int32) -> int:
    """The index in COLOR_NAMES of the colour that most of an object's pixels have; NO_NAME where it is several."""
    best = int(counts[:-1].argmax())
    return best if counts[best] >= ONE_COLOR * max(1, int(counts.sum())) else NO_NAME
