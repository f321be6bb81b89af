"""Tests for the comparison of frames with the map at given poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Detections, Float64, Frame, Pose
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import DataError
from framework.interfaces import MapFuser, SceneMap
from framework.mapping.labels.label_rule import LabeledVoxels
from framework.mapping.voxels.tsdf_volume import Tsdf, VoxelHashing
from framework.pipeline import Pipeline
from framework.refinement.lifting import lift
from framework.runtime.run_log import frame_ranges
from framework.tracking.map_agreement import check_resumed, map_agreement
from plugins.detectors.none import NoDetections
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.refiners.identity import Identity
from plugins.trackers.ground_truth import GroundTruth

pytestmark = pytest.mark.integration

DESK = TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy", stop=12)
SHIFTS = [(-0.3, 0, 0.1), (0, 0.3, 0), (0, 0, 0.3), (0, -0.2, 0.2), (0, 0.2, -0.25)]  # m, in the camera
TURNS = [(10, 0, 0), (0, 10, 0), (0, 12, 6), (-10, 5, 0), (0, -8, 8)]  # degrees, in the camera


def moved(shift: tuple[float, ...] = (0, 0, 0), turn: tuple[float, ...] = (0, 0, 0)) -> Float64:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = shift, Rotation.from_rotvec(np.radians(turn)).as_matrix()
    return T


def new_fuser() -> MapFuser:
    return BayesianTsdf(LabeledVoxels(VoxelHashing(Tsdf(voxel_size=0.02))))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(DESK)


@pytest.fixture(scope="module")
def scene(frames: list[Frame]) -> SceneMap:
    fuser = new_fuser()
    for frame in frames[:6]:
        assert frame.T_world_camera is not None
        pose = Pose(frame.T_world_camera)
        none = Detections.none(frame.depth.shape, (), detected=False)
        fuser.fuse(frame, pose, lift(none, frame, pose, None))
    return fuser.scene


def test_map_agreement_at_true_poses_is_high(frames: list[Frame], scene: SceneMap) -> None:
    for frame in frames[6:]:
        assert frame.T_world_camera is not None
        agreement = map_agreement(frame, frame.T_world_camera, scene)
        assert agreement.known
        assert agreement.disagreeing < 0.1


@pytest.mark.parametrize(
    "jump", [*(moved(shift=shift) for shift in SHIFTS), *(moved(turn=turn) for turn in TURNS)],
    ids=[*map(str, SHIFTS), *map(str, TURNS)],
)  # fmt: skip
def test_map_agreement_after_jump_disagrees(jump: Float64, frames: list[Frame], scene: SceneMap) -> None:
    assert frames[6].T_world_camera is not None
    assert map_agreement(frames[6], frames[6].T_world_camera @ jump, scene).disagrees


def test_map_agreement_elsewhere_is_unknown(frames: list[Frame], scene: SceneMap) -> None:
    agreement = map_agreement(frames[0], moved(shift=(100, 0, 0)), scene)
    assert not agreement.known
    assert not agreement.disagrees
    assert "0% of its depth on the map" in check_resumed(frames[0], agreement)


def test_resumed_map_in_other_world_frame_is_refused(frames: list[Frame], scene: SceneMap) -> None:
    assert frames[6].T_world_camera is not None
    assert check_resumed(frames[6], map_agreement(frames[6], frames[6].T_world_camera, scene)) == ""
    other = map_agreement(frames[6], frames[6].T_world_camera @ moved(shift=(0, 0, 0.4)), scene)
    with pytest.raises(DataError, match=r"resume_from: expected given poses in the world frame of the map, got"):
        check_resumed(frames[6], other)


def test_frame_ranges_joins_consecutive_frames() -> None:
    assert frame_ranges([3, 7, 8, 9, 12]) == "3, 7 to 9, 12"
    assert frame_ranges([]) == ""


class Jumping(GroundTruth):
    """Ground-truth poses that are 0.3 m farther from frame 8 on."""

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        assert frame.T_world_camera is not None
        return Pose(moved(shift=(0.3, 0, 0)) @ frame.T_world_camera if frame.index >= 8 else frame.T_world_camera)


def mapping(tracker: GroundTruth) -> Pipeline:
    return Pipeline(NoDetections(), tracker, Identity(), new_fuser(), prefetch=0)


def test_run_counts_frames_that_disagree(caplog: pytest.LogCaptureFixture) -> None:
    result = mapping(Jumping()).run(DESK)
    assert result.disagreeing is not None
    assert result.disagreeing[0] == 8
    assert f"{len(result.disagreeing)} of 12 frames disagree with the map at their given poses: frames 8" in caplog.text


def test_run_with_valid_poses_counts_none(caplog: pytest.LogCaptureFixture) -> None:
    assert mapping(GroundTruth()).run(DESK).disagreeing == ()
    assert "disagree" not in caplog.text


def test_run_on_map_of_other_world_frame_is_refused(scene: SceneMap) -> None:
    pipeline = mapping(Jumping())
    pipeline.fuser.resume(scene)
    pipeline.resumed = True
    with pytest.raises(DataError, match="resume_from: expected given poses in the world frame of the map"):
        pipeline.run(replace(DESK, start=8))
