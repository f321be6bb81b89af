"""Statistics of paired differences between two rows of a table.

The statistics are over independent units, such as scenes. The runs of a unit, such as its seeds, are averaged first,
because they are not independent. Holm's correction covers the comparisons of one metric.
"""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from framework.data import Float64
from framework.runs.run_rows import CONFIDENCE, Run
from framework.tables.grid import TextTable, decimals, figure

ALPHA = 1 - CONFIDENCE  # significance level of the tests
POWER = 0.8  # probability of p < ALPHA for `units_needed`
RESAMPLES = 9999  # number of bootstrap samples
SEED = 0  # seed of the bootstrap
MIN_TESTED = 3  # minimum number of units of a test; the deviation of two units is too uncertain
MIN_UNITS = 6  # minimum number of units of a bootstrap interval; also needed for p < 0.05 by Wilcoxon (2 / 2^6)
FEW_UNITS = 10  # with fewer units, bootstrap intervals contain the true mean in less than about 90% of the cases
MAX_UNITS = 1_000_000  # maximum of `units_needed`
MAX_EFFECT = 20.0  # limit of the effect; two units suffice here, and SciPy returns NaN for extreme effects
EQUAL = 1e-9  # maximum relative deviation of differences that are equal except for rounding


class PairedValues(NamedTuple):
    """The mean values of a row and its base row in one unit, such as a scene."""

    value: float
    base: float

    @property
    def difference(self) -> float:
        return self.value - self.base


Pairs = Mapping[Run, PairedValues]
"""Values of two rows in one metric, by unit. A unit is identified by the values of the unit keys."""

Key = tuple[str, str]
"""Row and metric of a comparison."""


@dataclass(frozen=True)
class PairedStatistics:
    """Statistics of the differences between two rows in one metric.

    Undefined values are NaN. For fewer than MIN_TESTED units or equal differences, only `units` and `mean` are defined.
    """

    units: int  # number of units with values of both rows
    mean: float  # mean difference over the units, first row minus second row
    interval: tuple[float, float] = (math.nan, math.nan)  # bootstrap interval of the mean; requires MIN_UNITS units
    t_p: float = math.nan  # two-sided p of the paired t-test
    wilcoxon_p: float = math.nan  # two-sided p of Wilcoxon's signed-rank test
    units_needed: float = math.nan  # number of units for POWER; infinite = more than MAX_UNITS
    t_holm: float = math.nan  # t_p with Holm's correction
    wilcoxon_holm: float = math.nan  # wilcoxon_p with Holm's correction

    @classmethod
    def of(cls, pairs: Pairs) -> PairedStatistics:
        """Return the statistics of one comparison, without Holm's correction."""
        # sorted, so that the bootstrap does not depend on the order of the units
        differences = np.sort([pair.difference for pair in pairs.values()])
        mean = float(differences.mean()) if len(differences) else math.nan
        scale = max((abs(value) for pair in pairs.values() for value in pair), default=0.0)
        if len(differences) < MIN_TESTED or (deviation := float(differences.std(ddof=1))) <= EQUAL * scale:
            return cls(len(differences), mean)
        from scipy.stats import ttest_1samp, wilcoxon

        return cls(
            len(differences),
            mean,
            interval=bootstrap_interval(differences),
            t_p=float(ttest_1samp(differences, 0.0).pvalue),
            wilcoxon_p=float(wilcoxon(differences).pvalue),
            units_needed=units_needed(mean / deviation),
        )

    @property
    def tested(self) -> bool:
        """True if the tests are defined."""
        return not math.isnan(self.t_p)

    @property
    def is_significant(self) -> bool:
        """True if the paired t-test with Holm's correction rejects a mean difference of 0."""
        return self.t_holm < ALPHA


@dataclass(frozen=True)
class TableStatistics:
    """Statistics of all comparisons of a table."""

    results: Mapping[Key, PairedStatistics]
    unit_keys: Sequence[str]  # config keys of the independent units, such as dataset.scene

    @classmethod
    def of(cls, comparisons: Mapping[Key, Pairs], unit_keys: Sequence[str]) -> TableStatistics:
        """Return the statistics of all comparisons, with Holm's correction for each metric."""
        results = {key: PairedStatistics.of(pairs) for key, pairs in comparisons.items()}
        for metric in {metric for _, metric in results}:
            family = [key for key, result in results.items() if key[1] == metric and result.tested]
            t_holm = holm([results[key].t_p for key in family])
            wilcoxon_holm = holm([results[key].wilcoxon_p for key in family])
            for key, t_p, wilcoxon_p in zip(family, t_holm, wilcoxon_holm, strict=True):
                results[key] = replace(results[key], t_holm=t_p, wilcoxon_holm=wilcoxon_p)
        return cls(results, unit_keys)

    @cached_property
    def tested(self) -> dict[Key, PairedStatistics]:
        """Comparisons with defined tests."""
        return {key: result for key, result in self.results.items() if result.tested}

    @property
    def comparisons(self) -> int:
        """Largest number of tested rows of a metric."""
        metrics = [metric for _, metric in self.tested]
        return max(map(metrics.count, metrics), default=0)

    def grid(self, title: str, rows: Mapping[str, str], heads: Mapping[str, str]) -> TextTable:
        """Return a table with one line per tested comparison, grouped by metric.

        Args:
            title: Heading of the row names, e.g. "minus BASE".
            rows: Display names of the rows, in order.
            heads: Headings of the metrics, in order.
        """
        body: list[list[str]] = []
        groups = set()
        for metric, head in heads.items():
            groups.add(len(body))
            of_metric = {row: self.tested[row, metric] for row in rows if (row, metric) in self.tested}
            digits = decimals(result.mean for result in of_metric.values())
            body += [[head, rows[row], *_cells(result, digits)] for row, result in of_metric.items()]
        columns = ["units", "difference", f"{CONFIDENCE:.0%} interval", "p (t)", "Holm (t)", "p (Wilcoxon)"]
        columns += ["Holm (Wilcoxon)", f"units for {POWER:.0%} power"]
        return TextTable(["metric", title, *columns], body, 2, groups=frozenset(groups - {0, len(body)}))

    def notes(self) -> Iterator[str]:
        """Yield the notes below the table."""
        units = f"values of {', '.join(self.unit_keys)}"
        if not self.tested:
            if self.results:
                yield (
                    f"No statistics: they require at least {MIN_TESTED} {units} in a row and its base, and "
                    "differences that are not all equal."
                )
            return
        yield (
            f"Statistics: units are {units} in both a row and its base; the runs of each unit are averaged "
            f"first. {CONFIDENCE:.0%} interval: BCa bootstrap of the mean difference over the units, {RESAMPLES} "
            f"samples, seed {SEED}. p: two-sided paired t-test and Wilcoxon's signed-rank test. Holm: p corrected for "
            f"all rows of the metric (at most {self.comparisons}); a claim over several metrics requires another "
            f"correction. Comparisons with fewer than {MIN_TESTED} units or with equal differences are omitted."
        )
        yield (
            f"units for {POWER:.0%} power: number of units for p < {ALPHA:.2g} in a paired t-test without Holm's "
            "correction. It assumes normal, independent differences whose true mean and deviation are the observed "
            "ones; with few units it is only an order of magnitude."
        )
        yield from self._limits(units)

    def _limits(self, units: str) -> Iterator[str]:
        """Yield notes on the limitations of few units."""
        fewest = min(result.units for result in self.tested.values())
        necessary = math.ceil(math.log2(2 * self.comparisons / ALPHA))
        if fewest < necessary:
            correction = f" with Holm's correction for {self.comparisons} rows" if self.comparisons > 1 else ""
            yield (
                f"Wilcoxon's test cannot reach p < {ALPHA:.2g}{correction} with fewer than {necessary} {units}; its "
                f"smallest p with {fewest} is {_p(2.0 ** (1 - fewest))}."
            )
        if fewest < FEW_UNITS:
            omitted = f" and omitted below {MIN_UNITS}" if fewest < MIN_UNITS else ""
            yield (
                f"Below {FEW_UNITS} {units}, bootstrap intervals are too narrow{omitted}, and the t-test relies on "
                "normal differences, which so few units cannot confirm. A missing * is no evidence of equal rows."
            )
        if all(key.rpartition(".")[2] == "seed" for key in self.unit_keys):
            yield (
                "The statistics are over seeds: they hold for repetitions on the same sequences, not for other "
                "sequences, unless the seed generates the sequence."
            )


def bootstrap_interval(differences: Float64) -> tuple[float, float]:
    """Return the BCa bootstrap interval (Efron 1987) of the mean difference.

    The limits are NaN for fewer than MIN_UNITS differences.
    """
    if len(differences) < MIN_UNITS:
        return math.nan, math.nan
    from scipy.stats import bootstrap

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the interval of a degenerate sample is NaN
        interval = bootstrap(
            (differences,), np.mean, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="BCa", rng=SEED
        ).confidence_interval
    return float(interval.low), float(interval.high)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the p-values with Holm's correction for multiple comparisons (Holm 1979)."""
    # statsmodels also provides it, but is not a dependency
    order = np.argsort(p_values)
    factors = np.arange(len(order), 0, -1)
    corrected = np.empty(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * np.array(p_values)[order]), 1.0)
    return [float(p) for p in corrected]


def units_needed(effect: float) -> float:
    """Return the number of units that a paired t-test needs for the power POWER.

    The test is two-sided with the significance level ALPHA.

    Args:
        effect: The mean of the differences, divided by their standard deviation (Cohen's d_z).

    Returns:
        The least number of units, at least 2, or infinity above MAX_UNITS.
    """
    from scipy.stats import nct, t

    size = min(abs(effect), MAX_EFFECT)

    def power(n: int) -> float:
        limit, shift = t.ppf(1 - ALPHA / 2, n - 1), size * math.sqrt(n)
        return float(nct.sf(limit, n - 1, shift) + nct.cdf(-limit, n - 1, shift))

    sizes = range(2, MAX_UNITS + 1)
    place = bisect_left(sizes, POWER, key=power)
    return sizes[place] if place < len(sizes) else math.inf


def _cells(result: PairedStatistics, digits: int) -> list[str]:
    low, high = (figure(limit, math.nan, digits, signed=True) for limit in result.interval)
    interval = "–" if math.isnan(result.interval[0]) else f"{low} to {high}"
    needed = f"> {MAX_UNITS}" if math.isinf(result.units_needed) else f"{result.units_needed:.0f}"
    p_values = map(_p, (result.t_p, result.t_holm, result.wilcoxon_p, result.wilcoxon_holm))
    return [str(result.units), figure(result.mean, math.nan, digits, signed=True), interval, *p_values, needed]


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
