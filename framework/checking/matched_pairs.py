"""Pairs of frames that show the same things, and the points that both show: what poses are measured by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from framework.data import Float32, Float64, Frame
from framework.errors import FrameError
from framework.geometry import back_project, inverse
from framework.interfaces import RGBDSequence
from framework.tracking.absolute_pose import AbsolutePoseEstimator
from framework.tracking.features import FeatureExtractor, Features, match

MAX_RATIO = 0.8  # of a match's distance to that of the second best (Lowe 2004)
FEWEST_POINTS = 30  # of a pair that counts
STEPS = (1, 2, 4, 8, 16, 32)  # frames from the first of a pair to the second
FARTHEST_APART = 0.25  # of the image's width: a pair whose points move farther is the last from its first frame


@dataclass(frozen=True)
class MatchedPair:
    """Two frames, and M points that both show, as the images alone tell."""

    first: Frame
    second: Frame
    step: int  # from the one to the other, in frames of the sequence
    points_first: Float32  # (M, 3) m, in the first camera
    pixels_first: Float32  # (M, 2)
    pixels_second: Float32  # (M, 2)
    T_second_first: Float64  # (4, 4) that the images tell: PnP of these points

    @property
    def motion(self) -> float:
        """px, how far half of the points move at least."""
        return float(np.median(np.linalg.norm(self.pixels_second - self.pixels_first, axis=1)))


class Matcher:
    """Finds `MatchedPair`s in a sequence; a frame that cannot be read has none."""

    def __init__(self, sequence: RGBDSequence) -> None:
        self.sequence = sequence
        self._extractor = FeatureExtractor()
        self._estimator = AbsolutePoseEstimator(min_inliers=FEWEST_POINTS)
        self._seen = lru_cache(maxsize=4 * len(STEPS))(self._look)

    def pairs(self, starts: Sequence[int], steps: Sequence[int] = STEPS) -> Iterator[MatchedPair]:
        """Pairs from each of the positions `starts`, ever farther apart until they show too little in common."""
        for k in starts:
            for step in steps:
                pair = self.pair(k, step)
                if pair is None:
                    break
                yield pair
                if pair.motion > FARTHEST_APART * pair.first.camera.width:
                    break

    def pair(self, k: int, step: int) -> MatchedPair | None:
        """Frames k and k + step of the sequence, None where too few of their points match."""
        if k + step >= len(self.sequence):
            return None
        first, second = self._seen(k), self._seen(k + step)
        if first is None or second is None:
            return None
        (frame, features), (other, found) = first, second
        matches = match(features.descriptors, found.descriptors, MAX_RATIO)
        if len(matches) < FEWEST_POINTS:
            return None
        pixels_first, pixels_second = features.pixels[matches[:, 0]], found.pixels[matches[:, 1]]
        points_first = back_project(frame.camera, pixels_first, features.depth[matches[:, 0]])
        pose = self._estimator.estimate(other.camera, pixels_second, points_first, found.depth[matches[:, 1]])
        if pose is None:
            return None
        seen = pose.inliers
        return MatchedPair(
            frame,
            other,
            step,
            points_first[seen],
            pixels_first[seen],
            pixels_second[seen],
            inverse(pose.T_world_camera),
        )

    def _look(self, k: int) -> tuple[Frame, Features] | None:
        try:
            frame = self.sequence[k]
        except FrameError:
            return None
        return frame, self._extractor.extract(frame).with_depth()
