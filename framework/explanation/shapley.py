"""Shapley values of a cooperative game."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import comb
from typing import TypeVar

Player = TypeVar("Player")


def shapley_values(players: Sequence[Player], value: Callable[[frozenset[Player]], float]) -> dict[Player, float]:
    """Return the Shapley value of each player, computed exactly (Shapley 1953, eq. 12).

    The Shapley value is the mean gain when the player joins the players before it, over all orders of the players. The
    sum over the players is the value of all players minus the value of none.

    Args:
        players: The n distinct players. `value` is called for all 2^n coalitions, some of them several times.
        value: The value of a coalition.
    """
    n = len(players)
    shares: dict[Player, float] = {}
    for player in players:
        others = [one for one in players if one != player]
        shares[player] = sum(
            (value(frozenset({*before, player})) - value(frozenset(before))) / (n * comb(n - 1, size))
            for size in range(n)
            for before in combinations(others, size)
        )
    return shares
