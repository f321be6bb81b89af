"""Generated captions of LaTeX tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from framework.registry import STAGES
from framework.runs.run_rows import natural, value_of
from framework.tables.comparison import ComparisonTable
from framework.tables.latex_table import escaped
from framework.tables.metric_columns import described
from framework.tables.statistics import ALPHA
from framework.tables.table_notes import common_options, machines

VALUES, DIFFERENCES, STATISTICS = "values", "differences", "statistics"  # the tables of a comparison
OTHERWISE_NAMED = {*STAGES, "row", "seed", "threads"}  # keys that other parts of a caption contain
MOST_SEEDS = 5  # maximum number of seeds that a caption lists


def _values(comparison: ComparisonTable) -> str:
    choice = comparison.choice
    spread = f"mean ± sample standard deviation over {', '.join(choice.average_over)}"
    by = f" by {choice.split_key}" if choice.split_key else ""
    return escaped(f"{_metrics(comparison)}{by}: {spread}. Common to all runs: {'; '.join(_constants(comparison))}.")


def _differences(comparison: ComparisonTable) -> str:
    base, units = comparison.base_called, ", ".join(comparison.choice.units)
    rows = f"{base} minus each row" if comparison.choice.columns_by else f"each row minus {base}"
    return escaped(
        f"Differences in {_metrics(comparison)}, {rows}: mean ± standard error over {units}. *: p < {ALPHA:.2g} in a "
        "paired t-test with Holm's correction."
    )


def _statistics(comparison: ComparisonTable) -> str:
    return escaped(
        f"Statistics of the differences from {comparison.base_called}. Units: values of "
        f"{', '.join(comparison.choice.units)} in both rows. Interval: BCa bootstrap of the mean difference. p: "
        "two-sided paired t-test and Wilcoxon's signed-rank test. Holm: p with Holm's correction."
    )


CAPTIONS: Mapping[str, Callable[[ComparisonTable], str]] = {
    VALUES: _values,
    DIFFERENCES: _differences,
    STATISTICS: _statistics,
}
"""Functions that return the caption of each table, LaTeX."""


def _metrics(comparison: ComparisonTable) -> str:
    """Return the metric of a table with `columns_by` and its direction, otherwise the name of the table."""
    if not comparison.choice.columns_by:
        return comparison.title
    [key] = comparison.choice.columns
    return described(key)


def _constants(comparison: ComparisonTable) -> Iterator[str]:
    """Yield the options and swept parameters with one value, the seeds, the number of runs and the machine."""
    records = comparison.records
    options = [common_options(records)] if common_options(records) else []
    for key in sorted(comparison.asked or ()):
        values = {value_of(record, key) for record in records}
        if key not in OTHERWISE_NAMED and len(values) == 1 and all(key in record.settings for record in records):
            options.append(f"{key}={values.pop()}")
    if options:
        yield ", ".join(options)
    seeds = sorted({value_of(record, "seed") for record in records}, key=lambda seed: natural((seed,)))
    yield f"{len(seeds)} seeds" if len(seeds) > MOST_SEEDS else f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)}"
    counts = sorted({len(row.records) for row in comparison.rows})
    yield f"n = {' to '.join(map(str, dict.fromkeys([counts[0], counts[-1]])))} runs per row"
    if used := machines(records):
        yield used
