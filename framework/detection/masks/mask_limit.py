"""Limit of the mask pixels of a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Detections

# maximum number of mask pixels of a frame, relative to the pixels of the image; detections of three networks in six
# real scenes have at most 2.8, and a mapped mask pixel takes 24 bytes per copy of the point clusters
MAX_MASK_AREA = 8


def mask_area(detections: Detections) -> float:
    """Return the number of mask pixels of all detections, relative to the pixels of the image."""
    return np.count_nonzero(detections.masks) / max(detections.masks[0].size, 1) if len(detections) else 0.0


def fitting_masks(detections: Detections) -> Detections:
    """Return the detections with the highest scores whose masks have at most MAX_MASK_AREA times the image's pixels.

    A mask that exceeds the remaining area is omitted, and smaller masks with lower scores are kept. Of equal scores,
    the first is preferred.
    """
    if len(detections) <= MAX_MASK_AREA or mask_area(detections) <= MAX_MASK_AREA:
        return detections
    left = MAX_MASK_AREA * detections.masks[0].size
    fits = np.zeros(len(detections), np.bool_)
    for k in np.argsort(-detections.scores, kind="stable"):
        pixels = np.count_nonzero(detections.masks[k])
        fits[k] = pixels <= left
        left -= pixels if fits[k] else 0
    return replace(
        detections,
        masks=detections.masks[fits],
        boxes=detections.boxes[fits],
        scores=detections.scores[fits],
        class_probabilities=detections.class_probabilities[fits],
        embeddings=None if detections.embeddings is None else detections.embeddings[fits],
    )
