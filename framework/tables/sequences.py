"""Means over sequences, each of which was run with several seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from framework.runs.run_rows import Mean, Run


@dataclass(frozen=True)
class SequenceMean:
    """The mean over sequences of their means over seeds."""

    value: float  # NaN = of no sequence
    deviation: float  # sample standard deviation of the seeds' means over these sequences; NaN = of less than two seeds
    count: int  # sequences
    runs: int  # of all of them


def mean_by_sequence(values: Mapping[Run, float]) -> dict[str, Mean]:
    """The mean of each sequence, the last word of a run, over the others."""
    grouped: dict[str, list[float]] = {}
    for run, value in values.items():
        grouped.setdefault(run[-1], []).append(value)
    return {sequence: Mean.of(found) for sequence, found in grouped.items()}


def mean_over_sequences(values: Mapping[Run, float]) -> SequenceMean:
    """Every sequence counts as one, however many seeds it has.

    The deviation is of the seeds that have all the sequences: the mean of others would be one of easier or harder ones.
    """
    means = mean_by_sequence(values)
    seeds: dict[Run, list[float]] = {}
    for run, value in values.items():
        seeds.setdefault(run[:-1], []).append(value)
    complete = Mean.of(Mean.of(found).value for found in seeds.values() if len(found) == len(means))
    return SequenceMean(
        Mean.of(mean.value for mean in means.values()).value, complete.deviation, len(means), len(values)
    )


def mean_difference(differences: Mapping[Run, float]) -> Mean:
    """The mean of paired differences, with a standard error over sequences: over the last words of runs.

    What is before that is averaged first: several seeds of a sequence are no further evidence of what another sequence
    would show.
    """
    return Mean.of(mean.value for mean in mean_by_sequence(differences).values())
