"""Detector without detections."""

from __future__ import annotations

from dataclasses import dataclass

from framework.data import Detections, Frame
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import COCO


@dataclass
class NoDetections(Detector):
    """Detector without detections, for maps without instances."""

    def __post_init__(self) -> None:
        self.classes = COCO

    def detect(self, frame: Frame) -> Detections:
        return Detections.none(frame.camera.shape, self.classes)
