"""Pairs of frames with matched points for pose estimation."""

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

MAX_RATIO = 0.8  # maximum distance ratio of the best to the second-best match (Lowe 2004)
MIN_POINTS = 30  # minimum number of matches of a pair
STEPS = (1, 2, 4, 8, 16, 32)  # frames, offsets between the two frames of a pair
MAX_MOTION = 0.25  # fraction of the image width; larger steps are not tried after a pair with more motion


@dataclass(frozen=True)
class MatchedPair:
    """Two frames with M matched points."""

    first: Frame
    second: Frame
    points_first: Float32  # (M, 3) m, in the first camera
    pixels_first: Float32  # (M, 2) px
    pixels_second: Float32  # (M, 2) px
    T_second_first: Float64  # (4, 4), estimated from the matched points (PnP)

    @property
    def motion(self) -> float:
        """Median displacement of the matched points between the two images, px."""
        return float(np.median(np.linalg.norm(self.pixels_second - self.pixels_first, axis=1)))


class Matcher:
    """Matcher of frame pairs in a sequence. Unreadable frames are skipped."""

    def __init__(self, sequence: RGBDSequence) -> None:
        self.sequence = sequence
        self._extractor = FeatureExtractor()
        self._estimator = AbsolutePoseEstimator(min_inliers=MIN_POINTS)
        self._features = lru_cache(maxsize=4 * len(STEPS))(self._extract)

    def pairs(self, starts: Sequence[int], steps: Sequence[int] = STEPS) -> Iterator[MatchedPair]:
        """Yield the pairs (k, k + step) for each k in `starts`.

        The steps increase until the overlap is too small.
        """
        for k in starts:
            for step in steps:
                pair = self.pair(k, step)
                if pair is None:
                    break
                yield pair
                if pair.motion > MAX_MOTION * pair.first.camera.width:
                    break

    def pair(self, k: int, step: int) -> MatchedPair | None:
        """Return the pair of the frames k and k + step, or None if too few points match."""
        if k + step >= len(self.sequence):
            return None
        found_first, found_second = self._features(k), self._features(k + step)
        if found_first is None or found_second is None:
            return None
        (first, features_first), (second, features_second) = found_first, found_second
        matches = match(features_first.descriptors, features_second.descriptors, MAX_RATIO)
        if len(matches) < MIN_POINTS:
            return None
        in_first, in_second = matches.T
        pixels_first, pixels_second = features_first.pixels[in_first], features_second.pixels[in_second]
        points_first = back_project(first.camera, pixels_first, features_first.depth[in_first])
        pose = self._estimator.estimate(second.camera, pixels_second, points_first, features_second.depth[in_second])
        if pose is None:
            return None
        points_first, pixels_first, pixels_second = (
            array[pose.inliers] for array in (points_first, pixels_first, pixels_second)
        )
        T_second_first = inverse(pose.T_world_camera)
        return MatchedPair(first, second, points_first, pixels_first, pixels_second, T_second_first)

    def _extract(self, k: int) -> tuple[Frame, Features] | None:
        try:
            frame = self.sequence[k]
        except FrameError:
            return None
        return frame, self._extractor.extract(frame).with_depth()
