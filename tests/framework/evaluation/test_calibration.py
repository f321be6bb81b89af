"""Tests for calibration metrics, compared with manual results."""

from __future__ import annotations

import math

import numpy as np
import pytest

from framework.errors import DataError
from framework.evaluation.calibration import Forecasts, calibration_metrics

FOUR = Forecasts.of([(0.05, False), (0.55, True), (0.55, False), (1.0, True)])


def test_ece_of_four_events_matches_manual_result():
    """The bins have 1, 2 and 1 events, and the gaps 0.05, 0.05 and 0."""
    assert FOUR.ece() == pytest.approx((1 * 0.05 + 2 * 0.05 + 1 * 0.0) / 4)


def test_reliability_lists_occupied_bins():
    bins = FOUR.reliability()
    assert [(one.low, one.high, one.count) for one in bins] == [(0.0, 0.1, 1), (0.5, 0.6, 2), (0.9, 1.0, 1)]
    assert [one.frequency for one in bins] == [0.0, 0.5, 1.0]
    assert [one.mean_probability for one in bins] == pytest.approx([0.05, 0.55, 1.0])


def test_brier_of_four_events_matches_manual_result():
    assert FOUR.brier() == pytest.approx((0.05**2 + 0.45**2 + 0.55**2 + 0.0) / 4)


def test_auroc_counts_ties_as_half():
    """Of the four pairs of an occurred and another event, three are in order and one is a tie."""
    assert FOUR.auroc() == 3.5 / 4
    assert math.isnan(Forecasts.of([(0.3, True), (0.4, True)]).auroc())


def test_forecasts_without_events_are_undefined():
    empty = Forecasts.of([])
    assert all(math.isnan(value) for value in (empty.ece(), empty.brier(), empty.auroc(), empty.ece_if_calibrated()))
    assert all(map(math.isnan, empty.interval(Forecasts.ece)))
    assert calibration_metrics(empty, "class") == {"instances.calibration_count.class": 0}


def test_ece_if_calibrated_matches_one_event():
    """One event with the probability p has the ECE 1 - p with the probability p, and p otherwise."""
    assert Forecasts.of([(0.3, True)]).ece_if_calibrated() == pytest.approx(2 * 0.3 * 0.7, abs=0.02)


def test_ece_of_calibrated_events_is_small():
    rng = np.random.default_rng(1)
    probabilities = rng.random(20_000)
    forecasts = Forecasts(probabilities, rng.random(20_000) < probabilities)
    assert forecasts.ece() < 0.015
    assert Forecasts(probabilities**2, forecasts.outcomes).ece() > 0.1


def test_bootstrap_interval_contains_the_metric():
    rng = np.random.default_rng(2)
    probabilities = rng.random(200)
    forecasts = Forecasts(probabilities, rng.random(200) < probabilities)
    low, high = forecasts.interval(Forecasts.brier)
    assert low < forecasts.brier() < high
    assert high - low < 0.1
    low, high = forecasts.paired_interval(forecasts, lambda a, b: a.brier() - b.brier())
    assert low == high == 0.0


def test_joined_forecasts_keep_all_events():
    both = Forecasts.joined([FOUR, Forecasts.of([(0.2, True)])])
    assert len(both) == 5
    assert both.probabilities.tolist() == [0.05, 0.55, 0.55, 1.0, 0.2]


def test_forecasts_outside_unit_interval_raise():
    with pytest.raises(DataError, match=r"Forecasts.probabilities: expected values in \[0, 1\]"):
        Forecasts.of([(1.1, True)])
    with pytest.raises(DataError, match="Forecasts: expected probabilities and outcomes of equal length"):
        Forecasts(np.zeros(2), np.zeros(3, bool))
