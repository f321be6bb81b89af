"""Whether colour and depth show the same moment from the same place: where surfaces end, colours change.

Depth edges are laid over the colours' gradients, moved by so many pixels, zoomed, and taken from a frame nearby.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from framework.checking.finding import Finding, Verdict
from framework.data import Bool, Float32, Frame
from framework.errors import FrameError
from framework.interfaces import RGBDSequence

WIDTH = 320  # px, of the images that are compared
LONGEST_SHIFT = 16  # of these px, to either side
LONGEST_DELAY = 6  # frames, to either side
ZOOMS = (0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.11, 1.18, 1.25)  # of the depth image about its centre
DEPTH_STEP = 0.05  # of the depth: a larger one is where a surface ends
STRONG = 200.0  # Sobel's units: stronger gradients count as much, so that a lamp does not decide
FEWEST_FRAMES = 3
FEWEST_EDGES = 20.0  # px of WIDTH: a frame with fewer says nothing
CLEARLY = 1.2  # times the agreement as it is, that another one must have
LARGEST_SHIFT = 0.007  # of the image's width, that lenses and rolling shutters leave; real recordings have 0.003
WEAKEST = 0.25  # standard deviations of the gradient at depth edges: what chance gives


@dataclass(frozen=True)
class EdgeAlignment:
    """How well the depth edges lie on colour edges when the depth image is that of `delay` frames later, zoomed."""

    delay: int  # frames
    zoom: float
    strength: float  # standard deviations of the gradient above its mean, at the best shift
    shift: tuple[float, float]  # (x, y), the best one, in shares of the image's width
    frames: int

    @property
    def moved(self) -> bool:
        """Whether the edges fit elsewhere than where they are."""
        return max(map(abs, self.shift)) > LARGEST_SHIFT


class EdgeComparison:
    """Compares the edges of chosen frames of a sequence; a frame that cannot be read is left out."""

    def __init__(self, sequence: RGBDSequence, chosen: Sequence[int]) -> None:
        self.sequence = sequence
        self.chosen = chosen
        self._edges = lru_cache(maxsize=None)(self._look)

    def agreement(self, delay: int = 0, zoom: float = 1.0) -> EdgeAlignment | None:
        """None where too few frames have edges."""
        surfaces = [self._surface(k, k + delay, zoom) for k in self.chosen if 0 <= k + delay < len(self.sequence)]
        seen = [surface for surface in surfaces if surface is not None]
        if len(seen) < FEWEST_FRAMES:
            return None
        mean = np.mean(seen, axis=0)
        row, column = np.unravel_index(int(mean.argmax()), mean.shape)
        shift = (int(column) - LONGEST_SHIFT) / WIDTH, (int(row) - LONGEST_SHIFT) / WIDTH
        return EdgeAlignment(delay, zoom, float(mean.max()), shift, len(seen))

    def by_delay(self) -> list[EdgeAlignment]:
        """Of each delay that can be told."""
        found = [self.agreement(delay) for delay in range(-LONGEST_DELAY, LONGEST_DELAY + 1)]
        return [agreement for agreement in found if agreement is not None]

    def by_zoom(self, delay: int) -> list[EdgeAlignment]:
        found = [self.agreement(delay, zoom) for zoom in ZOOMS]
        return [agreement for agreement in found if agreement is not None]

    def _surface(self, of_color: int, of_depth: int, zoom: float) -> Float32 | None:
        """The mean gradient (2 L + 1, 2 L + 1) at the depth edges, by how far these are moved, L px at most."""
        color, depth = self._edges(of_color), self._edges(of_depth)
        if color is None or depth is None:
            return None
        gradient, edges = color[0], depth[1]
        if zoom != 1.0:
            height, width = edges.shape
            about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0, zoom)
            edges = np.asarray(cv2.warpAffine(edges, about, (width, height)), np.float32)
        if edges.sum() < FEWEST_EDGES:
            return None
        L = LONGEST_SHIFT
        padded = cv2.copyMakeBorder(gradient, L, L, L, L, cv2.BORDER_CONSTANT, value=0.0)
        return np.asarray(cv2.matchTemplate(padded, edges, cv2.TM_CCORR) / edges.sum(), np.float32)

    def _look(self, k: int) -> tuple[Float32, Float32] | None:
        """The colours' gradient, of mean 0 and deviation 1, and the depth edges, both (h, WIDTH)."""
        try:
            frame = self.sequence[k]
        except FrameError:
            return None
        size = (WIDTH, max(1, round(WIDTH * frame.camera.height / frame.camera.width)))
        gradient = cv2.resize(np.minimum(color_gradient(frame), STRONG), size, interpolation=cv2.INTER_AREA)
        edges = cv2.resize(depth_edges(frame.depth).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        deviation = float(gradient.std())
        if deviation == 0:
            return None
        return (gradient - gradient.mean()) / deviation, edges


def color_gradient(frame: Frame) -> Float32:
    """(H, W) the length of the grey values' gradient, in Sobel's units."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    return np.asarray(np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)), np.float32)


def depth_edges(depth: Float32) -> Bool:
    """(H, W) where a surface ends in front of a farther one: the nearer side of each step between two readings."""
    edges = np.zeros(depth.shape, np.bool_)
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = depth[one], depth[other]
        edges[one] |= (a > 0) & (b > a * (1 + DEPTH_STEP))
        edges[other] |= (b > 0) & (a > b * (1 + DEPTH_STEP))
    return edges


def judge(
    by_delay: Sequence[EdgeAlignment], by_zoom: Sequence[EdgeAlignment], applied_delay: int, step: float
) -> tuple[Finding, int]:
    """What the agreements say, and by how many frames the depth images must be taken later.

    `by_zoom` is of the best delay; `applied_delay` is the one that the recording is read with; `step` is how far the
    image moves from frame to frame, in shares of its width: a shift of less than half of it may be of another moment.
    """
    subject = "colour and depth"
    here = next((agreement for agreement in by_delay if agreement.delay == 0), None)
    if here is None:
        return Finding(
            Verdict.UNKNOWN, subject, "too few frames, or surfaces that end in them, to compare their edges"
        ), 0
    best = max(by_delay, key=lambda agreement: agreement.strength)
    clearly = best.strength > CLEARLY * here.strength or (here.moved and not best.moved)
    if best.delay and clearly and best.strength > WEAKEST:
        text = f"depth images come {abs(best.delay)} frames {'late' if best.delay > 0 else 'early'}"
        return Finding(Verdict.FAULT, subject, text, f"dataset.depth_delay={applied_delay + best.delay}"), best.delay
    zoomed = max(by_zoom, key=lambda agreement: agreement.strength, default=here)
    if zoomed.strength < WEAKEST:
        return Finding(Verdict.UNKNOWN, subject, "their edges agree nowhere, which may be for want of contrast"), 0
    if zoomed.strength < CLEARLY * here.strength:
        zoomed = here
    apart = max(map(abs, zoomed.shift))
    if zoomed.zoom == 1.0 and zoomed.moved and apart <= step / 2:
        text = (
            f"their edges lie {100 * apart:.1f} % of the width apart, and the image moves {100 * step:.1f} % a "
            "frame: they are not of the same moment, or not registered; look where the camera is slower"
        )
        return Finding(Verdict.NOTE, subject, text), 0
    if zoomed.zoom != 1.0 or zoomed.moved:
        x, y = (100 * share for share in zoomed.shift)
        text = (
            "depth is not registered to colour: its edges fit best "
            f"{x:+.1f} % of the width to the right and {y:+.1f} % down, {zoomed.zoom:g} times as large; have the "
            "camera's driver align depth to colour"
        )
        return Finding(Verdict.FAULT, subject, text), 0
    return Finding(Verdict.FINE, subject, "their edges lie on each other, and are of the same frame"), 0
