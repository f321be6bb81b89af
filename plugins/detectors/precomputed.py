"""Detections from other programs, read from files."""

from __future__ import annotations

import hashlib
import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Detections, Float32, Frame
from framework.detection.candidates import spread_rest
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.stored.coco_results import read_results
from framework.detection.stored.fingerprint import fingerprint
from framework.detection.stored.frame_matching import ImageIds, ImageIndex, check_matches
from framework.detection.stored.image_names import ImageId, ImageName, shown
from framework.detection.stored.mask_folder import read_mask_folder
from framework.detection.stored.stored_detection import StoredDetection
from framework.errors import ConfigError, DataError
from framework.interfaces import Detector, RGBDSequence
from framework.vocabulary.category_ids import CategoryIds
from framework.vocabulary.label_spaces import NO_CLASS, ClassNames, read_labels, to_class_names

log = logging.getLogger(__name__)

FRAMES_IN_DOUBT = 30  # number of initial frames without an entry after which a warning is logged


@dataclass
class Precomputed(Detector):
    """Detections from a COCO results file or a mask folder, by file name or frame index.

    COCO results files are written by `instancemap detect` and by other programs. A mask folder contains two files for
    each frame, such as 000012.png and 000012.json. The first is an image of 8-bit or 16-bit instance ids, and the
    second is a list of {"id", "class", "score"}.

    Annotation files of COCO datasets are also read.

    A file name belongs to the frame whose color image has the same name. Folders, the file type and zeros before the
    number are ignored. A whole number is the index of the frame; see `image_ids`.

    Both formats may contain `class_probabilities` over the names in `label_space`. Without them, a detection with the
    score s gets the probability 1 - class_spread * (1 - s) for its class. The minimum is 1 / (number of classes). The
    other classes share the rest equally. Detections whose best label has no class name are dropped; see `class_names`.

    A frame without an entry has no detections. If no entry belongs to a frame of the sequence, the detector raises
    DataError, because the file belongs to another sequence.
    """

    # COCO results file (e.g. from `instancemap detect`), or mask folder with 000000.png, 000000.json, ...
    path: Path
    # class names: a label space (coco, nyu40, scenenn, ...), or a text file with one name per line
    label_space: str = "coco"
    # class names: COCO, OWN (those of the label space) or AUTO (COCO for names of known label spaces, otherwise OWN)
    class_names: ClassNames = ClassNames.AUTO
    category_ids: CategoryIds = CategoryIds.AUTO  # numbering of category_id
    image_ids: ImageIds = ImageIds.AUTO  # meaning of whole numbers as image ids
    score_threshold: float = 0.0  # minimum score of a detection, in [0, 1]
    # fraction of (1 - score) distributed over the other classes, for detections with one class, in [0, 1]; 0 = certain
    # label
    class_spread: float = 1.0

    reads = ("index", "camera", "image_name")

    def __post_init__(self) -> None:
        check_bounds(self, score_threshold=(0.0, 1.0), class_spread=(0.0, 1.0))
        self.path = Path(self.path).expanduser()
        self._labels = read_labels(self.label_space)
        repeated = next((n for k, n in enumerate(self._labels) if n != NO_CLASS and n in self._labels[:k]), None)
        if repeated is not None:
            raise ConfigError(f"detector.label_space: expected unique names, got {repeated!r} twice")
        if self.path.is_dir():
            stored = read_mask_folder(self.path, self._labels)
        else:
            stored = read_results(self.path, self._labels, self.category_ids)
        if not stored:
            raise DataError(f"{self.path}: expected at least one detection, got none")
        probabilities, known = self._distributions(stored)
        if not known.any():
            raise DataError(
                f"{self.path}: expected detections of known classes, got none in {len(stored)} detections; check "
                "detector.label_space"
            )
        if not known.all():
            lost = sorted({one.label for one, is_known in zip(stored, known, strict=True) if not is_known})
            log.info("%s: %d of %d detections dropped because their classes have no COCO name: %s",
                     self.path, int((~known).sum()), len(stored), ", ".join(lost))  # fmt: skip
        self._images = list(dict.fromkeys(one.image for one in stored))
        self._index = ImageIndex(self._images, self.image_ids, self.path)
        self._complete = all(one.probabilities is not None for one in stored)
        self._of_image: dict[ImageId, list[tuple[StoredDetection, Float32]]] = defaultdict(list)
        for one, row, is_known in zip(stored, probabilities, known, strict=True):
            if is_known and one.score >= self.score_threshold:
                self._of_image[one.image].append((one, row))
        self._matched = False
        self._requested: set[int] = set()

    def fingerprint(self) -> str:
        """Return a hash that includes the labels, which may come from a file."""
        return hashlib.sha256(repr((fingerprint(self), self._labels)).encode()).hexdigest()

    def check_sequence(self, sequence: RGBDSequence) -> None:
        if frames := sequence.image_names():
            # files of `instancemap detect` have distributions; their image ids are frame indices
            check_matches(self.path, self._images, self.image_ids, frames, warns=not self._complete)
            self._matched = True

    def detect(self, frame: Frame) -> Detections:
        name = ImageName.of(frame.image_name) if frame.image_name else None
        images = self._index.of_frame(frame.index, name)
        self._expect_a_match(frame, bool(images))
        stored = [pair for image in images for pair in self._of_image.get(image, [])]
        if not stored:
            return Detections.none(frame.camera.shape, self.classes)
        stored.sort(key=lambda pair: -pair[0].score)  # stable: equal scores keep the order of the file
        masks = np.stack([_mask(one, frame) for one, _ in stored])
        tight = tight_boxes(masks)
        return Detections(
            masks=masks,
            boxes=np.stack([own if one.box is None else one.box for (one, _), own in zip(stored, tight, strict=True)]),
            scores=np.array([one.score for one, _ in stored], np.float32),
            class_probabilities=np.stack([row for _, row in stored]),
            classes=self.classes,
            exact=all(one.exact for one, _ in stored),
        )

    def _distributions(self, stored: Sequence[StoredDetection]) -> tuple[Float32, Bool]:
        """Return the class distributions (N, C), and set `classes` to the names of their columns.

        The second result is a Boolean array (N,), True for detections whose best label has a class name.
        """
        index = {name: k for k, name in enumerate(self._labels)}
        one_hot = np.eye(len(self._labels), dtype=np.float32)
        given = np.stack([one_hot[index[one.label]] if one.probabilities is None else one.probabilities
                          for one in stored])  # fmt: skip
        only_label = np.array([one.probabilities is None for one in stored])
        mapping = to_class_names(self._labels, self.class_names)
        self.classes = mapping.classes
        rows, known = mapping.apply(given)
        if self.classes == self._labels:
            rows = given  # unchanged, because normalizing could change the last digit
        scores = np.array([one.score for one in stored])
        rows[only_label] = spread_rest(rows[only_label], scores[only_label], self.class_spread)
        return rows, known

    def _expect_a_match(self, frame: Frame, found: bool) -> None:
        """Raise DataError or log a warning if the frames requested so far have no detections."""
        if self._matched or found:
            self._matched = True
            return
        in_doubt = len(self._requested) < FRAMES_IN_DOUBT
        if in_doubt:
            self._requested.add(frame.index)
        numbers = [one if isinstance(one, int) else one.number for one in self._images]
        known = [number for number in numbers if number is not None]
        if not known and not frame.image_name:
            raise DataError(
                f"detector.path: expected frame numbers in {self.path}, got only file names (first: "
                f"{shown(self._images[0])}), but frame {frame.index} has no file; use frame numbers as image ids"
            )
        has = f"{self.path} with detections for {len(self._images)} images (first: {shown(self._images[0])})"
        if len(known) == len(numbers) and not frame.image_name:
            has = f"{self.path} with detections for frames {min(known)} to {max(known)}"
            if frame.index > max(known):
                raise DataError(
                    f"detector.path: expected detections of this sequence, got {has} and none for the frames "
                    f"requested so far, up to {frame.index}; check that the file belongs to this sequence"
                )
        if in_doubt and len(self._requested) == FRAMES_IN_DOUBT:
            log.warning(
                "detector.path: expected detections of this sequence, got %s and none for the first %d frames; "
                "check that the file belongs to this sequence",
                has,
                FRAMES_IN_DOUBT,
            )


def _mask(stored: StoredDetection, frame: Frame) -> Bool:
    try:
        return stored.segmentation.mask(frame.camera.shape)
    except DataError as error:  # a FrameError skips the frame
        raise type(error)(f"{stored.where}: frame {frame.index}: {error}") from error
