"""Color names: the basic color terms of English (Berlin and Kay 1969), and beige."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from framework.data import Float32, Int32

_SAMPLES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "black": ((20, 20, 20), (42, 40, 39)),
    "gray": ((85, 85, 85), (128, 128, 128), (170, 170, 170)),
    "white": ((245, 245, 243), (225, 222, 215)),
    "red": ((205, 30, 35), (140, 58, 56), (105, 25, 25)),
    "orange": ((235, 120, 30), (188, 104, 55)),
    "yellow": ((238, 208, 50), (192, 154, 72)),
    "green": ((45, 140, 60), (76, 115, 92), (125, 165, 80), (30, 72, 40)),
    "blue": ((40, 80, 195), (51, 84, 128), (66, 128, 145), (125, 170, 215), (25, 35, 85)),
    "purple": ((110, 45, 150), (87, 71, 112), (150, 110, 185)),
    "pink": ((235, 130, 170), (160, 107, 128), (232, 182, 190)),
    "brown": ((110, 70, 40), (142, 94, 58), (158, 84, 48), (94, 66, 51), (60, 38, 24), (183, 140, 96)),
    "beige": ((216, 196, 160), (204, 189, 163), (220, 186, 138)),
}  # samples of each name in sRGB, 0..255: saturated, muted and dark colors

COLOR_NAMES = tuple(_SAMPLES)
CONFUSED = 12.0  # CIELAB, standard deviation of the score; closer names are easily confused under changing light
OTHER_SPELLINGS = {"grey": "gray", "violet": "purple", "turquoise": "blue", "teal": "blue", "navy": "blue"}


def lab(srgb: Float32) -> Float32:
    """Convert sRGB colors (N, 3) in [0, 1] to CIELAB (N, 3)."""
    return np.asarray(cv2.cvtColor(srgb.reshape(1, -1, 3).astype(np.float32), cv2.COLOR_RGB2LAB)[0], np.float32)


def nearest_names(srgb: Float32) -> Int32:
    """Return the index (N,) of the nearest color name for each sRGB color (N, 3) in [0, 1]."""
    distances = np.linalg.norm(lab(srgb)[:, None] - _samples_lab()[None], axis=2)
    return np.asarray(_NAME_OF_SAMPLE[distances.argmin(axis=1)], np.int32)


def fits(srgb: Float32, name: str) -> Float32:
    """Rate how well a color name describes each sRGB color (N, 3) in [0, 1].

    The scores (N,) are in [0, 1]. The score is 1 if the name is the nearest name.
    """
    distances = np.linalg.norm(lab(srgb)[:, None] - _samples_lab()[None], axis=2)
    # distance to this name minus the distance to the nearest name, in CIELAB
    additional = distances[:, COLOR_NAMES.index(name) == _NAME_OF_SAMPLE].min(axis=1) - distances.min(axis=1)
    return np.asarray(np.exp(-0.5 * (additional / CONFUSED) ** 2), np.float32)


@cache
def _samples_lab() -> Float32:
    """Return the CIELAB colors (S, 3) of all samples."""
    # computed on demand, because the first conversion in OpenCV is slow
    samples = [sample for samples in _SAMPLES.values() for sample in samples]
    return lab(np.array(samples, np.float32) / np.float32(255))


_NAME_OF_SAMPLE = np.array([k for k, samples in enumerate(_SAMPLES.values()) for _ in samples], np.int32)
