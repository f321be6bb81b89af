"""Jumps of stored poses between neighboring frames, and between frames that see the same place again.

The camera motion between two frames is estimated from matched points, and compared with the motion in the poses. A pair
contradicts the poses if both motions move the points to clearly different places.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair, Matcher
from framework.checking.pose_fit import UNPOSED, error_of, motion_between, motion_of
from framework.data import Float64
from framework.datasets.frames.conventions import PoseReading
from framework.geometry import inverse, rotation_angle, transform

# maximum median distance of points moved by both motions, as a fraction of their depth; real sequences have at most
# 0.025, rotations by 10 degrees at least 0.038 and translations by 0.3 m at least 0.058 (at 5 m)
MAX_DISTANCE = 0.032
MIN_ERROR = 0.012  # fraction of the image width, minimum reprojection error of a contradicting pair
REVISIT_FACTOR = 2.5  # factor of both limits for distant frames, because given poses drift; real sequences have 1.1
MAX_NEIGHBORS = 100  # maximum number of compared pairs of neighboring frames; pairs with large motions come first
REVISITS = 16  # number of evenly spaced frames that are compared with each other
STEPS = (1, 2, 3, 4)  # frames; a neighbor that is blurred is replaced by the next frame
SHOWN = 5  # maximum number of jumps in a message


@dataclass(frozen=True)
class PoseJump:
    """A pair of frames whose poses contradict the images."""

    first: int  # Frame.index
    second: int  # Frame.index
    translation: float  # m, difference of the two motions
    rotation: float  # degrees, difference of the two motions

    def contains(self, other: PoseJump) -> bool:
        """Return True if the frames of another jump are between the frames of this jump."""
        return self.first <= other.first and other.second <= self.second

    def __str__(self) -> str:
        return f"{self.first} and {self.second} (by {self.translation:.2f} m and {self.rotation:.1f} degrees)"


@dataclass(frozen=True)
class PoseJumps:
    """The result for all compared pairs of frames."""

    neighbors: tuple[PoseJump, ...]  # between neighboring frames, in the order of the sequence
    revisits: tuple[PoseJump, ...]  # between distant frames
    compared: int  # number of compared pairs

    def without(self, pairs: Sequence[MatchedPair]) -> list[MatchedPair]:
        """Return the pairs without a jump between their frames."""
        return [
            pair
            for pair in pairs
            if not any(pair.first.index <= one.first and one.second <= pair.second.index for one in self.neighbors)
        ]

    def finding(self) -> Finding | None:
        """Return the check result, or None without a jump."""
        jumps = self.neighbors or self.revisits
        if not jumps:
            return None
        listed = ", ".join(map(str, jumps[:SHOWN])) + (f" and {len(jumps) - SHOWN} more" * (len(jumps) > SHOWN))
        what = "neighboring frames" if self.neighbors else "frames of the same place"
        text = (
            f"jump between the {what} {listed}: the motion differs from the images in {len(jumps)} of {self.compared} "
            "pairs, so surfaces are mapped twice"
        )
        return Finding(Verdict.ERROR, "poses", text, UNPOSED)


def find_jumps(
    matcher: Matcher, poses: Sequence[Float64 | None], reading: PoseReading, neighbors: int = MAX_NEIGHBORS,
    revisits: int = REVISITS,
) -> PoseJumps:  # fmt: skip
    """Compare neighboring frames, and distant frames with matching points.

    Args:
        matcher: The matcher of the sequence.
        poses: Stored pose (4, 4) of each frame of the sequence; None = unknown.
        reading: Convention of the poses.
        neighbors: Maximum number of compared pairs of neighboring frames.
        revisits: Number of evenly spaced frames that are compared with each other.
    """
    count = len(poses)
    posed = [k for k in range(count - 1) if poses[k] is not None and poses[k + 1] is not None]
    chosen = sorted(sorted(posed, key=lambda k: -_motion(poses[k], poses[k + 1], reading))[:neighbors])
    places = [int(k) for k in np.unique(np.linspace(0, count - 1, revisits).round())] if revisits else []
    distant = [(i, j - i) for i, j in combinations(places, 2) if j > i + 1]
    nearest = [(k, _nearest(matcher, k)) for k in chosen]
    matched, blurred = ([pair for pair in nearest if (pair[1] == 1) is is_next] for is_next in (True, False))
    of_neighbors = list(_compared(matcher, matched, reading))
    of_blurred = list(_compared(matcher, blurred, reading, REVISIT_FACTOR))
    of_revisits = list(_compared(matcher, distant, reading, REVISIT_FACTOR))
    jumps = [jump for jump in of_neighbors if jump is not None]
    others = [jump for jump in of_blurred if jump is not None and not any(jump.contains(one) for one in jumps)]
    return PoseJumps(
        tuple(sorted([*jumps, *others], key=lambda jump: jump.first)),
        tuple(jump for jump in of_revisits if jump is not None),
        len(of_neighbors) + len(of_blurred) + len(of_revisits),
    )


def _nearest(matcher: Matcher, k: int) -> int:
    """Return the step from frame k to the nearest later frame with enough matched points, or 1 without one."""
    return next((step for step in STEPS if matcher.pair(k, step) is not None), 1)


def _compared(
    matcher: Matcher, pairs: Sequence[tuple[int, int]], reading: PoseReading, factor: float = 1.0
) -> Iterator[PoseJump | None]:
    """Yield the result of each pair (k, step) with poses and enough matched points; None = no jump."""
    for k, step in pairs:
        pair = matcher.pair(k, step)
        if pair is not None and pair.first.T_world_camera is not None and pair.second.T_world_camera is not None:
            yield jump_of(pair, reading, factor)


def jump_of(pair: MatchedPair, reading: PoseReading, factor: float = 1.0) -> PoseJump | None:
    """Return the jump between two frames, or None if their poses do not contradict the images.

    Args:
        pair: The frames.
        reading: Convention of the poses.
        factor: Factor of the limits.
    """
    T_second_first = motion_of(pair, reading)
    points = pair.points_first.astype(np.float64)
    apart = np.linalg.norm(transform(T_second_first, points) - transform(pair.T_second_first, points), axis=1)
    width = pair.second.camera.width
    distance, error = np.median(apart / points[:, 2]), error_of(pair, T_second_first, 1.0) / width
    if distance < factor * MAX_DISTANCE or error < factor * MIN_ERROR:
        return None
    difference = T_second_first @ inverse(pair.T_second_first)
    rotation = float(np.degrees(rotation_angle(difference[:3, :3])))
    return PoseJump(pair.first.index, pair.second.index, float(np.linalg.norm(difference[:3, 3])), rotation)


def _motion(T_world_first: Float64 | None, T_world_second: Float64 | None, reading: PoseReading) -> float:
    """Return the size of the motion between two stored poses, m plus rad."""
    assert T_world_first is not None
    assert T_world_second is not None
    moved = motion_between(T_world_first, T_world_second, reading)
    return float(np.linalg.norm(moved[:3, 3])) + rotation_angle(moved[:3, :3])
