"""Tests for COCO run lengths, compared with pycocotools. pycocotools misreads some invalid strings."""

from __future__ import annotations

import numpy as np
import pytest
from pycocotools import mask as coco

from framework.detection.masks.run_length import check, decode, encode, pack, unpack
from framework.errors import DataError


def random_masks(seed: int, n: int, shape: tuple[int, int]) -> np.ndarray:
    """Return n random masks of different densities. The first one is empty, and the last one is full."""
    random = np.random.default_rng(seed)
    masks = random.random((n, *shape)) < random.random((n, 1, 1))
    masks[0], masks[-1] = False, True
    return masks


def lengths_of(mask: np.ndarray) -> list[int]:
    """Return the run lengths in column-major order, computed pixel by pixel. The first run is of zeros."""
    lengths, value = [0], False
    for pixel in mask.T.ravel().tolist():
        if pixel != value:
            lengths.append(0)
            value = pixel
        lengths[-1] += 1
    return lengths


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (48, 64)])
def test_run_length_round_trip_matches_pycocotools(shape: tuple[int, int]) -> None:
    masks = random_masks(1, 6, shape)
    packed = encode(masks)
    for mask, counts in zip(masks, packed, strict=True):
        assert counts == coco.encode(np.asfortranarray(mask.view(np.uint8)))["counts"]
        assert unpack(counts).tolist() == lengths_of(mask)
        assert pack(lengths_of(mask), shape) == counts
        check(counts, shape)
    found = decode(packed, shape)
    assert found.dtype == np.bool_
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, masks)


def test_run_length_unpack_reads_long_runs() -> None:
    """Long runs are encoded as several characters, and relative to a previous run, which may be longer."""
    mask = np.zeros((480, 640), np.bool_)
    mask[100:400, 3], mask[5, 4:600], mask[200:, 630] = True, True, True
    assert unpack(encode(mask[None])[0]).tolist() == lengths_of(mask)


def test_run_length_without_masks_is_empty() -> None:
    assert encode(np.zeros((0, 4, 6), np.bool_)) == []
    assert decode([], (4, 6)).shape == (0, 4, 6)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        (b"", "packed string"),
        (b"1", "got 1 px"),
        (b"!!", "packed string"),
        (b"04o", "packed string"),  # the string ends in the middle of a number
        (b"0" + b"o" * 30 + b"0", "run lengths: expected at most 7 characters per number, got 31 characters"),
        (b"O8I", "negative"),
    ],
)
def test_run_length_malformed_string_raises(counts: bytes, message: str) -> None:
    with pytest.raises(DataError, match=message) as raised:
        check(counts, (4, 4))
    assert "\n" not in str(raised.value)


def test_run_length_of_other_image_size_raises() -> None:
    counts = encode(np.ones((1, 4, 6), np.bool_))[0]
    check(counts, (6, 4))  # the number of pixels is the same, so only the stored size can differ
    with pytest.raises(DataError, match="run lengths: expected 5x4 = 20 px, got 24 px"):
        check(counts, (4, 5))


@pytest.mark.parametrize("lengths", [[3, 4], [20, -4], [1.0, 15], [True, 15], []])
def test_run_length_invalid_list_raises(lengths: list[int]) -> None:
    with pytest.raises(DataError, match="run lengths"):
        pack(lengths, (4, 4))
