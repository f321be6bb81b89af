"""Detection of a delay between poses and images.

A delay is only observable if the camera motion changes, because the relative poses of frame pairs must depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.checking.pose_fit import ALIKE, MAX_RELATIVE_ERROR, MIN_MOTION, PoseFit, error_of, motion_between
from framework.data import Float64

MAX_DELAY = 6  # frames, in both directions; one more is tried, to detect an error that is still decreasing
# maximum ratio of the mean errors with and without the delay; in real recordings, wrong delays have at least 0.88
MAX_ERROR_RATIO = 0.75
MIN_GAIN = 1 / 640  # fraction of the image width, minimum error difference of a counted pair
MIN_IMPROVED_FRACTION = 0.75  # minimum fraction of improved pairs among the counted pairs
MIN_PAIRS = 5  # minimum number of counted pairs


@dataclass(frozen=True)
class PoseDelay:
    """A delay of the poses relative to the images."""

    frames: int  # delay in frames; negative = early
    error: float  # px, mean over the pairs with the stored poses
    delayed_error: float  # px, mean over the pairs with the poses shifted by the delay
    pairs: int  # number of pairs
    alike: tuple[int, ...]  # frames, other delays that fit equally well

    def finding(self, applied: int, step: float) -> Finding:
        """Return the check result.

        Args:
            applied: Configured delay, frames.
            step: Frame interval, s.
        """
        count, (when, where) = abs(self.frames), ("late", "later") if self.frames > 0 else ("early", "earlier")
        frames = f"{count} frame{'s' * (count > 1)}"
        text = (
            f"{frames} {when} ({count * step:.3f} s): mean reprojection error of {self.pairs} pairs of frames is "
            f"{self.error:.1f} px, and {self.delayed_error:.1f} px with the poses from {frames} {where}"
        )
        if self.alike:
            others = " or ".join(f"dataset.pose_delay={applied + other}" for other in self.alike)
            text += f"; {others} fits this camera motion equally well"
        return Finding(Verdict.ERROR, "poses", text, f"dataset.pose_delay={applied + self.frames}")


def find_delay(
    pairs: Sequence[MatchedPair], poses: Sequence[Float64 | None], fits: Sequence[PoseFit]
) -> PoseDelay | None:
    """Return the delay of the poses, or None without a significant delay.

    Args:
        pairs: Pairs of frames.
        poses: Stored pose (4, 4) of each frame by `Frame.index`; None = unknown.
        fits: Candidate pose conventions. The delay is that of the best-fitting convention.
    """
    known = {k: T for k, T in enumerate(poses) if T is not None}
    delays = range(-MAX_DELAY - 1, MAX_DELAY + 2)
    informative = [
        pair
        for pair in pairs
        if pair.motion > MIN_MOTION * pair.first.camera.width
        and all(frame.index + delay in known for frame in (pair.first, pair.second) for delay in delays)
    ]
    if len(informative) < MIN_PAIRS:
        return None
    errors = np.array(
        [[[_error(pair, known, fit, delay) for pair in informative] for delay in delays] for fit in fits]
    )  # (fits, delays, pairs)
    means = errors.mean(axis=2)
    now, (fit, best) = int(means[:, MAX_DELAY + 1].argmin()), np.unravel_index(int(means.argmin()), means.shape)
    as_stored, shifted = errors[now, MAX_DELAY + 1], errors[fit, best]
    gains = as_stored - shifted
    counted = np.abs(gains) > MIN_GAIN * informative[0].first.camera.width
    motion = float(np.median([pair.motion for pair in informative]))
    if (
        abs(delays[best]) > MAX_DELAY
        or shifted.mean() > MAX_ERROR_RATIO * as_stored.mean()
        or counted.sum() < MIN_PAIRS
        or (gains[counted] > 0).mean() < MIN_IMPROVED_FRACTION
        or np.median(shifted) > MAX_RELATIVE_ERROR * motion
    ):
        return None
    alike = np.flatnonzero(means[fit] <= ALIKE * means[fit, best])
    others = tuple(delays[k] for k in alike if k != best)
    return PoseDelay(delays[best], float(as_stored.mean()), float(shifted.mean()), len(informative), others)


def delayed(pair: MatchedPair, poses: Sequence[Float64 | None], delay: int) -> MatchedPair:
    """Return a pair with the poses from `delay` frames later."""
    stored = dict(enumerate(poses))
    first, second = (
        replace(frame, T_world_camera=stored.get(frame.index + delay)) for frame in (pair.first, pair.second)
    )
    return replace(pair, first=first, second=second)


def _error(pair: MatchedPair, poses: Mapping[int, Float64], fit: PoseFit, delay: int) -> float:
    """Return the error of a pair with the poses from `delay` frames later, px."""
    T_second_first = motion_between(poses[pair.first.index + delay], poses[pair.second.index + delay], fit.reading)
    return error_of(pair, T_second_first, fit.depth_factor)
