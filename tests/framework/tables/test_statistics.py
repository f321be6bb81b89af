"""Tests for paired statistics, compared with SciPy, published examples and simulations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from framework.tables.statistics import (
    MAX_UNITS,
    PairedStatistics,
    PairedValues,
    Pairs,
    TableStatistics,
    bootstrap_interval,
    holm,
    units_needed,
)

# Student (1908): additional hours of sleep of ten patients with two drugs; data set `sleep` of R
SLEEP = (
    [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0],
    [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4],
)


def pairs(values: Sequence[float], others: Sequence[float]) -> Pairs:
    return {(str(k),): PairedValues(*pair) for k, pair in enumerate(zip(values, others, strict=True))}


def of_differences(differences: Sequence[float]) -> Pairs:
    return pairs(differences, [0.0] * len(differences))


def text_of(comparisons: dict[tuple[str, str], Pairs], *unit_keys: str) -> str:
    return " ".join(TableStatistics.of(comparisons, unit_keys or ["dataset.scene"]).notes())


def test_paired_statistics_match_published_example() -> None:
    """The result of R is t = -4.0621, df = 9, p = 0.002833 and a mean difference of -1.58."""
    result = PairedStatistics.of(pairs(*SLEEP))
    assert result.units == 10
    assert result.mean == pytest.approx(-1.58)
    assert result.t_p == pytest.approx(0.002833, abs=1e-6)
    # one difference is 0 and nine are negative: 2 of 2^9 sign patterns are at least as extreme
    assert result.wilcoxon_p == pytest.approx(2 / 2**9)


def test_paired_statistics_match_scipy() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(0, 1, 12)
    b = a + rng.normal(0.4, 0.5, 12)
    result = PairedStatistics.of(pairs(a, b))
    assert result.t_p == pytest.approx(stats.ttest_rel(a, b).pvalue)
    assert result.wilcoxon_p == pytest.approx(stats.wilcoxon(a, b).pvalue)
    assert result.interval[0] < result.mean < result.interval[1]


@pytest.mark.parametrize(
    "of_units",
    [
        {},
        pairs([0.5], [0.1]),
        pairs([0.5, 0.7], [0.1, 0.1]),
        pairs([2.0, 2.0, 2.0], [0.0, 0.0, 0.0]),
        pairs([0.7, 0.2, 1.0], [0.6, 0.1, 0.9]),  # equal up to rounding
        pairs([0.3, 0.1 + 0.2, 0.3], [0.1 + 0.2, 0.3, 0.3]),  # 0 up to rounding
    ],
)
def test_paired_statistics_without_variation_are_undefined(of_units: Pairs) -> None:
    result = PairedStatistics.of(of_units)
    assert not result.tested
    assert not result.is_significant
    assert math.isnan(result.wilcoxon_p)
    assert math.isnan(result.units_needed)


@pytest.mark.parametrize("differences", [[0.0] * 7 + [1.0], [1.0] * 3 + [2.0] * 3])
def test_paired_statistics_accept_ties(differences: list[float]) -> None:
    result = PairedStatistics.of(of_differences(differences))
    assert 0 < result.wilcoxon_p <= 1
    assert 0 < result.t_p <= 1
    assert result.interval[0] <= result.mean <= result.interval[1]


def test_holm_matches_published_example() -> None:
    """The expected values are from p.adjust of R with the method "holm"."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([0.2]) == [0.2]
    assert holm([]) == []


@pytest.mark.parametrize(("effect", "units"), [(0.2, 199), (0.5, 34), (-0.5, 34), (0.8, 15), (1.0, 10)])
def test_units_needed_match_published_sizes(effect: float, units: int) -> None:
    """The values are from G*Power 3.1: two dependent means, two-sided, alpha 0.05, power 0.8."""
    assert units_needed(effect) == units


def test_units_needed_have_simulated_power() -> None:
    rng = np.random.default_rng(0)
    n = int(units_needed(0.7))
    p_values = stats.ttest_1samp(rng.normal(0.7, 1, (20_000, n)), 0, axis=1).pvalue
    assert 0.79 < np.mean(p_values < 0.05) < 0.83
    fewer = stats.ttest_1samp(rng.normal(0.7, 1, (20_000, n - 2)), 0, axis=1).pvalue
    assert np.mean(fewer < 0.05) < 0.79


@pytest.mark.parametrize(("effect", "units"), [(0.0, math.inf), (1e-4, math.inf), (0.003, 872_095), (1e15, 2)])
def test_units_needed_accept_extreme_effects(effect: float, units: float) -> None:
    assert units_needed(effect) == pytest.approx(units, rel=1e-3)


def test_bootstrap_interval_covers_true_mean() -> None:
    """The documented coverage is 92% to 95% for 20 units and at most 91% for 6 units."""
    rng = np.random.default_rng(0)

    def coverage(units: int) -> float:
        intervals = [bootstrap_interval(rng.normal(0.3, 1, units)) for _ in range(150)]
        return float(np.mean([low < 0.3 < high for low, high in intervals]))

    assert 0.88 < coverage(20) < 0.99
    assert 0.78 < coverage(6) < 0.91


def test_bootstrap_interval_does_not_depend_on_order() -> None:
    differences = np.random.default_rng(1).exponential(1, 15)
    given = PairedStatistics.of(of_differences(differences.tolist()))
    assert PairedStatistics.of(of_differences(differences[::-1].tolist())).interval == given.interval


def test_bootstrap_interval_is_corrected_for_skewness() -> None:
    """For skewed differences, both limits must be above those of the percentile method."""
    differences = np.random.default_rng(1).exponential(1, 15)
    plain = stats.bootstrap((differences,), np.mean, method="percentile", rng=0).confidence_interval
    low, high = bootstrap_interval(differences)
    assert low > plain.low + 0.01
    assert high > plain.high + 0.05


def test_bootstrap_interval_of_few_units_is_undefined() -> None:
    assert all(map(math.isnan, bootstrap_interval(np.array([0.1, 0.2, 0.3, 0.4, 0.6]))))


def test_table_statistics_holm_correction_is_per_metric() -> None:
    rng = np.random.default_rng(0)
    noise = {key: of_differences(rng.normal(0.5, 0.5, 12)) for key in (("a", "ap"), ("b", "ap"), ("a", "fps"))}
    # equal differences have no test, so the other p-values are not corrected for it
    equal = {("c", "ap"): of_differences([1.0] * 12)}
    results = TableStatistics.of(noise | equal, ["dataset.scene"]).results
    expected = holm([results["a", "ap"].t_p, results["b", "ap"].t_p])
    assert [results["a", "ap"].t_holm, results["b", "ap"].t_holm] == expected
    assert results["a", "fps"].t_holm == results["a", "fps"].t_p
    assert not results["c", "ap"].tested


def test_table_statistics_bound_false_rejections() -> None:
    """All rows have equal means. At most 5% of the tables have a star, or 14% without the correction."""
    rng = np.random.default_rng(0)
    p_values = stats.ttest_1samp(rng.normal(0, 1, (2000, 4, 8)) - rng.normal(0, 1, (2000, 1, 8)), 0, axis=2).pvalue
    corrected = np.array([holm(of_table) for of_table in p_values.tolist()])
    assert np.mean((corrected < 0.05).any(axis=1)) < 0.05
    assert np.mean((p_values < 0.05).any(axis=1)) > 0.1


def test_statistics_notes_state_limits_of_few_units() -> None:
    few = of_differences([0.1, 0.2, 0.3, 0.5, 0.4])
    text = text_of({("a", "ap"): few})
    assert "cannot reach p < 0.05 with fewer than 6 values of dataset.scene; its smallest p with 5 is 0.062." in text
    assert "bootstrap intervals are too narrow and omitted below 6" in text
    assert "over seeds" not in text
    assert PairedStatistics.of(few).wilcoxon_p == pytest.approx(0.0625)
    text = text_of({(row, "ap"): of_differences([0.1, 0.2, 0.3, 0.5, 0.4, 0.6]) for row in "abcd"})
    assert "with Holm's correction for 4 rows with fewer than 8 values" in text
    rng = np.random.default_rng(0)
    text = text_of({("a", "ap"): of_differences(rng.normal(0, 1, 12))}, "seed")
    assert "Wilcoxon's test cannot" not in text
    assert "too narrow" not in text
    assert "not for other sequences" in text
    text = text_of({("a", "ap"): few}, "dataset.scene", "seed")
    assert "units are values of dataset.scene, seed in both a row and its base" in text
    assert "over seeds" not in text


def test_statistics_notes_without_tests_state_requirement() -> None:
    assert "at least 3 values of dataset.scene" in text_of({("a", "ap"): of_differences([0.1, 0.2])})
    assert text_of({}) == ""


def test_statistics_grid_has_line_per_tested_comparison() -> None:
    sleep = pairs(*SLEEP)
    comparisons = {
        ("b", "ap"): sleep,
        ("c", "ap"): of_differences([1.0, 1.0, 1.0]),
        ("c", "fps"): of_differences([3.0, 0.0, -3.0]),
    }
    grid = TableStatistics.of(comparisons, ["dataset.scene"]).grid(
        "minus a", {"b": "B", "c": "C"}, {"ap": "AP", "none": "x", "fps": "Hz"}
    )
    assert grid.heads[:5] == ["metric", "minus a", "units", "difference", "95% interval"]
    [first, second] = grid.body
    assert first[:4] == ["AP", "B", "10", "-1.580"]
    assert first[5:] == ["0.003", "0.003", "0.004", "0.004", "7"]
    assert second == ["Hz", "C", "3", "+0.000", "–", "1.000", "1.000", "1.000", "1.000", f"> {MAX_UNITS}"]
    assert grid.groups == {1}
