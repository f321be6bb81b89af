"""Tests for the tracker of preset=paper.

The parameters are those of VoxelHashing, without additional checks and relocalization.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest

from framework.data import Frame, Pose
from framework.errors import ConfigError
from framework.geometry import exp_se3
from plugins.trackers import voxel_hashing_icp
from plugins.trackers.voxel_hashing_icp import ResidualWeights, VoxelHashingIcp
from tests.support.registered import built
from tests.support.scenes.analytic_scene import Scene, room, walk
from tests.support.tracked_frames import track_and_fuse

pytestmark = pytest.mark.integration


def paper_tracker(*overrides: str) -> VoxelHashingIcp:
    tracker = built("tracker", "voxel_hashing_icp_paper", *overrides)
    assert isinstance(tracker, VoxelHashingIcp)
    return tracker


def drift(pose: Pose, frame: Frame) -> float:
    """Return the distance, m, between the estimated and the true position."""
    assert frame.T_world_camera is not None
    return float(np.linalg.norm(pose.T_world_camera[:3, 3] - frame.T_world_camera[:3, 3]))


def walked(count: int) -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(count))]


def covered(frame: Frame) -> Frame:
    return dataclasses.replace(frame, depth=np.zeros_like(frame.depth))


def test_paper_tracker_recovers_known_motion() -> None:
    frames = walked(40)
    poses = track_and_fuse(paper_tracker(), frames)
    assert not any(pose.lost for pose in poses)
    assert max(drift(pose, frame) for pose, frame in zip(poses, frames, strict=True)) < 0.008


def test_paper_tracker_uses_published_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each level has separate iterations, weights and gates."""
    calls: list[tuple[int, Any, float, Any]] = []
    linearize = voxel_hashing_icp.linearize

    def noted(level: Any, model: Any, intensity: Any, T: Any, weights: Any, brightness: float, linear: Any) -> Any:
        calls.append((level.camera.width, weights, brightness, linear))
        equations = linearize(level, model, intensity, T, weights, brightness, linear)
        return equations._replace(brightness=0.2)

    monkeypatch.setattr(voxel_hashing_icp, "linearize", noted)
    monkeypatch.setattr(voxel_hashing_icp, "CONVERGED", 0.0)
    track_and_fuse(paper_tracker(), walked(2))
    widths = [width for width, *_ in calls]
    assert [widths.count(width) for width in (40, 80, 160)] == [4, 6, 8 + 1]  # 1 more for the result
    for width, weights, brightness, linear in calls:
        assert weights.color_weight == (0 if width == 160 else 1)
        assert weights.depth_weight == 1
        assert weights.max_distance == np.float32(0.15)
        assert weights.min_normal_dot == np.float32(0.97)
        assert linear == (np.float32(4.0), np.float32(0.1)), "expected the max_depth of the map, 4 m"
        assert brightness == 0, "expected no compensation of exposure"


def test_paper_tracker_lost_frames_keep_last_pose() -> None:
    frames = walked(30)
    away = [room().frame(exp_se3(np.array([0, 0, -1.4, 0, 0, 0])) @ walk(1)[0], k) for k in range(10, 13)]
    shown = [*frames[:10], *away, covered(frames[10]), *frames[10:]]
    poses = track_and_fuse(paper_tracker(), shown)
    assert [pose.lost for pose in poses] == [False] * 10 + [True] * 4 + [False] * 20
    for pose in poses[10:14]:
        np.testing.assert_array_equal(pose.T_world_camera, poses[9].T_world_camera)
    assert drift(poses[-1], frames[-1]) < 0.008


def test_paper_tracker_uses_no_features(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = paper_tracker()

    def fail(*_: object) -> None:
        raise AssertionError("features were extracted")

    monkeypatch.setattr(tracker._keyframes.extractor, "extract", fail)
    frames = walked(12)
    lost = [pose.lost for pose in track_and_fuse(tracker, [*frames[:8], covered(frames[8]), *frames[8:]])]
    assert lost == [False] * 8 + [True] + [False] * 4
    assert not tracker.keyframes()
    assert not tracker._visited


def hidden_frames() -> list[Frame]:
    """Return frames along a path. In the last frame, half of the depth image is random."""
    frames = walked(8)
    frames[-1].depth[:, :80] = np.random.default_rng(0).uniform(0.5, 4, (120, 80))
    return frames


def test_paper_tracker_agreement_is_not_checked() -> None:
    """Half of the points are random. The checks of the default tracker would reject the pose."""
    poses = track_and_fuse(paper_tracker(), hidden_frames())
    assert not any(pose.lost for pose in poses)
    assert drift(poses[-1], hidden_frames()[-1]) < 0.01
    checked = track_and_fuse(paper_tracker("tracker.min_agreement=0.92"), hidden_frames())
    assert checked[-1].lost
    occluded = track_and_fuse(paper_tracker("tracker.max_occluded=0.015"), hidden_frames())
    assert occluded[-1].lost


@pytest.mark.parametrize("steady", [0, 10**9])
def test_paper_tracker_steady_motion_has_no_effect(monkeypatch: pytest.MonkeyPatch, steady: int) -> None:
    frames = hidden_frames()
    expected = track_and_fuse(paper_tracker(), frames)
    monkeypatch.setattr(voxel_hashing_icp, "STEADY", steady)
    for pose, other in zip(track_and_fuse(paper_tracker(), frames), expected, strict=True):
        assert pose.lost == other.lost
        np.testing.assert_array_equal(pose.T_world_camera, other.T_world_camera)


def test_paper_tracker_recovers_with_single_alignment(monkeypatch: pytest.MonkeyPatch) -> None:
    aligned: list[bool] = []
    align = VoxelHashingIcp._align
    monkeypatch.setattr(VoxelHashingIcp, "_align", lambda *a: aligned.append(True) or align(*a))  # type: ignore[func-returns-value]
    frames = walked(6)
    poses = track_and_fuse(paper_tracker(), [*frames[:4], covered(frames[4]), *frames[4:]])
    assert [pose.lost for pose in poses] == [False] * 4 + [True] + [False] * 2
    assert len(aligned) == len(poses) - 1


def test_paper_tracker_frame_with_few_matching_points_is_lost() -> None:
    frames = walked(5)
    noise = np.random.default_rng(0).uniform(0.5, 4, frames[-1].depth.shape).astype(np.float32)
    poses = track_and_fuse(paper_tracker(), [*frames[:4], dataclasses.replace(frames[-1], depth=noise)])
    assert poses[-1].lost
    assert "match the map" in poses[-1].reason
    poses = track_and_fuse(paper_tracker("tracker.min_matched=1"), frames)
    assert all(pose.lost for pose in poses[1:])


def test_paper_tracker_frame_with_implausible_step_is_lost() -> None:
    frames = walked(8)
    assert not track_and_fuse(paper_tracker(), [frames[0], frames[4]])[1].lost
    poses = track_and_fuse(paper_tracker("tracker.max_translation=0.002"), [frames[0], frames[4]])
    assert "implausible step of" in poses[1].reason


def test_paper_tracker_frame_of_single_wall_is_lost() -> None:
    """Color is not used at the finest level, so the motion along the wall is undetermined."""
    wall = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=1.0)
    poses = track_and_fuse(paper_tracker(), [wall.frame(T, k) for k, T in enumerate(walk(3))])
    assert [pose.lost for pose in poses] == [False, True, True]
    assert "does not determine the motion" in poses[1].reason


def test_paper_tracker_linear_weights_have_small_effect() -> None:
    frames = walked(12)
    tukey, linear = (
        track_and_fuse(VoxelHashingIcp(finest_scale=1.0, residual_weights=weights), frames)
        for weights in ResidualWeights
    )
    assert not np.array_equal(tukey[-1].T_world_camera, linear[-1].T_world_camera)
    assert max(drift(poses[-1], frames[-1]) for poses in (tukey, linear)) < 0.006


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["tracker.residual_weights=HUBER"], "residual_weights"),
        (["tracker.max_intensity_difference=0"], r"max_intensity_difference: expected a value in \[0\.001, 1\]"),
        (["tracker.color_levels=0"], r"color_levels: expected a value in \[1, 3\]"),
        (["tracker.depth_weight=0"], "color_levels: expected 3 if depth_weight is 0, got 2"),
    ],
)
def test_paper_tracker_invalid_parameter_raises(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        paper_tracker(*overrides)
