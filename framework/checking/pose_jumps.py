"""Jumps of stored poses between neighboring frames, and between frames that see the same place again.

The camera motion between two frames is estimated from matched points, and compared with the motion in the poses. A pair
contradicts the poses if both motions move the points to clearly different places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair, Matcher
from framework.checking.pose_fit import UNPOSED, error_of, motion_between, motion_of
from framework.data import Float64, Frame
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
class ComparedPair:
    """A pair of frames whose motion in the poses is compared with the motion in the images."""

    pair: MatchedPair
    factor: float = 1.0  # factor of the limits
    is_revisit: bool = False  # True for distant frames


@dataclass(frozen=True)
class PoseJumps:
    """The result for all compared pairs of frames."""

    pairs: tuple[ComparedPair, ...]  # without images
    neighbors: tuple[PoseJump, ...]  # between neighboring frames, in the order of the sequence
    revisits: tuple[PoseJump, ...]  # between distant frames

    @classmethod
    def of(cls, pairs: Sequence[ComparedPair], reading: PoseReading) -> PoseJumps:
        """Return the jumps between compared frames with a convention of the poses."""
        found = [(one, jump_of(one.pair, reading, one.factor)) for one in pairs]
        jumps = [(one, jump) for one, jump in found if jump is not None]
        next_frames = [jump for one, jump in jumps if one.factor == 1.0]
        neighbors = [
            jump
            for one, jump in jumps
            if not one.is_revisit and (jump in next_frames or not any(jump.contains(other) for other in next_frames))
        ]
        return cls(tuple(pairs), tuple(neighbors), tuple(jump for one, jump in jumps if one.is_revisit))

    @property
    def count(self) -> int:
        return len(self.neighbors) + len(self.revisits)

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
            f"jump between the {what} {listed}: the motion differs from the images in {len(jumps)} of "
            f"{len(self.pairs)} pairs, so surfaces are mapped twice"
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
    compared = [_neighbors(matcher, k) for k in chosen]
    compared += [_compared(matcher, i, j - i, is_revisit=True) for i, j in combinations(places, 2) if j > i + 1]
    return PoseJumps.of([one for one in compared if one is not None], reading)


def _neighbors(matcher: Matcher, k: int) -> ComparedPair | None:
    """Return frame k with the nearest later frame that has enough matched points, or None without one."""
    return next((one for step in STEPS if (one := _compared(matcher, k, step)) is not None), None)


def _compared(matcher: Matcher, k: int, step: int, is_revisit: bool = False) -> ComparedPair | None:
    """Return the frames k and k + step, or None without poses or enough matched points."""
    pair = matcher.pair(k, step)
    if pair is None or pair.first.T_world_camera is None or pair.second.T_world_camera is None:
        return None
    slim = replace(pair, first=_without_images(pair.first), second=_without_images(pair.second))
    return ComparedPair(slim, 1.0 if step == 1 and not is_revisit else REVISIT_FACTOR, is_revisit)


def _without_images(frame: Frame) -> Frame:
    """Return a frame with images of zeros that need no memory."""
    color, depth = np.broadcast_to(np.uint8(0), frame.color.shape), np.broadcast_to(np.float32(0), frame.depth.shape)
    return replace(frame, color=color, depth=depth, truth=None)


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
