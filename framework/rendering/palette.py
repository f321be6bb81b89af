"""The colours of pictures; those of instances are far apart from each other where the objects are near."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from framework.data import Float64, UInt8

PAPER, INK, FAINT_INK = (250, 250, 248), (32, 36, 42), (120, 126, 134)

NEAR_M = 0.8  # objects within about this distance are seen together, so their colours matter most to each other
ALIKE = 22.0  # CIE76 colour difference within which two colours are taken for each other
HUES = 18
CLEAR = ((165, 245), (105, 250), (190, 200))  # saturation and value: three degrees of lightness
DARK = ((130, 95), (60, 125))  # none of the clear colours is among these


def candidates(shades: Sequence[tuple[int, int]] = CLEAR) -> UInt8:
    """(K, 3) RGB: all hues in each of the shades."""
    hues = np.arange(HUES) * (180 // HUES)
    hsv = np.array([(hue, *shade) for shade in shades for hue in hues], np.uint8)
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0], np.uint8)


def instance_colors(centroids: Float64, shades: Sequence[tuple[int, int]] = CLEAR) -> UInt8:
    """(N, 3) RGB for objects at centroids (N, 3) m: each takes the colour least like those near to it, in order."""
    rgb = candidates(shades)
    lab = cv2.cvtColor(rgb[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    likeness = np.exp(-np.linalg.norm(lab[:, None] - lab[None], axis=2) / ALIKE)  # (K, K)
    nearness = np.exp(-np.linalg.norm(centroids[:, None] - centroids[None], axis=2) / NEAR_M) + 0.02  # (N, N)
    chosen = np.zeros(len(centroids), np.int64)
    for k in range(len(centroids)):
        clash = nearness[k, :k] @ likeness[chosen[:k]] if k else np.zeros(len(rgb))
        chosen[k] = int(np.argmin(clash))
    return np.asarray(rgb[chosen])
