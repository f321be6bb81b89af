"""Random augmentation of training images."""

from __future__ import annotations

import cv2
import numpy as np

from framework.data import UInt8
from framework.training.room_pictures import Example

ZOOM = (0.55, 1.0)  # range of the ratio of a crop's side to the image's side
ZOOMED = 0.5  # fraction of zoomed images
MIN_REMAINING = 0.25  # minimum fraction of an object's area inside the crop
MIN_PIXELS = 40  # px, minimum area of an object
GAIN, CHANNEL_GAIN = 0.35, 0.12  # logarithms of the maximum brightness factors of the image and of each channel
GAMMA = 0.35  # logarithm of the maximum gamma exponent
BLURRED, NOISY, GRAY = 0.3, 0.3, 0.05  # fractions of blurred, noisy and gray images


def augmented(example: Example, rng: np.random.Generator) -> Example:
    """Apply random mirroring, zoom, color changes, blur and noise to a training image.

    Small objects and mostly cropped objects are removed.
    """
    color, masks = example.color, example.masks
    if rng.uniform() < 0.5:
        color, masks = color[:, ::-1], masks[:, :, ::-1]
    areas = masks.sum(axis=(1, 2)).astype(np.float64)
    if rng.uniform() < ZOOMED:
        color, masks, scale = _zoomed(color, masks, rng)
        areas = areas * scale
    left = masks.sum(axis=(1, 2))
    kept = (left >= MIN_PIXELS) & (left >= MIN_REMAINING * areas)
    names = tuple(name for name, keep in zip(example.class_names, kept.tolist(), strict=True) if keep)
    return Example(_relit(color, rng), np.ascontiguousarray(masks[kept]), names)


def _zoomed(color: UInt8, masks: np.ndarray, rng: np.random.Generator) -> tuple[UInt8, np.ndarray, float]:
    """Crop an image and its masks at random and resize them to the original size.

    The third result is the scale factor of areas.
    """
    height, width = color.shape[:2]
    fraction = rng.uniform(*ZOOM)
    h, w = round(fraction * height), round(fraction * width)
    v, u = int(rng.integers(height - h + 1)), int(rng.integers(width - w + 1))
    cut = cv2.resize(color[v : v + h, u : u + w], (width, height), interpolation=cv2.INTER_LINEAR)
    rows = v + ((np.arange(height) + 0.5) * h / height).astype(np.int64)
    columns = u + ((np.arange(width) + 0.5) * w / width).astype(np.int64)
    return np.asarray(cut, np.uint8), masks[:, rows[:, None], columns], (height * width) / (h * w)


def _relit(color: UInt8, rng: np.random.Generator) -> UInt8:
    levels = np.arange(256, dtype=np.float32) / 255
    gains = np.exp(rng.uniform(-GAIN, GAIN) + rng.uniform(-CHANNEL_GAIN, CHANNEL_GAIN, 3))
    gamma = np.exp(rng.uniform(-GAMMA, GAMMA))
    table = np.clip(255 * gains[:, None] * levels[None] ** gamma, 0, 255).astype(np.uint8)
    color = np.stack([cv2.LUT(np.ascontiguousarray(color[..., c]), table[c]) for c in range(3)], axis=-1)
    if rng.uniform() < GRAY:
        color = np.repeat(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=-1)
    if rng.uniform() < BLURRED:
        color = np.asarray(cv2.GaussianBlur(color, (0, 0), rng.uniform(0.3, 1.2)), np.uint8)
    if rng.uniform() < NOISY:
        grain = rng.standard_normal(color.shape, np.float32) * np.float32(rng.uniform(1, 8))
        color = np.asarray(np.clip(color + grain, 0, 255), np.uint8)
    return color
