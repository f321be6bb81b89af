"""Tests for the limit of mask pixels."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Detections
from framework.detection.masks.mask_limit import MAX_MASK_AREA, fitting_masks, mask_area

SHAPE = (6, 10)


def detections(masks: Bool, scores: list[float]) -> Detections:
    n = len(masks)
    probabilities = np.ones((n, 1), np.float32)
    embeddings = np.eye(n, dtype=np.float32)
    return Detections(
        masks, np.arange(4 * n, dtype=np.float32).reshape(n, 4), np.array(scores, np.float32), probabilities, ("a",),
        embeddings=embeddings, embedding_space="test@1",
    )  # fmt: skip


def test_fitting_masks_keeps_detections_within_limit() -> None:
    full = detections(np.ones((MAX_MASK_AREA, *SHAPE), np.bool_), MAX_MASK_AREA * [0.5])
    assert fitting_masks(full) is full
    many_small = np.zeros((1000, *SHAPE), np.bool_)
    many_small[:, 0, 0] = True
    small = detections(many_small[:480], 480 * [0.5])
    assert mask_area(small) == MAX_MASK_AREA
    assert fitting_masks(small) is small
    assert len(fitting_masks(Detections.none(SHAPE, ("a",)))) == 0


def test_fitting_masks_keeps_highest_scores_that_fit() -> None:
    n = MAX_MASK_AREA + 3
    masks = np.ones((n, *SHAPE), np.bool_)
    masks[0, 0, :5] = False  # 5 px smaller, and least likely
    masks[-1] = False
    masks[-1, 0, :5] = True  # 5 px
    found = fitting_masks(detections(masks, [0.1, *np.linspace(0.3, 0.9, n - 2), 0.1]))
    assert found.boxes[:, 0].tolist() == [4.0 * k for k in range(n - 1 - MAX_MASK_AREA, n - 1)]
    masks[-2, 1, :5] = False
    found = fitting_masks(detections(masks, [0.1, *np.linspace(0.3, 0.9, n - 2), 0.1]))
    assert found.boxes[:, 0].tolist() == [4.0 * k for k in range(n - 1 - MAX_MASK_AREA, n)]
    assert mask_area(found) == MAX_MASK_AREA
    assert found.embeddings is not None
    assert found.embeddings.argmax(axis=1).tolist() == [int(x) // 4 for x in found.boxes[:, 0]]


def test_fitting_masks_ties_keep_first_masks() -> None:
    n = 2 * MAX_MASK_AREA
    found = fitting_masks(detections(np.ones((n, *SHAPE), np.bool_), n * [0.5]))
    assert found.boxes[:, 0].tolist() == [4.0 * k for k in range(MAX_MASK_AREA)]
