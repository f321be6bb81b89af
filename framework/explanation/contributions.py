"""Contribution of each stage to the loss of a run.

A run is replayed with each set of stages replaced by the ground truth. The contribution of a stage is its Shapley value
in the game whose value is the decrease of the loss. The contributions and the remaining loss with all stages replaced
sum to the loss of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import combinations
from statistics import fmean

from framework.errors import DataError
from framework.explanation.shapley import shapley_values

REST = "observation and resolution"  # name of the loss with all stages replaced


class Stage(Enum):
    """A stage that can be replaced by the ground truth, in the order of the pipeline."""

    DETECTION = "detection"
    TRACKING = "tracking"
    REFINEMENT = "refinement"
    ASSOCIATION = "association"


STAGES = tuple(Stage)
ALL = frozenset(STAGES)


@dataclass(frozen=True)
class Contributions:
    """The contributions of the stages to the loss."""

    metric: str  # key of metrics.json; the loss is 1 - metric
    loss: float
    stages: Mapping[Stage, float]  # negative if the errors of a stage hide errors of others
    rest: float  # loss with all stages replaced by the ground truth

    def __post_init__(self) -> None:
        if abs(sum(self.stages.values()) + self.rest - self.loss) > 1e-6:
            raise DataError(
                f"Contributions: expected a sum of {self.loss}, got {sum(self.stages.values()) + self.rest}"
            )

    @classmethod
    def of(cls, metric: str, losses: Mapping[frozenset[Stage], float]) -> Contributions:
        """Return the contributions, given the loss for each set of stages that the ground truth replaces."""
        stages = shapley_values(STAGES, lambda replaced: -losses[replaced])
        return cls(metric, losses[frozenset()], stages, losses[ALL])

    @classmethod
    def mean(cls, of_runs: Sequence[Contributions]) -> Contributions:
        """Return the mean contributions over runs with the same metric."""
        stages = {stage: fmean(one.stages[stage] for one in of_runs) for stage in STAGES}
        loss, rest = (fmean(values) for values in zip(*((one.loss, one.rest) for one in of_runs), strict=True))
        return cls(of_runs[0].metric, loss, stages, rest)

    def named(self) -> dict[str, float]:
        """Return the contributions and the rest by name."""
        return {stage.value: self.stages[stage] for stage in STAGES} | {REST: self.rest}


def sets_of(stages: Sequence[Stage]) -> list[frozenset[Stage]]:
    """Return all sets of stages, smallest first."""
    return [frozenset(chosen) for size in range(len(stages) + 1) for chosen in combinations(stages, size)]


def losses_of(
    loss: Callable[[frozenset[Stage]], float], given: frozenset[Stage] = frozenset()
) -> dict[frozenset[Stage], float]:
    """Return the loss for each set of stages that the ground truth replaces.

    Args:
        loss: The loss for a set of replaced stages; called once for each set without `given`.
        given: The stages of the run that are the ground truth.
    """
    known = {replaced: loss(replaced) for replaced in sets_of([one for one in STAGES if one not in given])}
    return {replaced: known[replaced - given] for replaced in sets_of(STAGES)}
