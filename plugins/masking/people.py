"""Masking of people, and of other objects that move by themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from framework.config.validation import check_bounds, require
from framework.data import Bool, Detections, Float32, Frame, UInt8
from framework.interfaces import FrameMasking

GRID_WIDTH = 160  # maximum width of the coarse images, px
HALF_EXTENT = 0.6  # m, maximum distance of the readings of a body from their median along z
GAP, GAP_PER_DEPTH = 0.03, 0.02  # m and m per m, maximum depth difference of neighboring readings on one surface
CAMERA_TURN = 0.6  # rad/s, maximum angular speed of the camera
OVERLAP_STEP = 4  # px, step between the pixels of masks that are compared with a body
MAX_SIMILAR = 0.35  # maximum fraction of the readings around a body that have its depth
MIN_COVERED = 0.25  # minimum fraction of the followed bodies in the mask of a detection that continues a body
LONGEST_STEP = 0.5  # s, maximum time between two frames for which a body is followed
FAR = np.float32(np.inf)

Image = TypeVar("Image", Float32, UInt8)


class Bodies(NamedTuple):
    """The bodies in a frame."""

    time: float  # s, of the depth image
    depth: Float32  # (H, W) m, depth of the frame before masking
    mask: Bool  # (H, W) masked pixels
    body: Float32  # (H, W) m, depth of the bodies, 0 = none
    credit: UInt8  # (H, W) number of detector runs that may miss the body, plus 1; 0 = no body


@dataclass
class People(FrameMasking):
    """Masking of detected people, who are followed by their depth in frames without a detection.

    A body consists of the depth readings in a detected mask near their median. Readings of similar depth next to them,
    which coarse masks omit, are added. In the next frame, readings near the body at the pixels of the body belong to
    the body. At other pixels, readings must also be in front of all surfaces of the previous frame.

    A body is followed until the detector has missed it more often than expected from earlier detections. A single false
    detection is therefore followed only until the next detector run. A detection of a masked class that covers a
    followed body continues the body, regardless of the score. All detections of masked classes are removed. Other
    detections are removed if their masks cover a followed body.
    """

    classes: str = "person"  # names of the masked classes, separated by commas; unknown names are ignored
    min_score: float = 0.5  # minimum score of a detection whose depth is masked, in [0, 1]
    margin: int = 4  # width of the masked border around a body, px, in [0, 64]
    completion_distance: float = 0.1  # maximum distance of a body's readings from its detected mask, m, in [0, 1]
    max_speed: float = 2.0  # maximum speed of a body, m/s, in [0, 10]
    max_missed: int = 10  # maximum number of consecutive detector runs that miss a followed body, in [0, 254]

    def __post_init__(self) -> None:
        check_bounds(
            self, min_score=(0, 1), margin=(0, 64), completion_distance=(0, 1), max_speed=(0, 10), max_missed=(0, 254)
        )
        self._names = frozenset(filter(None, map(str.strip, self.classes.split(","))))
        require(bool(self._names), "masking.classes", repr(self.classes), "class names; choose masking=none for none")
        self._last: Bodies | None = None

    def mask(self, frame: Frame, detections: Detections) -> tuple[Frame, Detections]:
        of_class = self._of_masked_class(detections)
        starts = of_class & (detections.scores >= self.min_score)
        last, self._last = self._last, None
        if last is None and not starts.any():
            return frame, chosen(detections, ~of_class)
        followed, credit = self._followed(frame, last)
        covers = covering(detections.masks, followed)
        found = detections.masks[starts | (of_class & covers)]
        detected = self._detected(frame, found)
        followed &= ~connected(followed, detected)  # a detection replaces the last shape of its body
        if detections.detected:
            confirmed = np.minimum(2 * credit.astype(np.int32) + 1, self.max_missed + 1)
            credit = np.where(detected, confirmed, np.maximum(credit, 1) - 1).astype(np.uint8)
            followed &= credit > 0
        body = np.where(detected | followed, frame.depth, np.float32(0))
        mask = _dilated(body > 0, self.margin) | found.any(axis=0)
        if body.any():
            self._last = Bodies(frame.depth_time, frame.depth, mask, body, np.where(body > 0, credit, np.uint8(0)))
        if mask.any():
            frame = replace(frame, depth=np.where(mask, np.float32(0), frame.depth))
        return frame, chosen(detections, ~(of_class | covers))

    def _of_masked_class(self, detections: Detections) -> Bool:
        """Return True for each detection (N,) whose most likely class is masked."""
        masked = np.array([name in self._names for name in detections.classes], np.bool_)
        if not len(detections):
            return np.zeros(0, np.bool_)
        return np.asarray(masked[detections.class_probabilities.argmax(axis=1)])

    def _detected(self, frame: Frame, masks: Bool) -> Bool:
        """Return True on the bodies in masks (N, H, W), and on readings of similar depth next to them.

        A mask whose surroundings mostly have its depth contains no body, but a part of a larger surface.
        """
        bodies = np.zeros(frame.depth.shape, np.bool_)
        for mask in masks:
            body = inner_readings(mask, frame.depth)
            if not body.any():
                continue
            radius = frame.camera.fx * self.completion_distance / nearest(body)
            near = _is_near(frame.depth, body, radius, 0.0)
            around = (_lowest((body == 0).view(np.uint8), radius) == 0) & (frame.depth > 0) & ~mask
            if np.count_nonzero(near & around) <= MAX_SIMILAR * np.count_nonzero(around):
                bodies |= near | (body > 0)
        return bodies

    def _followed(self, frame: Frame, last: Bodies | None) -> tuple[Bool, UInt8]:
        """Return True on the bodies of the last frame, and the credit (H, W) of the bodies near each pixel."""
        shape = frame.depth.shape
        step = np.inf if last is None else frame.depth_time - last.time
        if last is None or last.depth.shape != shape or not 0 < step <= LONGEST_STEP:
            return np.zeros(shape, np.bool_), np.zeros(shape, np.uint8)
        turn = frame.camera.fx * CAMERA_TURN * step
        reach = self.max_speed * step
        radius = turn + frame.camera.fx * reach / nearest(last.body)
        static = np.where(last.mask | (last.depth == 0), FAR, last.depth)
        appeared = frame.depth < _lowest(static, turn) - GAP - GAP_PER_DEPTH * frame.depth
        kept = last.body > 0
        credit = np.where(kept, last.credit, ~_lowest(~last.credit, radius))
        return _is_near(frame.depth, last.body, radius, reach) & (kept | appeared), credit


def inner_readings(mask: Bool, depth: Float32) -> Float32:
    """Return the depth (H, W) of the readings in a mask near their median, 0 elsewhere.

    Masks extend beyond the outline of a body, to surfaces behind and in front of it.
    """
    readings = depth[mask & (depth > 0)]
    if not len(readings):
        return np.zeros_like(depth)
    return np.where(mask & (np.abs(depth - np.median(readings)) < HALF_EXTENT), depth, np.float32(0))


def covering(masks: Bool, body: Bool) -> Bool:
    """Return True for each mask (N, H, W) that is mostly on a body (H, W) and covers a large part of it."""
    body = body[::OVERLAP_STEP, ::OVERLAP_STEP]
    masks = masks[:, ::OVERLAP_STEP, ::OVERLAP_STEP]
    shared = np.count_nonzero(masks & body, axis=(1, 2))
    large = shared > MIN_COVERED * np.count_nonzero(body)
    return np.asarray(large & (2 * shared > np.count_nonzero(masks, axis=(1, 2))))


def chosen(detections: Detections, kept: Bool) -> Detections:
    """Return the detections for which `kept` (N,) is True."""
    if kept.all():
        return detections
    rows = {name: getattr(detections, name)[kept] for name in ("masks", "boxes", "scores", "class_probabilities")}
    embeddings = None if detections.embeddings is None else detections.embeddings[kept]
    return replace(detections, **rows, embeddings=embeddings)


def connected(mask: Bool, seeds: Bool) -> Bool:
    """Return True on the components of `mask` | `seeds` (H, W) that contain a seed."""
    _, labels = cv2.connectedComponents((mask | seeds).view(np.uint8))
    return np.asarray(np.isin(labels, np.unique(labels[seeds])))


def nearest(body: Float32) -> float:
    """Return the minimum depth of a body (H, W), m."""
    return float(body[body > 0].min())


def _is_near(depth: Float32, body: Float32, radius: float, reach: float) -> Bool:
    """Return True for readings (H, W) near a body, within `radius` px and `reach` m along z."""
    tolerance = np.float32(GAP + reach) + np.float32(GAP_PER_DEPTH) * depth
    low = _lowest(np.where(body > 0, body, FAR), radius)
    high = -_lowest(np.where(body > 0, -body, FAR), radius)
    return np.asarray((depth > 0) & (depth > low - tolerance) & (depth < high + tolerance))


def _lowest(image: Image, radius: float) -> Image:
    """Return the approximate minimum (H, W) of an image within a radius in px."""
    height, width = image.shape
    step = -(-width // GRID_WIDTH)
    side = 2 * (int(radius / step) + 1) + 1
    small = cv2.erode(np.ascontiguousarray(image[::step, ::step]), np.ones((side, side), np.uint8))
    size = small.shape[1] * step, small.shape[0] * step
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_NEAREST)[:height, :width])


def _dilated(mask: Bool, radius: int) -> Bool:
    """Return a mask (H, W) with a border of `radius` px."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.view(np.uint8), kernel).view(np.bool_))
