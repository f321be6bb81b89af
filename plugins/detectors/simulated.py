"""A detector of chosen quality: the ground truth, degraded by a seeded model of the errors that real detectors make."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numba import njit

from framework.data import Bool, Detections, Float32, Float64, Frame, Int32
from framework.detection.masks import paste_masks, tight_boxes
from framework.detection.truth import TrueInstances, true_instances
from framework.interfaces import Detector
from framework.label_spaces import COCO
from framework.parameters import require

# fmt: off
LOOKALIKES = (
    ("chair", "couch", "bench", "bed", "toilet"), ("dining table", "bench", "bed"),
    ("tv", "laptop", "microwave", "oven", "refrigerator"), ("laptop", "keyboard", "book", "cell phone", "remote"),
    ("cup", "bottle", "wine glass", "vase", "bowl"), ("vase", "potted plant"), ("sink", "toilet", "bowl"),
    ("backpack", "handbag", "suitcase"), ("clock", "sports ball", "frisbee"), ("teddy bear", "dog", "cat", "person"),
    ("knife", "fork", "spoon", "scissors", "toothbrush"), ("car", "truck", "bus", "train"), ("bicycle", "motorcycle"),
)
# fmt: on
"""COCO classes that are taken for each other, chosen from what detectors are seen to confuse indoors."""

LOOKALIKE_SHARE = 0.8  # of the probability lost by the true class; the rest is spread over all other classes
EVEN_SHARE = 0.01  # of each distribution that is the model's mean: like a softmax, it has no zeros
CONTACT_DEPTH = 0.1  # m, neighbouring pixels of two instances nearer than this in depth touch
FALSE_SIZES = (24.0, 160.0)  # px, sides of false detections, drawn evenly on a logarithmic scale


class Draw(IntEnum):
    """What a random number is for. Each has its own stream: changing one error leaves the others' draws alone."""

    MERGE = 0
    MISS = 1
    SPLIT = 2
    SHAPE = 3
    CLASS = 4
    CLASS_OF_OBJECT = 5
    SCORE = 6
    FALSE_POSITIVES = 7


@dataclass(frozen=True)
class Candidate:
    """An object, or a part of one, on its way to a detection."""

    instance: int  # its id in the ground truth; false detections count down from -1
    part: int  # 0, or 1 for the second half of a split object
    class_id: int
    mask: Bool  # (H, W)
    true_mask: Bool  # (H, W) of the instance, which a perfect detector would return


@dataclass
class SimulatedDetector(Detector):
    """The ground truth with the errors of a mid-quality detector, each one a parameter; all at 0 = the ground truth.

    In this order: touching neighbours come back under one mask (`merge_rate`); objects are missed, the more so the
    smaller (`small_side`) or when cut by the image's border; objects come back in two halves (`split_rate`); masks
    are shifted, bleed over the border, wobble smoothly along it and pass through a coarse grid; the class becomes a
    distribution around a confusion kernel of lookalikes, the same one in many of an object's frames
    (`confusion_consistency`), because real errors do not average out over a video; the score follows the
    mask's quality and the class's certainty; false detections appear. Every number is drawn from (seed, purpose, frame,
    instance): the order of calls does not matter, and changing one error leaves the draws of the others alone. Raises
    DataError without ground truth.
    """

    seed: int = 0  # >= 0
    min_pixels: int = 64  # px >= 1, smaller instances are never detected
    merge_rate: float = 0.1  # in [0, 1], probability that a touching pair comes back as one
    miss_rate: float = 0.1  # in [0, 1], probability to miss a large, whole object
    small_side: float = 24.0  # px >= 0, at this side 1/e of the objects are missed; 0 = size is no matter
    truncated_miss_rate: float = 0.15  # in [0, 1], more for an object at the image's border
    split_rate: float = 0.05  # in [0, 1], probability that an object comes back in two halves
    shift: float = 1.5  # px >= 0, standard deviation along x and y
    bleed: float = 2.0  # px, how far masks reach over the border; negative = they fall short
    boundary_noise: float = 2.5  # px >= 0, standard deviation of the border's wobble
    boundary_scale: float = 12.0  # px >= 2, how far along the border a wobble reaches
    mask_grid: int = 28  # cells a side >= 4 of the network's mask, 0 = full resolution
    confusion: float = 0.25  # in [0, 1), mean probability that goes to wrong classes
    confusion_concentration: float = 3.0  # > 0, of the Dirichlet: small = confident, often wrong
    confusion_consistency: float = 0.5  # in [0, 1], share of frames that give an object one and the same distribution
    score_concentration: float = 20.0  # >= 0, of the Beta around quality x certainty; 0 = no noise
    score_threshold: float = 0.1  # in [0, 1), detections below are dropped
    false_positives: float = 0.5  # >= 0, mean number an image
    false_positive_score: float = 0.25  # in (0, 1), mean

    def __post_init__(self) -> None:
        require(self.seed >= 0, "detector.seed", self.seed, "at least 0")
        require(self.min_pixels >= 1, "detector.min_pixels", self.min_pixels, "at least 1 px")
        for name in ("merge_rate", "miss_rate", "truncated_miss_rate", "split_rate", "confusion_consistency"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"detector.{name}", value, "in [0, 1]")
        for name in ("small_side", "shift", "boundary_noise", "score_concentration", "false_positives"):
            value = getattr(self, name)
            require(0 <= value < np.inf, f"detector.{name}", value, "at least 0")
        for name in ("confusion", "score_threshold"):
            value = getattr(self, name)
            require(0 <= value < 1, f"detector.{name}", value, "in [0, 1)")
        require(bool(np.isfinite(self.bleed)), "detector.bleed", self.bleed, "a number of px")
        require(2 <= self.boundary_scale < np.inf, "detector.boundary_scale", self.boundary_scale, "at least 2 px")
        require(self.mask_grid == 0 or self.mask_grid >= 4, "detector.mask_grid", self.mask_grid, "0 or at least 4")
        concentration = self.confusion_concentration
        require(0 < concentration < np.inf, "detector.confusion_concentration", concentration, "positive")
        mean = self.false_positive_score
        require(0 < mean < 1, "detector.false_positive_score", mean, "in (0, 1)")
        self.classes = COCO
        self._kernel = confusion_kernel(self.classes, self.confusion)

    def detect(self, frame: Frame) -> Detections:
        truth = true_instances(frame, self.classes, self.min_pixels)
        candidates = self._merge(truth, frame)
        candidates = [candidate for candidate in candidates if self._sees(candidate, frame)]
        candidates = [part for candidate in candidates for part in self._split(candidate, frame)]
        candidates = [self._reshape(candidate, frame) for candidate in candidates]
        candidates = [candidate for candidate in candidates + self._false_positives(frame) if candidate.mask.any()]
        if not candidates:
            return Detections.none(frame.camera.shape, self.classes)

        masks = np.stack([candidate.mask for candidate in candidates])
        probabilities = np.stack([self._classify(candidate, frame) for candidate in candidates])
        scores = np.array(
            [self._score(c, p, frame) for c, p in zip(candidates, probabilities, strict=True)], np.float32
        )
        best_first = np.argsort(-scores, kind="stable")
        kept = best_first[scores[best_first] >= self.score_threshold]
        return Detections(
            masks=masks[kept],
            boxes=tight_boxes(masks[kept]),
            scores=scores[kept],
            class_probabilities=probabilities[kept].astype(np.float32),
            classes=self.classes,
        )

    def _random(self, draw: Draw, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, int(draw), *(k & 0xFFFFFFFF for k in key)])

    def _merge(self, truth: TrueInstances, frame: Frame) -> list[Candidate]:
        """The instances, touching pairs put together under the larger one's name; each merges at most once."""
        candidates = {
            i: Candidate(i, 0, c, mask, mask)
            for i, c, mask in zip(truth.ids.tolist(), truth.class_ids.tolist(), truth.masks, strict=True)
        }
        rank = {i: k for k, i in enumerate(candidates)}  # the largest first
        taken: set[int] = set()
        for pair in touching_pairs(frame).tolist():
            if not taken.isdisjoint(pair) or not rank.keys() >= set(pair):
                continue
            if self._random(Draw.MERGE, frame.index, *pair).random() >= self.merge_rate:
                continue
            large, small = sorted(pair, key=rank.__getitem__)
            merged = candidates[large].mask | candidates.pop(small).mask
            candidates[large] = replace(candidates[large], mask=merged)
            taken.update(pair)
        return list(candidates.values())

    def _sees(self, candidate: Candidate, frame: Frame) -> bool:
        mask = candidate.mask
        side = float(np.sqrt(np.count_nonzero(mask)))
        truncated = bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
        p = 1 - self.miss_rate
        p *= 1 - np.exp(-side / self.small_side) if self.small_side > 0 else 1.0
        p *= 1 - self.truncated_miss_rate if truncated else 1.0
        return bool(self._random(Draw.MISS, frame.index, candidate.instance).random() < p)

    def _split(self, candidate: Candidate, frame: Frame) -> list[Candidate]:
        """The object, or its two halves along a random line through its middle."""
        random = self._random(Draw.SPLIT, frame.index, candidate.instance)
        if random.random() >= self.split_rate:
            return [candidate]
        angle = random.uniform(0, np.pi)
        v, u = np.nonzero(candidate.mask)
        side = (u - u.mean()) * np.cos(angle) + (v - v.mean()) * np.sin(angle) > 0
        halves = []
        for part, chosen in enumerate((side, ~side)):
            mask = np.zeros_like(candidate.mask)
            mask[v[chosen], u[chosen]] = True
            halves.append(replace(candidate, part=part, mask=mask))
        return halves

    def _reshape(self, candidate: Candidate, frame: Frame) -> Candidate:
        """The mask as a network would draw it: moved, bleeding, wobbling, coarse."""
        if not candidate.mask.any():
            return candidate
        random = self._random(Draw.SHAPE, frame.index, candidate.instance, candidate.part)
        margin = int(np.ceil(abs(self.bleed) + 4 * self.boundary_noise + 4 * self.shift)) + 2
        x1, y1, x2, y2 = tight_boxes(candidate.mask[None])[0].astype(int)
        height, width = candidate.mask.shape
        inner = candidate.mask[y1 : y2 + 1, x1 : x2 + 1]
        # What the image's border cuts off goes on outside, or masks would shrink away from that border.
        top, bottom, left, right = (margin * (gap > 0) for gap in (y1, height - 1 - y2, x1, width - 1 - x2))
        crop = np.pad(inner.astype(np.uint8), ((top, bottom), (left, right)))
        rest = ((margin - top, margin - bottom), (margin - left, margin - right))
        crop = np.pad(crop, rest, mode="edge")
        distance = signed_distance(crop)
        dx, dy = random.normal(0, 1, 2) * self.shift
        moved = cv2.warpAffine(
            distance,
            np.array([[1, 0, dx], [0, 1, dy]]),
            crop.shape[::-1],
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        wobble = smooth_field(random, crop.shape, self.boundary_scale)
        shape = moved + np.float32(self.bleed) + np.float32(self.boundary_noise) * wobble > 0
        return replace(candidate, mask=self._coarsen(_placed(shape, x1 - margin, y1 - margin, (height, width))))

    def _coarsen(self, mask: Bool) -> Bool:
        """The mask after a grid of `mask_grid` cells a side over its box, as networks predict it."""
        if self.mask_grid == 0 or not mask.any():
            return mask
        x1, y1, x2, y2 = tight_boxes(mask[None])[0].astype(int)
        box = mask[y1 : y2 + 1, x1 : x2 + 1].astype(np.float32)
        grid = cv2.resize(box, (self.mask_grid, self.mask_grid), interpolation=cv2.INTER_AREA)
        borders = np.array([[x1 - 0.5, y1 - 0.5, x2 + 0.5, y2 + 0.5]], np.float32)
        return np.asarray(paste_masks(grid[None], borders, (mask.shape[0], mask.shape[1]))[0], np.bool_)

    def _false_positives(self, frame: Frame) -> list[Candidate]:
        """Ellipses with a wobbling border, of random classes, anywhere in the image."""
        random = self._random(Draw.FALSE_POSITIVES, frame.index)
        height, width = frame.camera.shape
        candidates = []
        for k in range(int(random.poisson(self.false_positives))):
            a, b = np.exp(random.uniform(np.log(FALSE_SIZES[0]), np.log(FALSE_SIZES[1]), 2)) / 2
            x, y = random.uniform(0, width), random.uniform(0, height)
            wobble = smooth_field(random, (height, width), self.boundary_scale) * (self.boundary_noise / min(a, b))
            mask = self._coarsen(ellipse(x, y, a, b, wobble))
            nothing = np.zeros_like(mask)
            candidates.append(Candidate(-1 - k, 0, int(random.integers(len(self.classes))), mask, nothing))
        return candidates

    def _classify(self, candidate: Candidate, frame: Frame) -> Float64:
        """(C,) a distribution whose mean over frames and objects is the true class's row of the confusion kernel."""
        mean = self._kernel[candidate.class_id]
        random = self._random(Draw.CLASS, frame.index, candidate.instance, candidate.part)
        if random.random() < self.confusion_consistency:
            random = self._random(Draw.CLASS_OF_OBJECT, candidate.instance)
        drawn = _dirichlet(random, mean * self.confusion_concentration)
        return np.asarray((1 - EVEN_SHARE) * drawn + EVEN_SHARE * mean, np.float64)

    def _score(self, candidate: Candidate, probabilities: Float64, frame: Frame) -> float:
        """Beta around the mask's IoU with its instance times the probability of the most likely class."""
        mean = self.false_positive_score
        if candidate.instance > 0:
            union = np.count_nonzero(candidate.mask | candidate.true_mask)
            iou = np.count_nonzero(candidate.mask & candidate.true_mask) / union
            mean = iou * float(probabilities.max())
        if self.score_concentration == 0 or not 0 < mean < 1:
            return min(mean, 1.0)
        random = self._random(Draw.SCORE, frame.index, candidate.instance, candidate.part)
        return float(random.beta(self.score_concentration * mean, self.score_concentration * (1 - mean)))


def confusion_kernel(classes: tuple[str, ...], confusion: float) -> Float64:
    """(C, C): row t is the mean distribution of an object of class t, 1 - `confusion` of it on t itself."""
    index = {name: k for k, name in enumerate(classes)}
    alike = np.zeros((len(classes), len(classes)), np.bool_)
    for group in LOOKALIKES:
        members = [index[name] for name in group]
        alike[np.ix_(members, members)] = True
    np.fill_diagonal(alike, False)
    other = ~alike & ~np.eye(len(classes), dtype=np.bool_)
    share = np.where(alike.any(axis=1, keepdims=True), LOOKALIKE_SHARE, 0.0)
    kernel = share * alike / np.maximum(alike.sum(axis=1, keepdims=True), 1)
    kernel += (1 - share) * other / other.sum(axis=1, keepdims=True)
    return np.asarray(confusion * kernel + (1 - confusion) * np.eye(len(classes)), np.float64)


def touching_pairs(frame: Frame) -> Int32:
    """The pairs (M, 2) of instance ids, the smaller id first, that share a border without a step in depth."""
    assert frame.truth is not None
    return np.asarray(np.unique(_contacts(frame.truth.instance_ids, frame.depth), axis=0), np.int32)


@njit(cache=True, nogil=True)
def _contacts(ids, depth):
    """The pairs (M, 2) of neighbouring pixels' instances, the smaller id first, some of them more than once."""
    height, width = ids.shape
    pairs = np.empty((2 * height * width, 2), np.int32)
    n = 0
    for v in range(height):
        for u in range(width):
            own = ids[v, u]
            if own <= 0:
                continue
            for y, x in ((v, u + 1), (v + 1, u)):
                if y == height or x == width or ids[y, x] <= 0 or ids[y, x] == own:
                    continue
                if abs(depth[v, u] - depth[y, x]) < np.float32(CONTACT_DEPTH):
                    pairs[n, 0], pairs[n, 1] = min(own, ids[y, x]), max(own, ids[y, x])
                    n += 1
    return pairs[:n].copy()


def signed_distance(mask: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> Float32:
    """The distance (H, W) px of pixel centres to the border of the mask (H, W) of 0 and 1, positive inside."""
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.where(mask > 0, inside - 0.5, 0.5 - outside), np.float32)


def smooth_field(random: np.random.Generator, shape: tuple[int, ...], scale: float) -> Float32:
    """Gaussian noise (H, W) of zero mean, unit variance and correlation length `scale` px."""
    sigma, margin = 2.0, 6  # cells of a coarse grid, on which blurring is cheap
    rows, columns = (int(np.ceil(side * sigma / scale)) + 2 for side in shape)
    white = random.standard_normal((rows + 2 * margin, columns + 2 * margin)).astype(np.float32)
    blurred = cv2.GaussianBlur(white, (2 * margin + 1, 2 * margin + 1), sigma)
    unit = blurred[margin:-margin, margin:-margin] * np.float32(2 * np.sqrt(np.pi) * sigma)
    size = round(columns * scale / sigma), round(rows * scale / sigma)
    field = cv2.resize(unit, size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(field[: shape[0], : shape[1]], np.float32)


def _dirichlet(random: np.random.Generator, alpha: Float64) -> Float64:
    """(C,) a draw from the Dirichlet; a single positive alpha gives that class all."""
    weights = random.gamma(alpha)
    return np.asarray(weights / weights.sum(), np.float64) if weights.sum() > 0 else alpha / alpha.sum()


def ellipse(x: float, y: float, a: float, b: float, wobble: Float32) -> Bool:
    """The mask (H, W) of the ellipse about (x, y) with half axes a, b (px), which shrinks by `wobble` (H, W) radii."""
    mask = np.zeros(wobble.shape, np.bool_)
    reach = max(0.0, 1.0 - float(wobble.min()))  # radii, at most
    window = tuple(
        slice(max(0, int(middle - half * reach)), max(0, int(middle + half * reach) + 2))
        for middle, half in ((y, b), (x, a))
    )
    v, u = (np.arange(side)[part] for side, part in zip(wobble.shape, window, strict=True))
    radius = np.hypot((u - x)[None, :] / a, (v - y)[:, None] / b)
    mask[window] = radius + wobble[window] < 1
    return mask


def _placed(crop: Bool, x: int, y: int, shape: tuple[int, int]) -> Bool:
    """The image (H, W) that is False but for `crop`, whose first pixel is at (x, y), possibly outside."""
    image = np.zeros(shape, np.bool_)
    height, width = shape
    top, left = max(0, -y), max(0, -x)
    bottom, right = min(crop.shape[0], height - y), min(crop.shape[1], width - x)
    image[y + top : y + bottom, x + left : x + right] = crop[top:bottom, left:right]
    return image
