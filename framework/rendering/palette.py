"""Colors for instances and classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

import cv2
import numpy as np

from framework.data import Float64, UInt8

PAPER, INK, FAINT_INK = (250, 250, 248), (32, 36, 42), (120, 126, 134)  # RGB of the background and of texts

NEAR_M = 0.8  # distance within which objects get dissimilar colors (scale of an exponential decay)
ALIKE = 22.0  # CIE76 color difference below which colors are similar (scale of an exponential decay)
HUES = 18  # number of hues
CLEAR = ((165, 245), (105, 250), (190, 200))  # saturation and value of each shade, 0 to 255
DARK = ((130, 95), (60, 125))  # saturation and value of darker shades, disjoint from CLEAR


def candidates(shades: Sequence[tuple[int, int]] = CLEAR) -> UInt8:
    """Return the colors (K, 3), RGB, of all hues in the given shades.

    A shade is a saturation and a value in [0, 255].
    """
    hues = np.arange(HUES) * (180 // HUES)
    hsv = np.array([(hue, *shade) for shade in shades for hue in hues], np.uint8)
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0], np.uint8)


def instance_colors(centroids: Float64, shades: Sequence[tuple[int, int]] = CLEAR) -> UInt8:
    """Return dissimilar colors (N, 3), RGB, for nearby objects.

    Each object gets the color that is least similar to the colors of nearby objects before it.

    Args:
        centroids: The centroids (N, 3) of the objects, m.
        shades: The shades of the candidate colors; see `candidates`.
    """
    rgb = candidates(shades)
    lab = cv2.cvtColor(rgb[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    likeness = np.exp(-np.linalg.norm(lab[:, None] - lab[None], axis=2) / ALIKE)  # (K, K)
    nearness = np.exp(-np.linalg.norm(centroids[:, None] - centroids[None], axis=2) / NEAR_M) + 0.02  # (N, N)
    chosen = np.zeros(len(centroids), np.int64)
    for k in range(len(centroids)):
        clash = nearness[k, :k] @ likeness[chosen[:k]] if k else np.zeros(len(rgb))
        chosen[k] = int(np.argmin(clash))
    return np.asarray(rgb[chosen])


def object_colors(centroids: Mapping[int, Float64], likely: Set[int]) -> dict[int, UInt8]:
    """Return the color (3,) of each object by id, RGB.

    Args:
        centroids: The centroid (3,) of each object by id, m.
        likely: The ids of likely objects. They are colored first, so that they have the same colors as in overview.png.
    """
    ordered = sorted(centroids, key=lambda key: (key not in likely, key))
    positions = np.array([centroids[key] for key in ordered], np.float64).reshape(-1, 3)
    return dict(zip(ordered, instance_colors(positions), strict=True))


def class_colors(objects: Sequence[tuple[str, float]]) -> dict[str, UInt8]:
    """Return the color (3,) of each class by name, RGB.

    The classes of the most confident objects get the most dissimilar colors.

    Args:
        objects: The class name and confidence of each object.
    """
    most: dict[str, float] = {}
    for name, confidence in objects:
        most[name] = max(confidence, most.get(name, 0.0))
    names = sorted(most, key=lambda name: (-most[name], name))
    # with equal positions, all classes count as nearby and get dissimilar colors
    return dict(zip(names, instance_colors(np.zeros((len(names), 3))), strict=True))
