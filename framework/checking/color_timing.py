"""Check of the delay between color and depth."""

from __future__ import annotations

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import Matcher
from framework.data import DelayEstimate
from framework.errors import FrameError
from framework.geometry import inverse
from framework.tracking.color_delay import DelayEstimator, is_usable

PARTS, PART_FRAMES = 4, 30  # number of parts of the sequence, and number of frames in each part
SUBJECT = "color delay"
SHORT = 0.003  # s, a shorter delay has no visible effect


def check_color_delay(matcher: Matcher) -> Finding:
    """Check the delay of color images relative to depth images."""
    delay = matcher.sequence.constant_color_delay()
    if delay is not None:
        return Finding(Verdict.FINE, SUBJECT, f"{1e3 * delay:g} ms, as set; dataset.color_delay=AUTO estimates it")
    estimate = estimate_delay(matcher)
    if not is_usable(estimate):
        text = "unknown, because the camera rotates too slowly or at a constant rate, or depth has too few edges"
        if estimate.known:
            text += (
                f" (estimate: {1e3 * estimate.seconds:.0f} ms, standard deviation {1e3 * estimate.deviation:.0f} ms)"
            )
        return Finding(Verdict.UNKNOWN, SUBJECT, text)
    text = (
        f"color is {1e3 * estimate.seconds:.1f} ms after depth for images with equal timestamps (standard deviation "
        f"{1e3 * estimate.deviation:.1f} ms, {estimate.frames} frames)"
    )
    return Finding(Verdict.FINE, SUBJECT, text if abs(estimate.seconds) < SHORT else f"{text}; corrected in the run")


def estimate_delay(matcher: Matcher) -> DelayEstimate:
    """Estimate the delay of color images relative to depth images from parts of a sequence.

    For frames without a pose, the camera motion is estimated from matched points.
    """
    sequence, estimator = matcher.sequence, DelayEstimator()
    length = min(PART_FRAMES, len(sequence))
    for start in np.unique(np.linspace(0, len(sequence) - length, PARTS).astype(int)).tolist():
        estimator.interrupt()
        T_world_camera = np.eye(4)
        for k in range(start, start + length):
            try:
                frame = sequence[k]
            except FrameError:
                estimator.interrupt()
                continue
            if frame.T_world_camera is not None:
                estimator.add(frame, frame.T_world_camera)
                continue
            estimator.add(frame, T_world_camera)
            pair = matcher.pair(k, 1)
            if pair is None:
                estimator.interrupt()
            else:
                T_world_camera = T_world_camera @ inverse(pair.T_second_first)
    return estimator.estimate
