"""Calibration of probabilities: ECE, Brier score, AUROC and reliability.

An instance *exists* if it matches a ground-truth instance of any class at IoU 0.5, as for the class-agnostic AP. Its
*class is right* if it also has the class of that instance; only instances that exist count. Ignored instances do not
count (see framework/evaluation/instances.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float64, Int64
from framework.errors import DataError

BINS = 10  # number of bins of equal width
RESAMPLES = 2000  # number of bootstrap samples, and of simulated outcomes
COVERAGE = 0.95  # coverage of the bootstrap intervals
SEED = 0  # seed of the bootstrap


@dataclass(frozen=True)
class ReliabilityBin:
    """The events with a probability in [low, high); the last bin includes 1."""

    low: float
    high: float
    count: int  # at least 1
    mean_probability: float
    frequency: float  # fraction of events that occurred


@dataclass(frozen=True)
class Forecasts:
    """The predicted probabilities of N binary events, and their outcomes."""

    probabilities: Float64  # (N,) in [0, 1]
    outcomes: Bool  # (N,) True = occurred

    def __post_init__(self) -> None:
        if self.probabilities.shape != self.outcomes.shape or self.probabilities.ndim != 1:
            raise DataError(
                f"Forecasts: expected probabilities and outcomes of equal length, got {self.probabilities.shape} and "
                f"{self.outcomes.shape}"
            )
        if not ((self.probabilities >= 0) & (self.probabilities <= 1)).all():  # rejects NaN
            raise DataError("Forecasts.probabilities: expected values in [0, 1], got others")

    @classmethod
    def of(cls, pairs: Iterable[tuple[float, bool]]) -> Forecasts:
        """Return forecasts for pairs of a probability and an outcome."""
        listed = list(pairs)
        return cls(np.array([p for p, _ in listed], np.float64), np.array([bool(y) for _, y in listed], np.bool_))

    @classmethod
    def joined(cls, parts: Sequence[Forecasts]) -> Forecasts:
        """Return the forecasts of several scenes together."""
        return cls.of(pair for part in parts for pair in zip(part.probabilities, part.outcomes, strict=True))

    def __len__(self) -> int:
        return len(self.probabilities)

    def reliability(self) -> list[ReliabilityBin]:
        """Return the bins that are not empty, in ascending order."""
        number = self._bin_numbers()
        bins = []
        for k in np.unique(number).tolist():
            own = number == k
            mean, frequency = float(self.probabilities[own].mean()), float(self.outcomes[own].mean())
            bins.append(ReliabilityBin(k / BINS, (k + 1) / BINS, int(own.sum()), mean, frequency))
        return bins

    def ece(self) -> float:
        """Return the expected calibration error (Naeini et al. 2015), or NaN without events.

        It is the mean of |mean probability - frequency| over BINS bins of equal width, weighted by their counts. With
        few events, the ECE of correct probabilities is above 0 (see `ece_if_calibrated`).
        """
        if not len(self):
            return math.nan
        gaps = np.bincount(self._bin_numbers(), self.probabilities - self.outcomes, BINS)
        return float(np.abs(gaps).sum() / len(self))

    def ece_if_calibrated(self) -> float:
        """Return the mean ECE of outcomes that are drawn with the predicted probabilities.

        This is the part of the ECE that is due to the number of events.
        """
        rng, numbers = np.random.default_rng(SEED), self._bin_numbers()
        if not len(self):
            return math.nan
        drawn = rng.random((RESAMPLES, len(self))) < self.probabilities
        gaps = np.zeros((RESAMPLES, BINS))
        for k in np.unique(numbers).tolist():
            gaps[:, k] = (self.probabilities - drawn)[:, numbers == k].sum(axis=1)
        return float(np.abs(gaps).sum(axis=1).mean() / len(self))

    def brier(self) -> float:
        """Return the Brier score (Brier 1950): the mean squared error of the probabilities, or NaN without events."""
        return float(np.mean((self.probabilities - self.outcomes) ** 2)) if len(self) else math.nan

    def auroc(self) -> float:
        """Return the area under the ROC curve, with ties as one half. It is NaN if all outcomes are equal."""
        positive, negative = self.probabilities[self.outcomes], self.probabilities[~self.outcomes]
        if not len(positive) or not len(negative):
            return math.nan
        ordered = np.sort(negative)
        below, up_to = np.searchsorted(ordered, positive), np.searchsorted(ordered, positive, side="right")
        return float((below + up_to).mean() / (2 * len(negative)))

    def interval(self, metric: Callable[[Forecasts], float]) -> tuple[float, float]:
        """Return the bootstrap interval of a metric over the events, with the coverage COVERAGE.

        It is the percentile interval. It contains no correction of the bias of the ECE. Samples with an undefined
        metric are omitted.
        """
        return self.paired_interval(self, lambda one, _: metric(one))

    def paired_interval(self, other: Forecasts, metric: Callable[[Forecasts, Forecasts], float]) -> tuple[float, float]:
        """Return the bootstrap interval of a metric of two forecasts of the same events."""
        if len(other) != len(self):
            raise DataError(f"Forecasts: expected {len(self)} events, got {len(other)}")
        rng = np.random.default_rng(SEED)
        samples = (rng.integers(len(self), size=len(self)) for _ in range(RESAMPLES if len(self) else 0))
        values = np.array([metric(self._part(chosen), other._part(chosen)) for chosen in samples])
        values = values[~np.isnan(values)]
        if not len(values):
            return math.nan, math.nan
        low, high = np.quantile(values, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
        return float(low), float(high)

    def _part(self, chosen: Int64) -> Forecasts:
        return Forecasts(self.probabilities[chosen], self.outcomes[chosen])

    def _bin_numbers(self) -> Int64:
        return np.minimum((self.probabilities * BINS).astype(np.int64), BINS - 1)


def calibration_metrics(forecasts: Forecasts, name: str) -> dict[str, float]:
    """Return the metrics of one kind of event by their names in metrics.json, without undefined values.

    Args:
        forecasts: The forecasts.
        name: The kind of event: exists or class.
    """
    metrics = {"ece": forecasts.ece(), "brier": forecasts.brier(), "auroc": forecasts.auroc()}
    found = {f"instances.{key}.{name}": value for key, value in metrics.items() if not math.isnan(value)}
    return found | {f"instances.calibration_count.{name}": len(forecasts)}
