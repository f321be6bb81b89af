"""Tests for Shapley values, on games with known values."""

import numpy as np
import pytest

from framework.explanation.shapley import shapley_values

GLOVES = {frozenset("lr"): 1.0, frozenset("lrs"): 1.0, frozenset("ls"): 1.0}
"""Game of one left glove l and two right gloves r and s: a pair is worth 1."""


def random_game(players: str) -> dict[frozenset[str], float]:
    rng = np.random.default_rng(0)
    sets = [frozenset(p for k, p in enumerate(players) if n >> k & 1) for n in range(2 ** len(players))]
    return dict(zip(sets, rng.normal(size=len(sets)), strict=True))


def test_shapley_glove_game_has_known_values() -> None:
    shares = shapley_values("lrs", lambda coalition: GLOVES.get(coalition, 0.0))
    assert shares == pytest.approx({"l": 2 / 3, "r": 1 / 6, "s": 1 / 6})


def test_shapley_values_sum_to_value_of_all_players() -> None:
    game = random_game("abcd")
    shares = shapley_values("abcd", game.__getitem__)
    assert sum(shares.values()) == pytest.approx(game[frozenset("abcd")] - game[frozenset()])


def test_shapley_symmetric_players_have_equal_values() -> None:
    shares = shapley_values("abcd", lambda coalition: len(coalition) ** 2)
    assert list(shares.values()) == pytest.approx([4.0] * 4)


def test_shapley_dummy_player_has_its_own_value() -> None:
    game = random_game("abc")
    shares = shapley_values("abcd", lambda coalition: game[coalition - {"d"}] + 0.3 * ("d" in coalition))
    assert shares["d"] == pytest.approx(0.3)
    assert {p: shares[p] for p in "abc"} == pytest.approx(shapley_values("abc", game.__getitem__))
