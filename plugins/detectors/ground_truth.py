"""Detector that returns the ground truth, an upper bound of detection accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import require
from framework.data import Detections, Frame
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.true_instances import true_instances
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import ClassNames, read_labels, to_class_names


@dataclass
class GroundTruthDetector(Detector):
    """Visible ground-truth instances of known class, with exact masks.

    The score and the probability of the class are 1. The detector raises DataError if the sequence has no instance
    ground truth.
    """

    # minimum number of pixels of a detected instance, >= 1; 64 is about the limit of real detectors
    min_pixels: int = 64
    label_space: str = "coco"  # class names: a label space such as coco, or a text file with one name per line
    exact: bool = True  # True = refiners do not change the masks

    def __post_init__(self) -> None:
        require(self.min_pixels >= 1, "detector.min_pixels", self.min_pixels, "at least 1 px")
        self.classes = to_class_names(read_labels(self.label_space), ClassNames.OWN).classes

    def detect(self, frame: Frame) -> Detections:
        truth = true_instances(frame, self.classes, self.min_pixels)
        return Detections(
            masks=truth.masks,
            boxes=tight_boxes(truth.masks),
            scores=np.ones(len(truth), np.float32),
            class_probabilities=np.eye(len(self.classes), dtype=np.float32)[truth.class_ids],
            classes=self.classes,
            exact=self.exact,
        )
