"""Tests for the contributions of the stages to the loss."""

from __future__ import annotations

from itertools import combinations

import pytest

from framework.errors import DataError
from framework.explanation.contributions import ALL, REST, STAGES, Contributions, Stage, losses_of


def additive(replaced: frozenset[Stage]) -> float:
    """Return a loss to which detection contributes 0.3, tracking 0.2 and everything else 0.1."""
    return 0.1 + 0.3 * (Stage.DETECTION not in replaced) + 0.2 * (Stage.TRACKING not in replaced)


def test_contributions_of_additive_loss_are_its_terms() -> None:
    found = Contributions.of("instances.ap50", losses_of(additive))
    expected = {"detection": 0.3, "tracking": 0.2, "refinement": 0.0, "association": 0.0, REST: 0.1}
    assert found.named() == pytest.approx(expected)
    assert found.loss == pytest.approx(0.6)


def test_losses_of_given_stage_are_not_repeated() -> None:
    replayed = []

    def loss(replaced: frozenset[Stage]) -> float:
        replayed.append(replaced)
        return additive(replaced | {Stage.TRACKING})

    losses = losses_of(loss, given=frozenset({Stage.TRACKING}))
    assert len(replayed) == len(set(replayed)) == 8
    assert len(losses) == 16
    assert losses[ALL] == losses[ALL - {Stage.TRACKING}]
    assert Contributions.of("instances.ap50", losses).stages[Stage.TRACKING] == 0


def test_contributions_of_redundant_faults_are_shared() -> None:
    """The loss disappears if either of two stages is replaced."""
    sets = [frozenset(chosen) for size in range(5) for chosen in combinations(STAGES, size)]
    losses = {one: float(not one & {Stage.DETECTION, Stage.REFINEMENT}) for one in sets}
    found = Contributions.of("instances.ap50", losses)
    assert found.stages[Stage.DETECTION] == pytest.approx(0.5)
    assert found.stages[Stage.REFINEMENT] == pytest.approx(0.5)


def test_contributions_mean_is_over_runs() -> None:
    one = Contributions.of("instances.ap50", losses_of(additive))
    none = Contributions.of("instances.ap50", losses_of(lambda _: 0.0))
    assert Contributions.mean([one, none]).named() == pytest.approx({k: v / 2 for k, v in one.named().items()})


def test_contributions_with_another_sum_raise() -> None:
    with pytest.raises(DataError, match=r"expected a sum of 0\.5"):
        Contributions("instances.ap50", 0.5, dict.fromkeys(STAGES, 0.1), 0.0)
