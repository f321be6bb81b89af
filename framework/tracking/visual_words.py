"""Bags of visual words: which images are likely to show the same place, before any feature is matched.

A feature's word is the signs of its descriptor's scalar products with a few random vectors (locality sensitive hashing,
Charikar 2002), so that there is no vocabulary to be trained. Images are compared by tf-idf (Sivic and Zisserman 2003).
"""

from __future__ import annotations

import cv2
import numpy as np

from framework.data import Float32, UInt8
from framework.tracking.features import DESCRIPTOR_LENGTH

BITS = 12  # 4096 words: with fewer, words are too common to tell places apart; with more, too rare to be met again


class VisualWords:
    """A fixed vocabulary, drawn with `seed`."""

    def __init__(self, seed: int) -> None:
        # as many +1 as -1, so that every vector is orthogonal to the mean descriptor, and sums of bytes are exact
        half = np.repeat(np.array([1, -1], np.float32), DESCRIPTOR_LENGTH // 2)
        rng = np.random.default_rng([seed, BITS])
        self._directions = np.ascontiguousarray(rng.permuted(np.tile(half, (BITS, 1)), axis=1).T)
        self._place = 1 << np.arange(BITS)

    def bag(self, descriptors: UInt8) -> Float32:
        """How often each word occurs, (2^BITS,), damped by a square root."""
        if len(descriptors) == 0:
            return np.zeros(1 << BITS, np.float32)
        words = (cv2.gemm(descriptors.astype(np.float32), self._directions, 1, None, 0) > 0) @ self._place
        return np.sqrt(np.bincount(words, minlength=1 << BITS)).astype(np.float32)


def similarity(bag: Float32, bags: Float32) -> Float32:
    """How similar one image's bag of words is to those of K others (K, 2^BITS): (K,) in [0, 1]."""
    shown_in = np.count_nonzero(bags, axis=0)
    idf = np.log((1 + len(bags)) / (1 + shown_in)).astype(np.float32)
    if not idf.any():
        idf[:] = 1  # of one or two images every word may be in all
    weighted, query = bags * idf, bag * idf
    norms = np.linalg.norm(weighted, axis=1) * np.linalg.norm(query)
    return np.asarray((weighted * query).sum(axis=1) / np.maximum(norms, 1e-9), np.float32)
