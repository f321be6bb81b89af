"""A detector of chosen quality: the ground truth, degraded by a seeded model of the errors that real detectors make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np

from framework.config.validation import MOST_DETECTIONS, require
from framework.data import Bool, Detections, Float32, Float64, Frame, Int32
from framework.detection.masks.binary_masks import paste_masks, tight_boxes
from framework.detection.masks.contact_kernels import contacts
from framework.detection.recurring_false_positives import ghost_places
from framework.detection.true_instances import TrueInstances, true_instances
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import COCO

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
TAKEN_FOR = tuple(dict.fromkeys(name for group in LOOKALIKES for name in group))
"""What is none of COCO's classes is taken for one of these."""
LOOKALIKE_SHARE = 0.8  # of the probability lost by the true class; the rest is spread over all other classes
EVEN_SHARE = 0.01  # of each distribution that is the model's mean: like a softmax, it has no zeros
FALSE_SIZES = (24.0, 160.0)  # px, sides of false detections, drawn evenly on a logarithmic scale
LARGEST_CLUTTER = 0.25  # of the image: larger things, walls as a rule, are not taken for objects as a whole
LARGEST_ATTACHED = 2.0  # times the object's size: larger things are not taken for a part of it
GHOST_SIZES = (0.2, 1.2)  # m, sides of false detections at places of the room, drawn evenly on a logarithmic scale
SHARES = (
    *("clutter_rate", "attach_rate", "merge_rate", "miss_rate", "truncated_miss_rate", "split_rate"),
    *("confusion_consistency", "recurring_fraction"),
)


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
    ATTACH = 8
    CLUTTER = 9
    DETECTABILITY = 10
    GHOST = 11


@dataclass(frozen=True)
class Candidate:
    """An object, or a part of one, on its way to a detection."""

    instance: int  # its id in the ground truth; what is nothing has a negative one
    part: int  # 0, or 1 for the second half of a split object
    class_id: int
    mask: Bool  # (H, W)
    true_mask: Bool  # (H, W) of the instance, which a perfect detector would return; empty for a false detection


@dataclass
class SimulatedDetector(Detector):
    """The ground truth with the errors of a mid-quality detector, each one a parameter; all at 0 = the ground truth.

    In this order: things of unknown class are taken for objects (`clutter_rate`); an object comes back with a thing
    that touches it, as a sink with its cupboard (`attach_rate`); touching neighbours come back under one mask
    (`merge_rate`); objects are missed, the more so the smaller (`small_side`) or when cut by the image's border, some
    objects nearly always and others never (`miss_spread`); objects come back in two halves (`split_rate`); masks are
    shifted, bleed over the border, wobble smoothly along it and pass through a coarse grid; the class becomes a
    distribution around a confusion kernel of lookalikes, the same one in many of an object's frames
    (`confusion_consistency`); the score follows the mask's quality and the class's certainty; false detections appear,
    some of them at the same places of the room again and again (`recurring_fraction`, where poses are known). What an
    object or a place has of its own does not average out over a video, as the errors of real detectors do not. Every
    number is drawn from (seed, purpose, frame, instance): the order of calls does not matter, and changing one error
    leaves the draws of the others alone. Raises DataError without ground truth.
    """

    seed: int = 0  # >= 0
    min_pixels: int = 64  # px >= 1, smaller instances are never detected
    clutter_rate: float = 0.0  # in [0, 1], share of the things of unknown class that are taken for objects
    attach_rate: float = 0.0  # in [0, 1], share of the pairs object, thing that touches it, that come back as one
    merge_rate: float = 0.1  # in [0, 1], probability that a touching pair comes back as one
    miss_rate: float = 0.1  # in [0, 1], probability to miss a large, whole object
    small_side: float = 24.0  # px >= 0, at this side 1/e of the objects are missed; 0 = size is no matter
    truncated_miss_rate: float = 0.15  # in [0, 1], more for an object at the image's border
    miss_spread: float = 0.0  # >= 0, standard deviation over objects of the logit of being seen
    split_rate: float = 0.05  # in [0, 1], probability that an object comes back in two halves
    shift: float = 1.5  # px >= 0, standard deviation along x and y
    bleed: float = 2.0  # px, how far masks reach over the border; negative = they fall short
    boundary_noise: float = 2.5  # px >= 0, standard deviation of the border's wobble
    boundary_scale: float = 12.0  # px >= 2, how far along the border a wobble reaches
    mask_grid: int = 28  # cells a side >= 4 of the network's mask, 0 = full resolution
    confusion: float = 0.25  # in [0, 1), mean probability that goes to wrong classes
    confusion_concentration: float = 3.0  # > 0, of the Dirichlet: small = confident, often wrong
    confusion_consistency: float = 0.5  # in [0, 1], share of frames that give an object one and the same distribution
    score_scale: float = 1.0  # in (0, 1], of the mean score: quality x certainty x this
    score_concentration: float = 20.0  # >= 0, of the Beta around the mean; 0 = no noise
    score_threshold: float = 0.1  # in [0, 1), detections below are dropped
    false_positives: float = 0.5  # >= 0, mean number an image
    false_positive_score: float = 0.25  # in (0, 1), mean
    recurring_fraction: float = 0.0  # in [0, 1], of the false positives: at places of the room, of one class each

    def __post_init__(self) -> None:
        require(self.seed >= 0, "detector.seed", self.seed, "at least 0")
        require(self.min_pixels >= 1, "detector.min_pixels", self.min_pixels, "at least 1 px")
        for name in SHARES:
            value = getattr(self, name)
            require(0 <= value <= 1, f"detector.{name}", value, "in [0, 1]")
        for name in ("small_side", "miss_spread", "shift", "boundary_noise", "score_concentration", "false_positives"):
            value = getattr(self, name)
            require(0 <= value < np.inf, f"detector.{name}", value, "at least 0")
        for name in ("confusion", "score_threshold"):
            value = getattr(self, name)
            require(0 <= value < 1, f"detector.{name}", value, "in [0, 1)")
        require(self.false_positives <= MOST_DETECTIONS, "detector.false_positives", self.false_positives,
                f"at most {MOST_DETECTIONS}")  # fmt: skip
        require(abs(self.bleed) <= 1000, "detector.bleed", self.bleed, "a number of px, at most 1000")
        require(2 <= self.boundary_scale < np.inf, "detector.boundary_scale", self.boundary_scale, "at least 2 px")
        grid = self.mask_grid
        require(grid == 0 or 4 <= grid <= 4096, "detector.mask_grid", grid, "0 or at least 4 and at most 4096")
        require(0 < self.score_scale <= 1, "detector.score_scale", self.score_scale, "in (0, 1]")
        concentration = self.confusion_concentration
        require(0 < concentration < np.inf, "detector.confusion_concentration", concentration, "positive")
        mean = self.false_positive_score
        require(0 < mean < 1, "detector.false_positive_score", mean, "in (0, 1)")
        self.classes = COCO
        self._kernel = confusion_kernel(self.classes, self.confusion)

    def detect(self, frame: Frame) -> Detections:
        truth = true_instances(frame, self.classes, self.min_pixels)
        pairs = touching_pairs(frame).tolist()
        things = self._things(frame) if self.clutter_rate > 0 or self.attach_rate > 0 else {}
        candidates = self._clutter(things) + self._merge(self._attached(truth, things, pairs), pairs, frame)
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

    def _clutter(self, things: Mapping[int, Bool]) -> list[Candidate]:
        """The things of unknown class that are taken for objects: in all frames the same ones, of the same class."""
        candidates = []
        for instance, mask in things.items():
            random = self._random(Draw.CLUTTER, instance)
            if random.random() < self.clutter_rate and np.count_nonzero(mask) <= LARGEST_CLUTTER * mask.size:
                class_id = self.classes.index(TAKEN_FOR[random.integers(len(TAKEN_FOR))])
                candidates.append(Candidate(instance, 0, class_id, mask, np.zeros_like(mask)))
        return candidates

    def _things(self, frame: Frame) -> dict[int, Bool]:
        """The masks of what has no known class, by id; none smaller than `min_pixels`."""
        assert frame.truth is not None
        names = frame.truth.class_names
        found, areas = np.unique(frame.truth.instance_ids, return_counts=True)
        chosen = [i for i in found[areas >= self.min_pixels].tolist() if i > 0 and names.get(i) is None]
        return {i: frame.truth.instance_ids == i for i in chosen}

    def _attached(self, truth: TrueInstances, things: Mapping[int, Bool], pairs: list[list[int]]) -> list[Candidate]:
        """The instances, largest first, some of them with things that touch them."""
        candidates = {
            i: Candidate(i, 0, c, mask, mask)
            for i, c, mask in zip(truth.ids.tolist(), truth.class_ids.tolist(), truth.masks, strict=True)
        }
        for first, second in pairs:
            for instance, thing in ((first, second), (second, first)):
                if instance not in candidates or thing not in things:
                    continue
                if self._random(Draw.ATTACH, instance, thing).random() >= self.attach_rate:
                    continue
                own = candidates[instance]
                if np.count_nonzero(things[thing]) <= LARGEST_ATTACHED * np.count_nonzero(own.true_mask):
                    candidates[instance] = replace(own, mask=own.mask | things[thing])
        return list(candidates.values())

    def _merge(self, instances: list[Candidate], pairs: list[list[int]], frame: Frame) -> list[Candidate]:
        """The instances, touching pairs put together under the larger one's name; each merges at most once."""
        candidates = {candidate.instance: candidate for candidate in instances}
        rank = {i: k for k, i in enumerate(candidates)}  # the largest first
        taken: set[int] = set()
        for pair in pairs:
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
        if self.miss_spread > 0 and 0 < p < 1:
            own = self.miss_spread * self._random(Draw.DETECTABILITY, candidate.instance).standard_normal()
            p = 1 / (1 + (1 - p) / p * np.exp(-own))
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
        """Ellipses with a wobbling border: of any class anywhere in the image, or of one class at a place of the room.

        Of the places in sight the same ones come first in all frames.
        """
        random = self._random(Draw.FALSE_POSITIVES, frame.index)
        height, width = frame.camera.shape
        count = int(random.poisson(self.false_positives))
        is_ghost = self._random(Draw.GHOST, frame.index).random(count) < self.recurring_fraction
        places = ghost_places(frame, self.seed, int(is_ghost.sum()))
        candidates = []
        for k in range(count):
            a, b = np.exp(random.uniform(np.log(FALSE_SIZES[0]), np.log(FALSE_SIZES[1]), 2)) / 2
            x, y = random.uniform(0, width), random.uniform(0, height)
            wobble = smooth_field(random, (height, width), self.boundary_scale)
            instance, class_id = -1 - k, int(random.integers(len(self.classes)))
            if is_ghost[k] and places:
                place = places.pop(0)
                own = self._random(Draw.GHOST, place.key)
                scale = frame.camera.fx / place.z
                a, b = np.exp(own.uniform(np.log(GHOST_SIZES[0]), np.log(GHOST_SIZES[1]), 2)) / 2 * scale
                x, y, instance = place.u, place.v, -place.key
                class_id = self.classes.index(TAKEN_FOR[own.integers(len(TAKEN_FOR))])
            mask = self._coarsen(ellipse(x, y, a, b, wobble * (self.boundary_noise / min(a, b))))
            candidates.append(Candidate(instance, 0, class_id, mask, np.zeros_like(mask)))
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
        """Beta around the mask's IoU with its instance times the probability of the most likely class, scaled."""
        mean = self.false_positive_score
        if candidate.true_mask.any():
            union = np.count_nonzero(candidate.mask | candidate.true_mask)
            iou = np.count_nonzero(candidate.mask & candidate.true_mask) / union
            mean = self.score_scale * iou * float(probabilities.max())
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
    return np.asarray(np.unique(contacts(frame.truth.instance_ids, frame.depth), axis=0), np.int32)


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
