"""Tests for the augmentation of images and masks."""

from __future__ import annotations

import numpy as np

from framework.training.augmentation import augmented
from framework.training.room_pictures import Example


def example() -> Example:
    """Return an image with a bright rectangle on a dark background, and the mask of the rectangle."""
    mask = np.zeros((1, 60, 80), np.bool_)
    mask[0, 20:45, 10:40] = True
    return Example(np.where(mask[0][..., None], 200, 10).astype(np.uint8).repeat(3, axis=-1), mask, ("chair",))


def test_augmented_masks_match_image() -> None:
    for seed in range(40):
        changed = augmented(example(), np.random.default_rng(seed))
        assert changed.color.shape == (60, 80, 3)
        assert changed.color.dtype == np.uint8
        for mask in changed.masks:
            bright = changed.color.astype(float).mean(axis=-1)
            middle = (bright[mask].mean() + bright[~mask].mean()) / 2 if (~mask).any() else 0
            assert ((bright > middle) == mask).mean() > 0.95, seed


def test_augmentation_is_deterministic_for_given_seed() -> None:
    a, b = (augmented(example(), np.random.default_rng(7)) for _ in range(2))
    assert np.array_equal(a.color, b.color)
    assert np.array_equal(a.masks, b.masks)


def test_augmentation_drops_objects_with_few_pixels() -> None:
    few = Example(example().color, np.eye(60, 80, dtype=np.bool_)[None] & (np.arange(80) < 5), ("chair",))
    assert len(augmented(few, np.random.default_rng(0)).masks) == 0
