"""Distributions over classes where a detector tells only the best label and its score."""

from __future__ import annotations

import numpy as np

from framework.data import Float32


def spread_rest(one_hot: Float32, scores: Float32, spread: float) -> Float32:
    """Rows (N, C) of 0 and 1 with what the scores (N,) lack to 1 taken from the label and given evenly to the others.

    The label gets 1 - spread * (1 - score), but not less than its even share. spread in [0, 1]: with 1 the label's
    probability is its score, with 0 the label is certain.
    """
    c = one_hot.shape[1]
    if c == 1:
        return one_hot
    own = np.maximum(1 - spread * (1 - scores.astype(np.float64)), 1 / c)[:, None]
    return np.asarray(np.where(one_hot > 0, own, (1 - own) / (c - 1)), np.float32)
