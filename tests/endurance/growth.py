"""Growth over repeated visits of a place, and its bounds.

Tentative instances expire after EXPIRY frames, so their number is stationary only then. From the next visit on, each
block of frames is compared with the block at the same position of each later visit, which sees the same views. The
growth is the median slope of these pairs (seasonal Sen slope: Hirsch, Slack and Smith, "Techniques of trend analysis
for monthly water quality data", Water Resources Research 18(1), 1982).

A bound fails if three quarters of the slopes exceed it. Growth affects all pairs. A single disturbed visit, for example
by another program, affects at most half of the pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from framework.data import Float64
from framework.mapping.instances.association import Association
from tests.endurance.visits import Block

EXPIRY = Association.tentative_max_age  # frames
COMPARED = 4  # minimum number of compared visits, i.e. six pairs


@dataclass(frozen=True)
class Measured:
    """A measured quantity of a place."""

    value: float
    spread: tuple[float, float] | None  # quartiles of the slopes; None = a single value

    @property
    def certain(self) -> float:
        """The value that is compared with the bound."""
        return self.value if self.spread is None else self.spread[0]


@dataclass(frozen=True)
class Bound:
    """The maximum value of a quantity of each place."""

    quantity: str
    unit: str  # with the space after the number
    limit: float
    measure: Callable[[Sequence[Block]], Measured]  # measures the quantity, given the blocks of one place

    def verdict(self, blocks: Sequence[Block]) -> Verdict:
        """Compare a place with the bound, given its blocks."""
        return Verdict(blocks[0].place, self, self.measure(blocks))


@dataclass(frozen=True)
class Verdict:
    """The comparison of a place with a bound."""

    place: str
    bound: Bound
    measured: Measured

    @property
    def is_met(self) -> bool:
        return self.measured.certain <= self.bound.limit

    def __str__(self) -> str:
        """Return the error message of a bound that is not met."""
        bound = self.bound
        got = f"{self.measured.value:.4g}"
        return f"{self.place}: {bound.quantity}: expected at most {bound.limit:g}{bound.unit}, got {got}"


def growth(
    value: Callable[[Block], float], frames: int = 1, *, relative: bool = False
) -> Callable[[Sequence[Block]], Measured]:
    """Return a function that measures the growth of a value in the compared visits.

    Args:
        value: The value of a block.
        frames: The number of frames of the unit, such as 1000 for "per 1,000 frames".
        relative: True = growth in percent of the median value.
    """

    def measure(blocks: Sequence[Block]) -> Measured:
        values = by_visit(blocks, value)[first_compared(blocks) :]
        scale = frames * (100 / float(np.median(values)) if relative else 1.0)
        return sen_slope(scale * values, visit_frames(blocks))

    return measure


def sen_slope(values: Float64, step: int) -> Measured:
    """Return the median slope of all pairs of visits at the same position, with the quartiles of the slopes.

    Args:
        values: Values (visits, positions) of at least two visits.
        step: The number of frames of a visit.
    """
    earlier, later = np.triu_indices(len(values), 1)
    slopes = (values[later] - values[earlier]) / (step * (later - earlier))[:, None]
    lower, median, upper = (float(q) for q in np.quantile(slopes, (0.25, 0.5, 0.75)))
    return Measured(median, (lower, upper))


def drift_increase(blocks: Sequence[Block]) -> Measured:
    """Return the maximum error of a later visit minus the error of the first compared visit, mm."""
    first, *later = errors_mm(blocks)[first_compared(blocks) :]
    return Measured(max(later) - first, None)


def lost_frames(blocks: Sequence[Block]) -> Measured:
    """Return the number of lost frames in the compared visits."""
    first = first_compared(blocks)
    return Measured(sum(block.lost for block in blocks if block.visit >= first), None)


BOUNDS = (
    Bound(
        "heap", " bytes per frame", 500,  # decreases to below 50 bytes (`long_run_growth`)
        growth(lambda block: block.heap),
    ),
    Bound(
        "map", "% per 1,000 frames", 5,  # sensor noise adds blocks at depth edges
        growth(lambda block: block.map_bytes, 1000, relative=True),
    ),
    Bound(
        "processor time", "% per 1,000 frames", 5,  # noise of about 3%
        growth(lambda block: block.relative_time, 1000, relative=True),
    ),
    Bound(
        "confirmed instances", " per 1,000 frames", 10,  # equal images repeat detection errors
        growth(lambda block: block.confirmed, 1000),
    ),
    Bound(
        "tentative instances", " per 1,000 frames", 50,  # noise of about 20
        growth(lambda block: block.tentative, 1000),
    ),
    Bound("drift", " mm", 5, drift_increase),  # half of a voxel of 1 cm
    Bound("lost frames", " frames", 0, lost_frames),  # the place is known
)  # fmt: skip
"""The bounds of the endurance run."""


def verdicts(blocks: Sequence[Block]) -> list[Verdict]:
    """Compare each place with each bound."""
    return [bound.verdict(own) for bound in BOUNDS for own in by_place(blocks).values()]


def by_place(blocks: Sequence[Block]) -> dict[str, list[Block]]:
    """Return the blocks of each place."""
    return {name: [block for block in blocks if block.place == name] for name in dict.fromkeys(b.place for b in blocks)}


def by_visit(blocks: Sequence[Block], value: Callable[[Block], float]) -> Float64:
    """Return the values (visits, positions) of the blocks of one place."""
    return np.array([value(block) for block in blocks], np.float64).reshape(visits_of(blocks), -1)


def visits_of(blocks: Sequence[Block]) -> int:
    return 1 + max(block.visit for block in blocks)


def first_compared(blocks: Sequence[Block]) -> int:
    """Return the number of the first compared visit, given the blocks of one place."""
    return max(1, min(visits_of(blocks) - COMPARED, ceil(EXPIRY / visit_frames(blocks))))


def visit_frames(blocks: Sequence[Block]) -> int:
    """Return the number of frames of a visit, given the blocks of one place."""
    return sum(len(block.cpu_ms) for block in blocks if block.visit == 0)


def errors_mm(blocks: Sequence[Block]) -> list[float]:
    """Return the root mean square position error of each visit, mm, given the blocks of one place."""
    errors = [np.concatenate([b.errors_mm for b in blocks if b.visit == visit]) for visit in range(visits_of(blocks))]
    return [rms(of_visit) for of_visit in errors]


def rms(errors: Float64) -> float:
    """Return the root mean square of the errors that are not NaN."""
    return float(np.sqrt(np.nanmean(errors**2)))
