"""Tests for means over sequences and seeds."""

from __future__ import annotations

import math

import pytest

from framework.runs.run_rows import Run
from framework.tables.comparison import mean_by_sequence, mean_over_sequences

FIGURES: dict[Run, float] = {("0", "a"): 0.2, ("1", "a"): 0.4, ("0", "b"): 0.9, ("1", "b"): 0.7}


def test_mean_by_sequence_is_over_seeds() -> None:
    means = mean_by_sequence(FIGURES)
    assert {sequence: mean.value for sequence, mean in means.items()} == pytest.approx({"a": 0.3, "b": 0.8})
    assert means["a"].deviation == pytest.approx(math.sqrt(2 * 0.1**2))


def test_mean_over_sequences_deviation_is_over_seed_means() -> None:
    """The mean of each seed is 0.55, so the deviation is zero although the sequences differ."""
    mean = mean_over_sequences(FIGURES)
    assert (mean.value, mean.count) == (pytest.approx(0.55), 2)
    assert mean.deviation == pytest.approx(0, abs=1e-12)


def test_mean_over_sequences_weights_sequences_equally() -> None:
    mean = mean_over_sequences({run: value for run, value in FIGURES.items() if run != ("1", "b")})
    assert mean.value == pytest.approx((0.3 + 0.9) / 2)  # the mean over the three runs would be 0.5
    assert math.isnan(mean.deviation)


def test_mean_over_sequences_without_values_is_nan() -> None:
    mean = mean_over_sequences({})
    assert (mean.count, math.isnan(mean.value), math.isnan(mean.deviation)) == (0, True, True)
