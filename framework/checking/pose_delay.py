"""Whether the poses are those of frames a little later or earlier, and then move points where the images show them.

A camera that moves as it did a moment ago tells nothing: only pairs of frames during which it does otherwise do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from framework.checking.finding import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.checking.pose_fit import ALIKE, POOR, SHORTEST_MOTION, PoseFit, error_of, motion_between
from framework.data import Float64

LONGEST_DELAY = 6  # frames, to either side; one more is tried: an error that still falls there has its least elsewhere
CLEARLY = 0.75  # times the mean error as it is; other delays of kitchen, flat, desk and ScanNet have 0.88 and more
TELLS = 1 / 640  # of the image's width: pairs whose errors differ by less do not tell
MOST = 0.75  # of the pairs that tell must be better
FEWEST_PAIRS = 5  # that tell


@dataclass(frozen=True)
class PoseDelay:
    """Poses that come late."""

    frames: int  # by how many; negative = early
    error: float  # px, the mean over the pairs of frames as the poses are
    delayed_error: float  # px, with those that belong to them
    pairs: int
    alike: tuple[int, ...]  # other delays that fit as well

    def finding(self, applied: int, step: float) -> Finding:
        """What it says of a recording that is read with the delay `applied`, whose frames are `step` s apart."""
        count, (when, where) = abs(self.frames), ("late", "later") if self.frames > 0 else ("early", "before")
        frames = f"{count} frame{'s' * (count > 1)}"
        text = (
            f"they come {frames} {when} ({count * step:.3f} s): in {self.pairs} pairs of frames, points lie "
            f"{self.error:.1f} px from where they belong on average, and {self.delayed_error:.1f} px by the poses of "
            f"{frames} {where}"
        )
        if self.alike:
            others = " or ".join(f"dataset.pose_delay={applied + other}" for other in self.alike)
            text += f"; {others} fits as well, as the camera moves"
        return Finding(Verdict.FAULT, "poses", text, f"dataset.pose_delay={applied + self.frames}")


def find_delay(
    pairs: Sequence[MatchedPair], poses: Sequence[Float64 | None], fits: Sequence[PoseFit]
) -> PoseDelay | None:
    """By how much the poses of the pairs are late, read in the best of some ways; None where they are not, plainly.

    `poses` (F) are those of all frames by `Frame.index`, (4, 4) each as it is stored, None = not known.
    """
    delays = range(-LONGEST_DELAY - 1, LONGEST_DELAY + 2)
    telling = [
        pair
        for pair in pairs
        if pair.motion > SHORTEST_MOTION * pair.first.camera.width
        and all(_pose(poses, frame.index + d) is not None for frame in (pair.first, pair.second) for d in delays)
    ]
    if len(telling) < FEWEST_PAIRS:
        return None
    errors = np.array(
        [[_errors(telling, poses, fit, delay) for delay in delays] for fit in fits]
    )  # (fits, delays, pairs)
    means = errors.mean(axis=2)
    now, (fit, best) = int(means[:, LONGEST_DELAY + 1].argmin()), np.unravel_index(int(means.argmin()), means.shape)
    as_it_is, delayed = errors[now, LONGEST_DELAY + 1], errors[fit, best]
    gains = as_it_is - delayed
    tells = np.abs(gains) > TELLS * telling[0].first.camera.width
    motion = float(np.median([pair.motion for pair in telling]))
    if (
        abs(delays[best]) > LONGEST_DELAY
        or delayed.mean() > CLEARLY * as_it_is.mean()
        or tells.sum() < FEWEST_PAIRS
        or (gains[tells] > 0).mean() < MOST
        or np.median(delayed) > POOR * motion
    ):
        return None
    alike = np.flatnonzero(means[fit] <= ALIKE * means[fit, best])
    others = tuple(delays[k] for k in alike if k != best)
    return PoseDelay(delays[best], float(as_it_is.mean()), float(delayed.mean()), len(telling), others)


def delayed(pair: MatchedPair, poses: Sequence[Float64 | None], delay: int) -> MatchedPair:
    """The pair with the poses of so many frames later."""
    first, second = (
        replace(frame, T_world_camera=_pose(poses, frame.index + delay)) for frame in (pair.first, pair.second)
    )
    return replace(pair, first=first, second=second)


def _pose(poses: Sequence[Float64 | None], k: int) -> Float64 | None:
    return poses[k] if 0 <= k < len(poses) else None


def _errors(pairs: Sequence[MatchedPair], poses: Sequence[Float64 | None], fit: PoseFit, delay: int) -> list[float]:
    """px, of each pair with the poses of so many frames later, which are known."""
    errors = []
    for pair in pairs:
        T_world_first, T_world_second = poses[pair.first.index + delay], poses[pair.second.index + delay]
        assert T_world_first is not None
        assert T_world_second is not None
        T_second_first = motion_between(T_world_first, T_world_second, fit.reading)
        errors.append(error_of(pair, T_second_first, fit.depth_factor))
    return errors
