"""Tests for the calibration of depth that precedes a run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from framework.data import Detections, Frame, Pose
from framework.errors import DataError, NoPoseError
from framework.interfaces import BackEnd, DepthCalibrator, PoseTracker
from framework.pipeline import Pipeline
from framework.sensors.depth_distortion import NODES, DepthDistortion
from framework.testing.corner_room import CAMERA
from tests.support.scenes.corner_room import CornerRoom, GridFuser, KeepAll, LiveRoom, SphereDetector
from tests.support.scenes.given_changes import GivenChanges, RoomTracker, SubmapFuser

LONGER = DepthDistortion(np.full(NODES, 0.02), CAMERA.shape)  # z + 0.02 z^2


@dataclass
class GivenDistortion(DepthCalibrator):
    """Calibration with a given result."""

    given: DepthDistortion | None = LONGER
    count: int = 4
    added: list[int] = field(default_factory=list)

    def frames(self, available: int) -> int:
        return min(self.count, available)

    def add(self, frame: Frame, pose: Pose) -> None:
        self.added.append(frame.index)

    def distortion(self) -> DepthDistortion | None:
        return self.given


@dataclass
class Calibrating(GivenChanges):
    calibration: GivenDistortion = field(default_factory=GivenDistortion)

    @property
    def calibrator(self) -> DepthCalibrator:
        return self.calibration


@dataclass
class SeesDepth(RoomTracker):
    """Tracker that stores the mean depth of each frame."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.depths: list[float] = []

    def track(self, frame: Frame, scene: object) -> Pose:
        self.depths.append(float(frame.depth.mean()))
        return super().track(frame, scene)  # type: ignore[arg-type]


class Unposed(RoomTracker):
    def track(self, frame: Frame, scene: object) -> Pose:
        raise NoPoseError(f"frame {frame.index}: no pose")


class Broken(RoomTracker):
    def track(self, frame: Frame, scene: object) -> Pose:
        raise ValueError("broken")


def pipeline(backend: BackEnd, tracker: PoseTracker | None = None) -> Pipeline:
    return Pipeline(SphereDetector(), tracker or SeesDepth(), KeepAll(), SubmapFuser(), backend=backend)


def test_calibration_precedes_run_and_corrects_all_frames(room: CornerRoom) -> None:
    backend, tracker = Calibrating({}, last=None), SeesDepth()
    result = pipeline(backend, tracker).run(room)
    assert backend.calibration.added == [0, 1, 2, 3]
    expected = [float(LONGER.corrected(frame.depth).mean()) for frame in room]
    np.testing.assert_allclose(tracker.depths, expected)  # this tracker saw only the frames of the run
    assert result.frames == 6
    assert result.depth_distortion is LONGER


def test_calibration_precedes_run_whose_map_cannot_be_corrected(room: CornerRoom) -> None:
    backend = Calibrating({}, last=None)
    result = Pipeline(SphereDetector(), SeesDepth(), KeepAll(), GridFuser(), backend=backend).run(room)
    assert backend.calibration.added == [0, 1, 2, 3]
    assert result.depth_distortion is LONGER


@pytest.mark.parametrize("calibration", [GivenDistortion(None), GivenDistortion(count=0)])
def test_calibration_without_result_keeps_depth(room: CornerRoom, calibration: GivenDistortion) -> None:
    tracker = SeesDepth()
    result = pipeline(Calibrating({}, last=None, calibration=calibration), tracker).run(room)
    np.testing.assert_array_equal(tracker.depths, [float(frame.depth.mean()) for frame in room])
    assert result.depth_distortion is None


def test_calibration_does_not_detect_objects(room: CornerRoom) -> None:
    class Counts(SphereDetector):
        def detect(self, frame: Frame) -> Detections:
            counted.append(frame.index)
            return super().detect(frame)

    counted: list[int] = []
    Pipeline(Counts(), SeesDepth(), KeepAll(), SubmapFuser(), backend=Calibrating({}, last=None)).run(room)
    assert sorted(counted) == list(range(6))


def test_calibration_of_live_video_is_omitted() -> None:
    backend = Calibrating({}, last=None)
    result = pipeline(backend).run(LiveRoom())
    assert not backend.calibration.added
    assert result.depth_distortion is None


def test_calibration_of_resumed_map_is_omitted(room: CornerRoom) -> None:
    backend = Calibrating({}, last=None)
    mapping = pipeline(backend)
    mapping.run(room)
    mapping.depth_distortion = None
    backend.calibration.added.clear()
    mapping.run(CornerRoom(frames=12, start=6))
    assert not backend.calibration.added
    assert mapping.depth_distortion is None


def test_calibration_is_omitted_if_correction_is_known(room: CornerRoom) -> None:
    backend, known = Calibrating({}, last=None), DepthDistortion(np.full(NODES, 0.01), CAMERA.shape)
    mapping = pipeline(backend)
    mapping.depth_distortion = known
    assert mapping.run(room).depth_distortion is known
    assert not backend.calibration.added


def test_calibration_without_usable_frames_reports_error_of_run(room: CornerRoom) -> None:
    with pytest.raises(DataError, match="expected poses, got none for the 6 frames"):
        pipeline(Calibrating({}, last=None), Unposed()).run(room)


def test_calibration_error_of_stage_is_raised(room: CornerRoom) -> None:
    with pytest.raises(ValueError, match="broken"):
        pipeline(Calibrating({}, last=None), Broken()).run(room)
