"""Tests for training targets and losses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from framework.detection.masks.boxes import decode
from framework.training.losses import BACKGROUND, IGNORED, box_iou, encode, mask_targets, match, sample


def boxes(*rows: tuple[float, float, float, float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float32).reshape(-1, 4)


def test_box_iou_matches_manual_result() -> None:
    iou = box_iou(boxes((0, 0, 10, 10)), boxes((0, 0, 10, 5), (5, 0, 15, 10), (20, 20, 30, 30)))
    assert iou.tolist() == [[pytest.approx(0.5), pytest.approx(1 / 3), 0.0]]


def test_anchor_match_assigns_object_background_or_ignored() -> None:
    iou = torch.tensor([[0.8, 0.1], [0.5, 0.2], [0.1, 0.2], [0.75, 0.9]])
    assert match(iou, 0.7, 0.3, each_object=False).tolist() == [0, IGNORED, BACKGROUND, 1]


def test_anchor_match_each_object_assigns_best_box() -> None:
    iou = torch.tensor([[0.2, 0.0], [0.1, 0.0], [0.0, 0.0]])
    assert match(iou, 0.7, 0.3, each_object=True).tolist() == [0, BACKGROUND, BACKGROUND], (
        "expected no box for an object without overlap"
    )


def test_anchor_match_without_objects_is_background() -> None:
    assert match(torch.zeros(3, 0), 0.7, 0.3, each_object=True).tolist() == [BACKGROUND] * 3


def test_anchor_sample_is_seeded_and_keeps_fractions() -> None:
    own = torch.tensor([0] * 50 + [BACKGROUND] * 50 + [IGNORED] * 50)
    positive, negative = sample(own, 40, 0.25, torch.Generator().manual_seed(1))
    again, _ = sample(own, 40, 0.25, torch.Generator().manual_seed(1))
    assert (own[positive] == 0).all()
    assert (own[negative] == BACKGROUND).all()
    assert (len(positive), len(negative)) == (10, 30)
    assert torch.equal(positive, again)
    assert len(torch.unique(negative)) == 30


def test_box_encode_is_inverse_of_decode() -> None:
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 50, (2, 20, 2))
    a, b = (np.concatenate([p, p + rng.uniform(5, 60, (20, 2))], axis=1).astype(np.float32) for p in low)
    deltas = encode(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    assert np.allclose(decode(a, deltas, extent=0.0), b, atol=1e-3)


def test_mask_targets_are_cropped_to_box() -> None:
    masks = torch.zeros(2, 40, 40, dtype=torch.bool)
    masks[0, 10:20, 10:15] = True  # the left half of a box of 10 by 10 px
    masks[1, 0:40, 0:40] = True
    targets = mask_targets(masks, boxes((10, 10, 20, 20), (5, 5, 30, 30)), torch.tensor([0, 1]), 10)
    assert targets[0, :, :5].all()
    assert not targets[0, :, 5:].any()
    assert targets[1].all()
