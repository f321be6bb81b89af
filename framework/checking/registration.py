"""Check of the registration of color and depth in space and time.

Depth edges must coincide with color edges. The check compares depth edges with color gradients. It shifts and scales
the depth edges, and also tries depth edges of nearby frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from framework.checking import Finding, Verdict
from framework.data import Bool, Float32, Frame
from framework.errors import FrameError
from framework.interfaces import RGBDSequence
from framework.tracking.color_delay import MAX_GRADIENT
from framework.tracking.color_delay_kernels import DEPTH_STEP

WIDTH = 320  # px, width of the compared images
SEARCHED_SHIFT = 16  # px at WIDTH, maximum searched shift in both directions
MAX_DELAY = 6  # frames, maximum searched delay in both directions
ZOOMS = (0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.11, 1.18, 1.25)  # scale of the depth image about its center
MIN_FRAMES = 3  # minimum number of compared frames
MIN_EDGES = 20.0  # px at WIDTH; frames with fewer edge pixels are ignored
MIN_STRENGTH_RATIO = 1.2  # minimum ratio of the strength of another alignment to that of the stored alignment
MAX_SHIFT = 0.007  # fraction of the image width, due to lenses and rolling shutters; real recordings have 0.003
MIN_STRENGTH = 0.25  # standard deviations, minimum strength of a match that is not random


@dataclass(frozen=True)
class EdgeAlignment:
    """Agreement of color edges with depth edges at one delay and scale."""

    delay: int  # frames; positive = depth images from later frames
    zoom: float  # scale of the depth image
    strength: float  # mean gradient at the depth edges for the best shift, in standard deviations
    # best shift of the depth edges (x to the right, y down), as fractions of the image width
    shift: tuple[float, float]

    @property
    def moved(self) -> bool:
        """True if the best shift is significant."""
        return max(map(abs, self.shift)) > MAX_SHIFT


class EdgeComparison:
    """Comparison of color and depth edges in selected frames of a sequence.

    Unreadable frames are skipped.
    """

    def __init__(self, sequence: RGBDSequence, chosen: Sequence[int]) -> None:
        self.sequence = sequence
        self.chosen = chosen
        self._edges = lru_cache(maxsize=None)(self._find_edges)

    def alignments(self, candidates: Iterable[tuple[int, float]]) -> list[EdgeAlignment]:
        """Return the alignment for each candidate (delay in frames, zoom) with enough edges."""
        found = []
        for delay, zoom in candidates:
            pairs = [(k, k + delay) for k in self.chosen if 0 <= k + delay < len(self.sequence)]
            correlations = [self._correlation(color, depth, zoom) for color, depth in pairs]
            # repeated images count once
            known = list({one.tobytes(): one for one in correlations if one is not None}.values())
            if len(known) < MIN_FRAMES:
                continue
            mean = np.mean(known, axis=0)
            row, column = np.unravel_index(int(mean.argmax()), mean.shape)
            shift = (int(column) - SEARCHED_SHIFT) / WIDTH, (int(row) - SEARCHED_SHIFT) / WIDTH
            found.append(EdgeAlignment(delay, zoom, float(mean.max()), shift))
        return found

    def _correlation(self, of_color: int, of_depth: int, zoom: float) -> Float32 | None:
        """Return the mean color gradient at the depth edges for each shift, or None without usable edges.

        The color and depth images are those of the frames `of_color` and `of_depth`.
        """
        color, depth = self._edges(of_color), self._edges(of_depth)
        if color is None or depth is None:
            return None
        gradient, edges = color[0], depth[1]
        if zoom != 1.0:
            height, width = edges.shape
            about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0, zoom)
            edges = np.asarray(cv2.warpAffine(edges, about, (width, height)), np.float32)
        if edges.sum() < MIN_EDGES:
            return None
        L = SEARCHED_SHIFT
        padded = cv2.copyMakeBorder(gradient, L, L, L, L, cv2.BORDER_CONSTANT, value=0.0)
        return np.asarray(cv2.matchTemplate(padded, edges, cv2.TM_CCORR) / edges.sum(), np.float32)

    def _find_edges(self, k: int) -> tuple[Float32, Float32] | None:
        """Return the normalized color gradient and the depth edges of a frame, or None for an unusable frame."""
        try:
            frame = self.sequence[k]
        except FrameError:
            return None
        size = (WIDTH, max(1, round(WIDTH * frame.camera.height / frame.camera.width)))
        gradient = cv2.resize(np.minimum(color_gradient(frame), MAX_GRADIENT), size, interpolation=cv2.INTER_AREA)
        edges = cv2.resize(depth_edges(frame.depth).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        deviation = float(gradient.std())
        if deviation == 0:
            return None
        return (gradient - gradient.mean()) / deviation, edges


def color_gradient(frame: Frame) -> Float32:
    """Return the gradient magnitude (H, W) of the gray image, 8 times the difference per px."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    # the weights of the 3x3 Sobel filter add up to 8
    return np.asarray(np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)), np.float32)


def depth_edges(depth: Float32) -> Bool:
    """Return the mask (H, W) of pixels on the nearer side of a depth step."""
    edges = np.zeros(depth.shape, np.bool_)
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = depth[one], depth[other]
        edges[one] |= (a > 0) & (b > a * (1 + DEPTH_STEP))
        edges[other] |= (b > 0) & (a > b * (1 + DEPTH_STEP))
    return edges


def judge(
    by_delay: Sequence[EdgeAlignment], by_zoom: Sequence[EdgeAlignment], applied_delay: int, step: float
) -> tuple[Finding, int]:
    """Return the check result, and the delay of the depth images in frames.

    Args:
        by_delay: Alignments at each delay.
        by_zoom: Alignments at each scale, with the best delay.
        applied_delay: Configured delay, frames.
        step: Image motion per frame, as a fraction of the image width. A shift of at most half of it may be due to a
            time offset.
    """
    subject = "color and depth"
    here = next((alignment for alignment in by_delay if alignment.delay == 0), None)
    if here is None:
        return Finding(Verdict.UNKNOWN, subject, "too few frames or depth edges for a comparison"), 0
    best = max(by_delay, key=lambda alignment: alignment.strength)
    clearly = best.strength > MIN_STRENGTH_RATIO * here.strength or (here.moved and not best.moved)
    if best.delay and clearly and best.strength > MIN_STRENGTH:
        frames = f"{abs(best.delay)} frame{'s' * (abs(best.delay) > 1)}"
        text = f"depth images are {frames} {'late' if best.delay > 0 else 'early'}"
        return Finding(Verdict.ERROR, subject, text, f"dataset.depth_delay={applied_delay + best.delay}"), best.delay
    zoomed = max(by_zoom, key=lambda alignment: alignment.strength, default=here)
    if zoomed.strength < MIN_STRENGTH:
        return Finding(Verdict.UNKNOWN, subject, "edges do not match; the images may lack contrast"), 0
    if zoomed.strength < MIN_STRENGTH_RATIO * here.strength:
        zoomed = here
    apart = max(map(abs, zoomed.shift))
    if zoomed.zoom == 1.0 and zoomed.moved and apart <= step / 2:
        text = (
            f"edges are {apart:.1%} of the width apart, with an image motion of {step:.1%} per frame: "
            "not synchronized or not registered; run the check on a part with slower camera motion"
        )
        return Finding(Verdict.NOTE, subject, text), 0
    if zoomed.zoom != 1.0 or zoomed.moved:
        x, y = (100 * fraction for fraction in zoomed.shift)
        text = (
            f"depth is not registered to color: depth edges fit best {x:+.1f}% of the width to the right and "
            f"{y:+.1f}% down, scaled by {zoomed.zoom:g}; enable the alignment of depth to color in the camera's driver"
        )
        return Finding(Verdict.ERROR, subject, text), 0
    return Finding(Verdict.FINE, subject, "edges match without a delay"), 0
