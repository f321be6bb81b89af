"""Check of the delay between color and depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import Matcher
from framework.data import DelayEstimate, Float64, Frame
from framework.errors import FrameError
from framework.geometry import inverse
from framework.interfaces import RGBDSequence
from framework.tracking.color_delay import DelayEstimator, is_usable

PARTS, PART_FRAMES = 4, 30  # parts of the sequence, and frames of each part
SUBJECT = "color delay"
SHORT = 0.003  # s, a shorter delay has no visible effect


def check_color_delay(sequence: RGBDSequence, matcher: Matcher) -> Finding:
    """Return the finding about the delay of color, from the given or matched motion in parts of a sequence."""
    if sequence.constant_color_delay() is not None:
        delay = sequence.constant_color_delay() or 0.0
        return Finding(Verdict.FINE, SUBJECT, f"{1e3 * delay:g} ms, as set; dataset.color_delay=AUTO estimates it")
    estimate = estimate_delay(sequence, matcher)
    if not is_usable(estimate):
        text = "unknown, because the camera turns too slowly or at a constant rate, or depth has too few edges"
        if estimate.known:
            text += (
                f" (estimate: {1e3 * estimate.seconds:.0f} ms, standard deviation {1e3 * estimate.deviation:.0f} ms)"
            )
        return Finding(Verdict.UNKNOWN, SUBJECT, text)
    text = (
        f"color is {1e3 * estimate.seconds:.1f} ms after depth with equal timestamps (standard deviation "
        f"{1e3 * estimate.deviation:.1f} ms, {estimate.frames} frames)"
    )
    return Finding(Verdict.FINE, SUBJECT, text if abs(estimate.seconds) < SHORT else f"{text}; corrected in the run")


def estimate_delay(sequence: RGBDSequence, matcher: Matcher) -> DelayEstimate:
    """Return the delay estimated from parts of a sequence."""
    estimator = DelayEstimator()
    length = min(PART_FRAMES, len(sequence))
    for start in np.unique(np.linspace(0, len(sequence) - length, PARTS).astype(int)).tolist():
        estimator.interrupt()
        for frame, T_world_camera in _tracked(sequence, matcher, range(start, start + length)):
            if frame is None:
                estimator.interrupt()
            else:
                estimator.add(frame, T_world_camera)
    return estimator.estimate


def _tracked(sequence: RGBDSequence, matcher: Matcher, numbers: Sequence[int]) -> list[tuple[Frame | None, Float64]]:
    """Return the frames with given poses, or with poses from matched points; None = no frame or no pose."""
    T_world_camera = np.eye(4)
    found: list[tuple[Frame | None, Float64]] = []
    for k in numbers:
        try:
            frame = sequence[k]
        except FrameError:
            found.append((None, T_world_camera))
            continue
        if frame.T_world_camera is not None:
            found.append((frame, frame.T_world_camera))
            continue
        pair = matcher.pair(k, 1)
        found.append((frame, T_world_camera))
        if pair is None:
            found.append((None, T_world_camera))
        else:
            T_world_camera = T_world_camera @ inverse(pair.T_second_first)
    return found
