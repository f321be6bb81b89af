"""Simulated detector of adjustable quality, which adds random errors to the ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np

from framework.config.validation import MAX_DETECTIONS, check_intervals, require
from framework.data import Bool, Detections, Float32, Float64, Frame, Int32
from framework.detection.masks.binary_masks import paste_masks, tight_boxes
from framework.detection.masks.binary_masks_kernels import contacts
from framework.detection.recurring_false_positives import false_positive_cells
from framework.detection.true_instances import TrueInstances, true_instances
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import ClassNames, read_labels, to_class_names

# fmt: off
LOOKALIKES = (
    ("chair", "couch", "bench", "bed", "toilet"), ("dining table", "bench", "bed"),
    ("tv", "laptop", "microwave", "oven", "refrigerator"), ("laptop", "keyboard", "book", "cell phone", "remote"),
    ("cup", "bottle", "wine glass", "vase", "bowl"), ("vase", "potted plant"), ("sink", "toilet", "bowl"),
    ("backpack", "handbag", "suitcase"), ("clock", "sports ball", "frisbee"), ("teddy bear", "dog", "cat", "person"),
    ("knife", "fork", "spoon", "scissors", "toothbrush"), ("car", "truck", "bus", "train"), ("bicycle", "motorcycle"),
)
# fmt: on
"""COCO classes that detectors confuse indoors."""

CLUTTER_CLASSES = tuple(dict.fromkeys(name for group in LOOKALIKES for name in group))
"""Classes assigned to detections of objects of unknown class."""

LOOKALIKE_FRACTION = 0.8  # fraction of the probability of wrong classes for similar classes; other classes get the rest
EVEN_FRACTION = 0.01  # weight of the mean distribution in each distribution; avoids zeros, as a softmax does
FALSE_SIZES = (24.0, 160.0)  # range of the sides of false detections, px, log-uniform
RECURRING_SIZES = (0.2, 1.2)  # range of the sides of recurring false detections, m, log-uniform
# maximum area of an object of unknown class that is detected, as a fraction of the image; walls are larger
LARGEST_CLUTTER = 0.25
# maximum ratio of the area of an object of unknown class to the area of the object whose mask includes it
LARGEST_ATTACHED = 2.0
INTERVALS = {
    **dict.fromkeys(("clutter_rate", "attach_rate", "merge_rate", "miss_rate", "truncated_miss_rate"), "[0, 1]"),
    **dict.fromkeys(("split_rate", "confusion_consistency", "recurring_fraction"), "[0, 1]"),
    **dict.fromkeys(("miss_size_scale", "miss_spread", "shift", "boundary_noise", "score_concentration"), "[0, inf)"),
    **dict.fromkeys(("confusion", "score_threshold"), "[0, 1)"),
    "seed": "[0, inf)",
    "min_pixels": "[1, inf)",
    "bleed": "[-1000, 1000]",
    "boundary_scale": "[2, inf)",
    "confusion_concentration": "(0, inf)",
    "score_scale": "(0, 1]",
    "false_positives": f"[0, {MAX_DETECTIONS}]",
    "false_positive_score": "(0, 1)",
}
"""Bounds of the parameters."""


class Draw(IntEnum):
    """Purpose of a random number.

    Each purpose has its own random stream, so that errors are independent.
    """

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
    RECURRING = 11


@dataclass(frozen=True)
class Candidate:
    """An object, or a part of an object, that may be detected."""

    instance: int  # id in the ground truth; negative for a false detection
    part: int  # 0; 1 for the second half of a split object
    class_id: int  # index into the classes of the detector
    mask: Bool  # (H, W)
    true_mask: Bool  # (H, W) ground-truth mask of the instance; empty for a false detection


@dataclass
class SimulatedDetector(Detector):
    """The ground truth with the errors of a mid-quality detector.

    Each error has a parameter. Without errors, the detections are the ground truth. The errors are applied in this
    order:

    - Objects of unknown class are detected as an arbitrary class (`clutter_rate`).
    - The mask of an object includes a touching object of unknown class, e.g. the cupboard of a sink (`attach_rate`).
    - Touching objects share one mask (`merge_rate`).
    - Objects are missed, more often if they are small (`miss_size_scale`) or at the image border. Some objects are
      nearly always missed, and others never (`miss_spread`).
    - Objects are split in two (`split_rate`).
    - Masks are shifted, extend beyond the object, have a noisy border and have a coarse resolution.
    - The class distribution is random, with similar classes more likely (`confusion`). In a fraction of its frames, an
      object has the same distribution (`confusion_consistency`).
    - The score depends on the quality of the mask and the certainty of the class.
    - False detections occur, some of them repeatedly at the same locations (`recurring_fraction`, needs poses).

    As with real detectors, the errors of an object do not average out over a video. Random numbers depend on the seed,
    purpose, frame and instance, but not on the order of calls. The detector raises DataError without ground truth.

    Classes outside of COCO have no similar classes. They are confused with all other classes of the label space with
    the same probability.
    """

    seed: int = 0  # seed of the simulated errors, >= 0
    min_pixels: int = 64  # minimum number of pixels of a detected instance, >= 1
    clutter_rate: float = 0.0  # fraction of the objects of unknown class that are detected, in [0, 1]
    # probability that an object and a touching object of unknown class share one mask, in [0, 1]
    attach_rate: float = 0.0
    merge_rate: float = 0.1  # probability that two touching objects share one mask, in [0, 1]
    miss_rate: float = 0.1  # probability of missing a large object inside the image, in [0, 1]
    # object side length at which the size-related miss probability is 1/e, px, >= 0; 0 = no effect of the size
    miss_size_scale: float = 24.0
    truncated_miss_rate: float = 0.15  # additional probability of missing an object at the image border, in [0, 1]
    miss_spread: float = 0.0  # standard deviation of the logit of the detection rate over objects, >= 0
    split_rate: float = 0.05  # probability of splitting an object into two detections, in [0, 1]
    shift: float = 1.5  # standard deviation of the mask shift along x and y, px, >= 0
    bleed: float = 2.0  # offset of the mask border from the object border, px; positive = outside, negative = inside
    boundary_noise: float = 2.5  # standard deviation of the displacement of the mask border, px, >= 0
    boundary_scale: float = 12.0  # correlation length of the displacement along the mask border, px, >= 2
    mask_grid: int = 28  # number of cells per side of a mask, 0 or in [4, 4096]; 0 = full resolution
    confusion: float = 0.25  # mean total probability of the wrong classes, in [0, 1)
    # concentration of the Dirichlet distribution of classes, > 0; small values give confident but often wrong classes
    confusion_concentration: float = 3.0
    confusion_consistency: float = 0.5  # fraction of an object's frames with the same class distribution, in [0, 1]
    score_scale: float = 1.0  # scale of the mean score (mask IoU times class probability), in (0, 1]
    score_concentration: float = 20.0  # concentration of the Beta distribution of scores, >= 0; 0 = no noise
    score_threshold: float = 0.1  # minimum score of a detection, in [0, 1)
    false_positives: float = 0.5  # mean number of false positives per image, >= 0
    false_positive_score: float = 0.25  # mean score of false positives, in (0, 1)
    recurring_fraction: float = 0.0  # fraction of false positives at fixed locations with fixed classes, in [0, 1]
    label_space: str = "coco"  # class names: a label space such as coco, or a text file with one name per line

    def __post_init__(self) -> None:
        require(self.seed >= 0, "detector.seed", self.seed, "at least 0")
        check_intervals("detector", self, **INTERVALS)
        grid = self.mask_grid
        require(grid == 0 or 4 <= grid <= 4096, "detector.mask_grid", grid, "0 or a value in [4, 4096]")
        self.classes = to_class_names(read_labels(self.label_space), ClassNames.OWN).classes
        # indices of the classes of clutter; all classes if the label space has none of them
        self._clutter_ids = [self.classes.index(name) for name in CLUTTER_CLASSES if name in self.classes]
        self._clutter_ids = self._clutter_ids or [*range(len(self.classes))]
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
        """Return the detected objects of unknown class, which are the same in all frames."""
        candidates = []
        for instance, mask in things.items():
            random = self._random(Draw.CLUTTER, instance)
            if random.random() < self.clutter_rate and np.count_nonzero(mask) <= LARGEST_CLUTTER * mask.size:
                class_id = self._clutter_ids[random.integers(len(self._clutter_ids))]
                candidates.append(Candidate(instance, 0, class_id, mask, np.zeros_like(mask)))
        return candidates

    def _things(self, frame: Frame) -> dict[int, Bool]:
        """Return the masks (H, W) of the objects of unknown class by id."""
        assert frame.truth is not None
        names = frame.truth.class_names
        found, areas = np.unique(frame.truth.instance_ids, return_counts=True)
        chosen = [i for i in found[areas >= self.min_pixels].tolist() if i > 0 and names.get(i) is None]
        return {i: frame.truth.instance_ids == i for i in chosen}

    def _attached(self, truth: TrueInstances, things: Mapping[int, Bool], pairs: list[list[int]]) -> list[Candidate]:
        """Return the instances of known class, largest first, some with touching objects of unknown class.

        Args:
            truth: The ground-truth instances.
            things: The masks of the objects of unknown class by id.
            pairs: The ids of touching instances.
        """
        candidates = {
            i: Candidate(i, 0, c, mask, mask)
            for i, c, mask in zip(truth.ids.tolist(), truth.class_ids.tolist(), truth.masks, strict=True)
        }
        for a, b in pairs:
            for instance, thing in ((a, b), (b, a)):
                if instance not in candidates or thing not in things:
                    continue
                if self._random(Draw.ATTACH, instance, thing).random() >= self.attach_rate:
                    continue
                own = candidates[instance]
                if np.count_nonzero(things[thing]) <= LARGEST_ATTACHED * np.count_nonzero(own.true_mask):
                    candidates[instance] = replace(own, mask=own.mask | things[thing])
        return list(candidates.values())

    def _merge(self, instances: list[Candidate], pairs: list[list[int]], frame: Frame) -> list[Candidate]:
        """Merge some of the touching pairs into the larger instance, each instance at most once."""
        candidates = {candidate.instance: candidate for candidate in instances}
        rank = {i: k for k, i in enumerate(candidates)}  # 0 = the largest
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
        p *= 1 - np.exp(-side / self.miss_size_scale) if self.miss_size_scale > 0 else 1.0
        p *= 1 - self.truncated_miss_rate if truncated else 1.0
        if self.miss_spread > 0 and 0 < p < 1:
            own = self.miss_spread * self._random(Draw.DETECTABILITY, candidate.instance).standard_normal()
            p = 1 / (1 + (1 - p) / p * np.exp(-own))
        return bool(self._random(Draw.MISS, frame.index, candidate.instance).random() < p)

    def _split(self, candidate: Candidate, frame: Frame) -> list[Candidate]:
        """Return the object, or its two parts on the sides of a random line."""
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
        """Return the candidate with a shifted, enlarged, noisy and coarse mask."""
        if not candidate.mask.any():
            return candidate
        random = self._random(Draw.SHAPE, frame.index, candidate.instance, candidate.part)
        margin = int(np.ceil(abs(self.bleed) + 4 * self.boundary_noise + 4 * self.shift)) + 2
        x1, y1, x2, y2 = tight_boxes(candidate.mask[None])[0].astype(int)
        height, width = candidate.mask.shape
        inner = candidate.mask[y1 : y2 + 1, x1 : x2 + 1]
        # objects continue outside the image; otherwise masks would shrink away from the image border
        top, bottom, left, right = (margin * (gap > 0) for gap in (y1, height - 1 - y2, x1, width - 1 - x2))
        crop = np.pad(inner.astype(np.uint8), ((top, bottom), (left, right)))
        rest = ((margin - top, margin - bottom), (margin - left, margin - right))
        crop = np.pad(crop, rest, mode="edge")
        distance = signed_distance(crop)
        dx, dy = random.normal(0, 1, 2) * self.shift
        shift, flags = np.array([[1, 0, dx], [0, 1, dy]]), cv2.INTER_LINEAR
        moved = cv2.warpAffine(distance, shift, crop.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
        wobble = smooth_field(random, crop.shape, self.boundary_scale)
        shape = moved + np.float32(self.bleed) + np.float32(self.boundary_noise) * wobble > 0
        return replace(candidate, mask=self._coarsen(_placed(shape, x1 - margin, y1 - margin, (height, width))))

    def _coarsen(self, mask: Bool) -> Bool:
        """Return the mask (H, W), resampled on a coarse grid over its box."""
        if self.mask_grid == 0 or not mask.any():
            return mask
        x1, y1, x2, y2 = tight_boxes(mask[None])[0].astype(int)
        box = mask[y1 : y2 + 1, x1 : x2 + 1].astype(np.float32)
        grid = cv2.resize(box, (self.mask_grid, self.mask_grid), interpolation=cv2.INTER_AREA)
        borders = np.array([[x1 - 0.5, y1 - 0.5, x2 + 0.5, y2 + 0.5]], np.float32)
        return np.asarray(paste_masks(grid[None], borders, (mask.shape[0], mask.shape[1]))[0], np.bool_)

    def _false_positives(self, frame: Frame) -> list[Candidate]:
        """Return false positives, which are ellipses with a noisy border.

        Recurring false positives have a fixed class at a fixed location in the world. Others have a random class at a
        random pixel.
        """
        random = self._random(Draw.FALSE_POSITIVES, frame.index)
        height, width = frame.camera.shape
        count = int(random.poisson(self.false_positives))
        recurs = self._random(Draw.RECURRING, frame.index).random(count) < self.recurring_fraction
        cells = false_positive_cells(frame, self.seed, int(recurs.sum()))
        candidates = []
        for k in range(count):
            a, b = np.exp(random.uniform(np.log(FALSE_SIZES[0]), np.log(FALSE_SIZES[1]), 2)) / 2
            x, y = random.uniform(0, width), random.uniform(0, height)
            wobble = smooth_field(random, (height, width), self.boundary_scale)
            instance, class_id = -1 - k, int(random.integers(len(self.classes)))
            if recurs[k] and cells:
                cell = cells.pop(0)
                own = self._random(Draw.RECURRING, cell.key)
                scale = frame.camera.fx / cell.z
                a, b = np.exp(own.uniform(np.log(RECURRING_SIZES[0]), np.log(RECURRING_SIZES[1]), 2)) / 2 * scale
                x, y, instance = cell.u, cell.v, -cell.key
                class_id = self._clutter_ids[own.integers(len(self._clutter_ids))]
            mask = self._coarsen(ellipse(x, y, a, b, wobble * (self.boundary_noise / min(a, b))))
            candidates.append(Candidate(instance, 0, class_id, mask, np.zeros_like(mask)))
        return candidates

    def _classify(self, candidate: Candidate, frame: Frame) -> Float64:
        """Return a random class distribution (C,) for the candidate."""
        mean = self._kernel[candidate.class_id]
        random = self._random(Draw.CLASS, frame.index, candidate.instance, candidate.part)
        if random.random() < self.confusion_consistency:
            random = self._random(Draw.CLASS_OF_OBJECT, candidate.instance)
        drawn = _dirichlet(random, mean * self.confusion_concentration)
        return np.asarray((1 - EVEN_FRACTION) * drawn + EVEN_FRACTION * mean, np.float64)

    def _score(self, candidate: Candidate, probabilities: Float64, frame: Frame) -> float:
        """Return a random score in [0, 1]."""
        mean = self.false_positive_score
        # otherwise proportional to the mask IoU and the largest class probability
        if candidate.true_mask.any():
            union = np.count_nonzero(candidate.mask | candidate.true_mask)
            iou = np.count_nonzero(candidate.mask & candidate.true_mask) / union
            mean = self.score_scale * iou * float(probabilities.max())
        if self.score_concentration == 0 or not 0 < mean < 1:
            return min(mean, 1.0)
        random = self._random(Draw.SCORE, frame.index, candidate.instance, candidate.part)
        return float(random.beta(self.score_concentration * mean, self.score_concentration * (1 - mean)))


def confusion_kernel(classes: tuple[str, ...], confusion: float) -> Float64:
    """Return the confusion matrix (C, C): the mean class distribution of objects of each class.

    A single class cannot be confused.

    Args:
        classes: The names of the classes.
        confusion: The total probability of the wrong classes. Similar classes get most of it.
    """
    if len(classes) == 1:
        return np.ones((1, 1))
    index = {name: k for k, name in enumerate(classes)}
    alike = np.zeros((len(classes), len(classes)), np.bool_)
    for group in LOOKALIKES:
        members = [index[name] for name in group if name in index]
        alike[np.ix_(members, members)] = True
    np.fill_diagonal(alike, False)
    other = ~alike & ~np.eye(len(classes), dtype=np.bool_)
    only_alike = np.where(other.any(axis=1, keepdims=True), LOOKALIKE_FRACTION, 1.0)
    fraction = np.where(alike.any(axis=1, keepdims=True), only_alike, 0.0)
    kernel = fraction * alike / np.maximum(alike.sum(axis=1, keepdims=True), 1)
    kernel += (1 - fraction) * other / np.maximum(other.sum(axis=1, keepdims=True), 1)
    return np.asarray(confusion * kernel + (1 - confusion) * np.eye(len(classes)), np.float64)


def touching_pairs(frame: Frame) -> Int32:
    """Return the ids (M, 2) of touching instances, the smaller id first.

    Instances touch if they have neighboring pixels without a depth step.
    """
    assert frame.truth is not None
    return np.asarray(np.unique(contacts(frame.truth.instance_ids, frame.depth), axis=0), np.int32)


def signed_distance(mask: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> Float32:
    """Return the distance (H, W) of each pixel to the border of a mask, px, positive inside."""
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.where(mask > 0, inside - 0.5, 0.5 - outside), np.float32)


def smooth_field(random: np.random.Generator, shape: tuple[int, ...], scale: float) -> Float32:
    """Return Gaussian noise (H, W) with zero mean, unit variance and the correlation length `scale`, px."""
    sigma, margin = 2.0, 6  # cells of a coarse grid, for fast blurring
    rows, columns = (int(np.ceil(side * sigma / scale)) + 2 for side in shape)
    white = random.standard_normal((rows + 2 * margin, columns + 2 * margin)).astype(np.float32)
    blurred = cv2.GaussianBlur(white, (2 * margin + 1, 2 * margin + 1), sigma)
    unit = blurred[margin:-margin, margin:-margin] * np.float32(2 * np.sqrt(np.pi) * sigma)
    size = round(columns * scale / sigma), round(rows * scale / sigma)
    field = cv2.resize(unit, size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(field[: shape[0], : shape[1]], np.float32)


def _dirichlet(random: np.random.Generator, alpha: Float64) -> Float64:
    """Return a sample (C,) from a Dirichlet distribution.

    The result is its mean if the sampled weights are all 0.
    """
    weights = random.gamma(alpha)
    return np.asarray(weights / weights.sum(), np.float64) if weights.sum() > 0 else alpha / alpha.sum()


def ellipse(x: float, y: float, a: float, b: float, wobble: Float32) -> Bool:
    """Return the mask (H, W) of an axis-aligned ellipse with a noisy border.

    Args:
        x: The column of the center, px.
        y: The row of the center, px.
        a: The half axis along x, px.
        b: The half axis along y, px.
        wobble: The reduction (H, W) of the radius at each pixel, relative to the radius.
    """
    mask = np.zeros(wobble.shape, np.bool_)
    reach = max(0.0, 1.0 - float(wobble.min()))  # maximum radius, in radii
    window = tuple(
        slice(max(0, int(middle - half * reach)), max(0, int(middle + half * reach) + 2))
        for middle, half in ((y, b), (x, a))
    )
    v, u = (np.arange(side)[part] for side, part in zip(wobble.shape, window, strict=True))
    radius = np.hypot((u - x)[None, :] / a, (v - y)[:, None] / b)
    mask[window] = radius + wobble[window] < 1
    return mask


def _placed(crop: Bool, x: int, y: int, shape: tuple[int, int]) -> Bool:
    """Return a mask of the given shape with `crop` at (x, y), False elsewhere."""
    image = np.zeros(shape, np.bool_)
    height, width = shape
    top, left = max(0, -y), max(0, -x)
    bottom, right = min(crop.shape[0], height - y), min(crop.shape[1], width - x)
    image[y + top : y + bottom, x + left : x + right] = crop[top:bottom, left:right]
    return image
