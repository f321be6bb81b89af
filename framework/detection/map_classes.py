"""Detections with the classes of a stored map, which may have more classes than the detector.

Renaming instances (`instancemap edit`) can add classes to a map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from framework.data import Detections, Frame
from framework.detection.stored.cache import fields_read, identity_of
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import ConfigError
from framework.interfaces import Detector, RGBDSequence


@dataclass
class DetectorOfMap(Detector):
    """Detector with additional classes of probability 0."""

    detector: Detector
    classes: tuple[str, ...]  # all classes of the detector, and others

    def __post_init__(self) -> None:
        self.concurrent, self.domain = self.detector.concurrent, self.detector.domain
        self.calibration = self.detector.calibration
        self.reads = fields_read(self.detector)
        self._columns = [self.classes.index(name) for name in self.detector.classes]

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {identity_of(self.detector)}"

    def check_sequence(self, sequence: RGBDSequence) -> None:
        self.detector.check_sequence(sequence)

    def detect(self, frame: Frame) -> Detections:
        found = self.detector.detect(frame)
        probabilities = np.zeros((len(found), len(self.classes)), np.float32)
        probabilities[:, self._columns] = found.class_probabilities
        return replace(found, class_probabilities=probabilities, classes=self.classes)


def with_classes_of_map(detector: Detector, classes: tuple[str, ...]) -> Detector:
    """Return a detector with the classes of a stored map. A map without frames has no classes.

    Raises:
        ConfigError: The map lacks a class of the detector.
    """
    if classes in ((), detector.classes):
        return detector
    if unknown := [name for name in detector.classes if name not in classes]:
        rest = f" and {len(unknown) - 3} more" if len(unknown) > 3 else ""
        raise ConfigError(
            f"detector: expected the {len(classes)} classes of the stored map, got other classes "
            f"({', '.join(map(repr, unknown[:3]))}{rest}); choose the detector and label space that made the map"
        )
    return DetectorOfMap(detector, classes)
