"""Stages of the run that precedes a run to calibrate depth, and the back end of a map that cannot be corrected."""

from __future__ import annotations

from dataclasses import dataclass

from framework.data import Detections, Frame, Pose
from framework.interfaces import BackEnd, DepthCalibrator, Detector, SceneMap, SubmapChange


class NoObjects(Detector):
    """Detector of a map without objects."""

    classes = ("object",)

    def detect(self, frame: Frame) -> Detections:
        return Detections.none(frame.camera.shape, self.classes, detected=False)


@dataclass
class CalibratingBackEnd(BackEnd):
    """Back end that passes the frames to a calibration of depth."""

    depth: DepthCalibrator

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        self.depth.add(frame, pose)
        return None


@dataclass
class DepthOnly(BackEnd):
    """Back end that calibrates depth, but does not correct the map."""

    depth: DepthCalibrator | None

    @property
    def calibrator(self) -> DepthCalibrator | None:
        return self.depth
