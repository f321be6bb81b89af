"""Tests for the bounds of the endurance run, with synthetic measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from framework.runtime.run_log import STAGES
from tests.endurance.growth import BOUNDS, sen_slope, verdicts
from tests.endurance.visits import Block

VISITS, POSITIONS, FRAMES = 5, 4, 50  # FRAMES of a block


def blocks(changed: Callable[[Block], dict[str, Any]] = lambda block: {}) -> list[Block]:
    """Return the blocks of one place without growth, except for the changed fields.

    Values differ by position, and the first visit to the unknown place costs more than the others.
    """
    made = []
    for visit in range(VISITS):
        for position in range(POSITIONS):
            block = Block(
                place="place",
                visit=visit,
                position=position,
                all_frames=FRAMES * (1 + position + POSITIONS * visit),
                cpu_ms=np.full(FRAMES, 50.0 + 10 * position + 100 * (visit == 0)),
                reference_ms=20.0,
                stage_ms=np.ones((FRAMES, len(STAGES))),
                errors_mm=np.full(FRAMES, 10.0),
                lost=0,
                heap=10**7 + 10**6 * position,
                process=10**9,
                map_bytes=2 * 10**7,
                confirmed=20 if visit else 5 * position,
                tentative=30 + position,
            )
            made.append(replace(block, **changed(block)))
    return made


def missed(changed: Callable[[Block], dict[str, Any]]) -> list[str]:
    """Return the quantities whose bounds are missed."""
    return [one.bound.quantity for one in verdicts(blocks(changed)) if not one.is_met]


def test_sen_slope_of_linear_growth_is_exact() -> None:
    positions = np.array([3.0, 70.0, -5.0])
    values = positions + 0.25 * 200 * np.arange(4)[:, None]
    slope = sen_slope(values, 200)
    assert (slope.value, slope.spread) == (0.25, (0.25, 0.25))


def test_sen_slope_is_median_of_pairs() -> None:
    """The slopes of the visits 0, 1, 5 are 1, 4 and 5 / 2."""
    slope = sen_slope(np.array([[0.0], [1.0], [5.0]]), 1)
    assert (slope.value, slope.spread) == (2.5, (1.75, 3.25))


def test_verdicts_without_growth_are_met() -> None:
    found = verdicts(blocks())
    assert [one.bound for one in found] == list(BOUNDS)
    assert not [str(one) for one in found if not one.is_met]


@pytest.mark.parametrize(
    ("quantity", "changed"),
    [
        ("heap", lambda b: {"heap": b.heap + 600 * b.all_frames}),
        ("map", lambda b: {"map_bytes": b.map_bytes + 1200 * b.all_frames}),
        ("processor time", lambda b: {"cpu_ms": b.cpu_ms * (1 + 6e-5 * b.all_frames)}),
        ("confirmed instances", lambda b: {"confirmed": b.confirmed + b.all_frames // 50}),
        ("tentative instances", lambda b: {"tentative": b.tentative + b.all_frames // 10}),
        ("drift", lambda b: {"errors_mm": b.errors_mm + 2.0 * b.visit}),
        ("lost frames", lambda b: {"lost": int(b.visit == 3)}),
    ],
)
def test_verdict_of_growing_quantity_is_missed(quantity: str, changed: Callable[[Block], dict[str, Any]]) -> None:
    assert missed(changed) == [quantity]


@pytest.mark.parametrize("disturbed", range(VISITS))
def test_verdict_with_one_disturbed_visit_is_met(disturbed: int) -> None:
    assert not missed(lambda b: {"cpu_ms": b.cpu_ms * (1 + (b.visit == disturbed))})


def test_verdict_of_busy_machine_is_met() -> None:
    """Other programs slow down the frames and the reference computation."""
    assert not missed(lambda b: {"cpu_ms": b.cpu_ms * (1 + b.visit), "reference_ms": b.reference_ms * (1 + b.visit)})


def test_missed_verdict_message_is_one_line() -> None:
    [one] = [one for one in verdicts(blocks(lambda b: {"heap": 600 * b.all_frames})) if not one.is_met]
    assert str(one) == "place: heap: expected at most 500 bytes per frame, got 600"
