"""Tests for tracker=voxel_hashing_icp."""

import dataclasses
import pickle
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera, Frame, Pose
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError
from framework.geometry import exp_se3, inverse, rotation_angle
from framework.interfaces import SceneMap, SubmapChange
from framework.registry import assemble
from framework.sensors.noise_models import SensorKind
from framework.testing.corner_room import RoomMap, frame_at, pose_at
from framework.tracking.absolute_pose import AbsolutePose
from framework.tracking.features import Features
from framework.tracking.keyframes import Keyframe
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.trackers import voxel_hashing_icp
from plugins.trackers.voxel_hashing_icp import STEADY, Alignment, ResidualWeights, VoxelHashingIcp
from tests.support.scenes.analytic_scene import CAMERA, NOTHING, Scene, room, walk
from tests.support.scenes.papered_room import papered_frame

pytestmark = pytest.mark.integration


def run(tracker: VoxelHashingIcp, frames: list[Frame]) -> tuple[list[Pose], SceneMap]:
    fuser = assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0)
    poses = []
    for frame in frames:
        pose = tracker.track(frame, fuser.scene)
        if not pose.lost:
            fuser.fuse(frame, pose, NOTHING)
        poses.append(pose)
    return poses, fuser.scene


def drift(pose: Pose, frame: Frame) -> tuple[float, float]:
    """Return the position error, m, and the rotation error, rad."""
    assert frame.T_world_camera is not None
    error = inverse(frame.T_world_camera) @ pose.T_world_camera
    return float(np.linalg.norm(error[:3, 3])), rotation_angle(error[:3, :3])


@pytest.mark.parametrize("color_weight", [0.0, 0.1])
def test_voxel_hashing_icp_recovers_known_motion(color_weight: float) -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(40))]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0, color_weight=color_weight), frames)
    assert not any(pose.lost for pose in poses)
    worst = max(drift(pose, frame) for pose, frame in zip(poses, frames, strict=True))
    assert worst[0] < 0.004, "expected errors below a fifth of a voxel"
    assert drift(poses[-1], frames[-1])[1] < 0.003


def test_voxel_hashing_icp_keyframe_prevents_drift_when_static(shared: Path) -> None:
    """Without the keyframe, structure smaller than a voxel would bias the alignment."""
    frame = dataclasses.replace(RgbdFolder(shared / "data" / "redkitchen")[0], T_world_camera=np.eye(4))
    with_keyframe, alone = (
        run(VoxelHashingIcp(raw_keyframe=raw_keyframe), [frame] * 60)[0][-1] for raw_keyframe in (True, False)
    )
    assert drift(with_keyframe, frame)[0] < 0.001
    assert drift(alone, frame)[0] > 2 * drift(with_keyframe, frame)[0]


def test_voxel_hashing_icp_color_determines_motion_along_wall() -> None:
    """In front of a single wall, only the texture determines the sideways motion."""
    wall = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=1.0)
    frames = [wall.frame(T, k) for k, T in enumerate(walk(20))]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert not any(pose.lost for pose in poses)
    assert drift(poses[-1], frames[-1])[0] < 0.01
    alone, _ = run(VoxelHashingIcp(finest_scale=1.0, color_weight=0.0), frames)
    assert any(pose.lost for pose in alone), "expected lost frames: geometry alone does not determine the motion"


def enlarged(frame: Frame, scale: float) -> Frame:
    """Return the frame in a scene that is enlarged by `scale`."""
    assert frame.T_world_camera is not None
    T = frame.T_world_camera.copy()
    T[:3, 3] *= scale
    return dataclasses.replace(frame, depth=np.float32(scale) * frame.depth, T_world_camera=T)


@pytest.mark.parametrize("scale", [1, 8])
def test_voxel_hashing_icp_accuracy_is_independent_of_scale(scale: float) -> None:
    """At scale 8, the depth is 10 to 25 m, and the steps are 8 cm."""
    frames = [enlarged(room().frame(T, k), scale) for k, T in enumerate(walk(20))]
    fuser = assemble(BayesianTsdf, voxel_size=0.02 * scale, max_depth=4.0 * scale)
    tracker = VoxelHashingIcp(finest_scale=1.0)
    for frame in frames:
        pose = tracker.track(frame, fuser.scene)
        assert not pose.lost, pose.reason
        fuser.fuse(frame, pose, NOTHING)
    assert drift(pose, frames[-1])[0] < 0.004 * scale


@pytest.mark.parametrize(
    ("size", "scale"), [((640, 480), 0.5), ((1280, 720), 0.5), ((1920, 1440), 0.25), ((1440, 1920), 0.25)]
)
def test_voxel_hashing_icp_finest_side_is_bounded(size: tuple[int, int], scale: float) -> None:
    camera = Camera(*size, 500.0, 500.0, 0.5 * size[0], 0.5 * size[1])
    assert VoxelHashingIcp()._finest_scale(camera) == scale
    assert VoxelHashingIcp(finest_side=0)._finest_scale(camera) == 0.5


def test_voxel_hashing_icp_resumes_after_covered_frames() -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(30))]
    covered = [dataclasses.replace(f, depth=np.zeros_like(f.depth)) for f in frames[10:14]]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames[:10] + covered + frames[14:])
    assert [pose.lost for pose in poses] == [False] * 10 + [True] * 4 + [False] * 16
    assert "no depth" in poses[10].reason
    assert drift(poses[-1], frames[-1])[0] < 0.006


def test_voxel_hashing_icp_relocalizes_or_is_lost_after_jump() -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(20))]
    away = walk(1)[0].copy()
    away[:3, 3] += (0.0, 0.0, -1.2)
    frames.append(room().frame(away, 20))
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert poses[-1].lost or drift(poses[-1], frames[-1])[0] < 0.03
    poses, scene = run(VoxelHashingIcp(finest_scale=1.0, relocalize=False), frames)
    assert poses[-1].lost
    assert np.array_equal(poses[-1].T_world_camera, poses[-2].T_world_camera)
    assert np.median(room().distance(scene.mesh().vertices.astype(float))) < 0.004


@pytest.mark.parametrize("seconds", [0.0, 0.1])
def test_voxel_hashing_icp_does_not_depend_on_feature_timing(seconds: float) -> None:
    """In some frames, keyframes are needed while the worker thread is still extracting features."""
    path = [exp_se3(np.array([0.03 * k - 0.3, 0, 0, 0, 0.01 * k, 0])) for k in range(24)]
    for k in (8, 16, 17):
        path[k] = path[k] @ exp_se3(np.array([0, 0, -0.4, 0, 0.3, 0]))
    frames = [papered_frame(T, k) for k, T in enumerate(path)]
    at_once, later = VoxelHashingIcp(), VoxelHashingIcp()
    extract, nearest, track = later._keyframes.extractor.extract, later._keyframes.nearest, at_once.track
    offered = []

    def slow(frame: Frame) -> Features:
        time.sleep(seconds)
        return extract(frame)

    def asked(T_world_camera: np.ndarray) -> list[Keyframe]:
        offered.append(later._keyframes._offered is not None)
        return nearest(T_world_camera)

    def waiting(frame: Frame, scene: SceneMap) -> Pose:
        pose = track(frame, scene)
        at_once.keyframes()
        return pose

    later._keyframes.extractor.extract, later._keyframes.nearest = slow, asked
    at_once.track = waiting
    expected, found = run(at_once, frames)[0], run(later, frames)[0]
    assert any(offered)
    assert len(at_once.keyframes()["poses"]) > 4
    for pose, other in zip(found, expected, strict=True):
        assert (pose.lost, pose.reason) == (other.lost, other.reason)
        np.testing.assert_array_equal(pose.T_world_camera, other.T_world_camera)
    for name, array in at_once.keyframes().items():
        np.testing.assert_array_equal(later.keyframes()[name], array, err_msg=name)


def test_voxel_hashing_icp_pickle_includes_keyframes() -> None:
    frames = [papered_frame(exp_se3(np.array([0.03 * k, 0, 0, 0, 0, 0])), k) for k in range(8)]
    tracker = VoxelHashingIcp()
    _, scene = run(tracker, frames[:-1])
    copied = pickle.loads(pickle.dumps(tracker))
    for name, array in tracker.keyframes().items():
        np.testing.assert_array_equal(copied.keyframes()[name], array, err_msg=name)
    expected, found = (one.track(frames[-1], scene) for one in (tracker, copied))
    assert not expected.lost
    np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)


def test_voxel_hashing_icp_random_depth_is_lost() -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(5))]
    rng = np.random.default_rng(0)
    garbage = dataclasses.replace(frames[-1], depth=rng.uniform(0.5, 4, frames[-1].depth.shape).astype(np.float32))
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), [*frames[:4], garbage])
    assert poses[-1].lost


def test_voxel_hashing_icp_covered_video_starts_at_depth() -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(8))]
    covered = [dataclasses.replace(f, depth=np.zeros_like(f.depth)) for f in frames[:3]]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), covered + frames[3:])
    assert [pose.lost for pose in poses] == [True] * 3 + [False] * 5
    assert drift(poses[-1], frames[-1])[0] < 0.004


@pytest.mark.parametrize("size", [(161, 119), (163, 121)])
def test_voxel_hashing_icp_tracks_images_of_odd_sizes(size: tuple[int, int]) -> None:
    camera = Camera(*size, 131.0, 131.0, 80.0, 60.5)
    frames = [room().frame(T, k, camera) for k, T in enumerate(walk(10))]
    for finest in (1.0, 0.5):
        poses, _ = run(VoxelHashingIcp(finest_scale=finest), frames)
        assert not any(pose.lost for pose in poses)
        assert drift(poses[-1], frames[-1])[0] < 0.006


@pytest.mark.parametrize("finest", [0.3, 0.75, 2.0])
def test_voxel_hashing_icp_invalid_finest_scale_raises(finest: float) -> None:
    with pytest.raises(ConfigError, match="finest_scale: expected"):
        VoxelHashingIcp(finest_scale=finest)


def test_voxel_hashing_icp_renders_map_from_predicted_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(6))]
    tracker = VoxelHashingIcp(finest_scale=1.0)
    poses, scene = run(tracker, frames[:5])
    seen_from = []
    render = scene.render_near
    monkeypatch.setattr(scene, "render_near", lambda *view: seen_from.append(view[1]) or render(*view))
    tracker.track(frames[5], scene)
    last, before = poses[4].T_world_camera, poses[3].T_world_camera
    np.testing.assert_allclose(seen_from, [last @ inverse(before) @ last], atol=1e-9)


def test_voxel_hashing_icp_uses_sensor_of_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(3))]
    tracker = VoxelHashingIcp(finest_scale=1.0)
    _, scene = run(tracker, frames[:2])
    sensors = []
    render, aligned = scene.render_near, voxel_hashing_icp.linearize
    monkeypatch.setattr(scene, "render_near", lambda *view: sensors.append(view[3]) or render(*view))
    monkeypatch.setattr(
        voxel_hashing_icp, "linearize", lambda level, *rest: sensors.append(level.sensor) or aligned(level, *rest)
    )
    tracker.track(dataclasses.replace(frames[2], sensor=SensorKind.TIME_OF_FLIGHT), scene)
    assert len(sensors) > 3
    assert set(sensors) == {SensorKind.TIME_OF_FLIGHT}


@pytest.mark.parametrize("bound", [{"max_translation": 0.002}, {"max_rotation": 0.001}])
def test_voxel_hashing_icp_implausible_step_is_lost(bound: dict[str, float]) -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(2)[:1] + walk(60)[4:5])]
    assert not any(pose.lost for pose in run(VoxelHashingIcp(finest_scale=1.0), frames)[0])
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0, **bound), frames)
    assert poses[1].lost
    assert "implausible step of" in poses[1].reason
    assert np.array_equal(poses[1].T_world_camera, poses[0].T_world_camera)


def unusable_first_frames() -> dict[str, np.ndarray]:
    corner = np.zeros(CAMERA.shape, np.float32)
    corner[:10, :10] = 1.0
    return {"nothing": np.zeros_like(corner), "a corner": corner, "out of range": np.full_like(corner, 9.0)}


@pytest.mark.parametrize("name", unusable_first_frames())
def test_voxel_hashing_icp_starts_after_unusable_first_frame(name: str) -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(8))]
    frames[0] = dataclasses.replace(frames[0], depth=unusable_first_frames()[name])
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert poses[0].lost
    assert poses[0].reason
    assert not any(pose.lost for pose in poses[1:])
    assert drift(poses[-1], frames[-1])[0] < 0.004


def test_voxel_hashing_icp_depth_out_of_range_is_lost() -> None:
    far = [dataclasses.replace(f, depth=100 * f.depth) for f in (room().frame(T, k) for k, T in enumerate(walk(4)))]
    poses, scene = run(VoxelHashingIcp(finest_scale=1.0), far)
    assert scene.statistics.voxels == 0
    assert all(pose.lost for pose in poses)
    assert poses[-1].reason == "only 0.0% of the pixels have depth from 0.2 to 4 m"


def test_voxel_hashing_icp_continues_after_object_is_removed() -> None:
    """The ball covers several percent of the view. Without texture, no keyframe can confirm the pose."""
    planes = room().planes
    with_ball, without = (Scene(planes, spheres, contrast=0.0) for spheres in ([(np.array([0, 0.1, 1.3]), 0.2)], []))
    frames = [(with_ball if k < 10 else without).frame(T, k) for k, T in enumerate(walk(30)[:16])]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert not any(pose.lost for pose in poses)
    assert drift(poses[-1], frames[-1])[0] < 0.006


def test_voxel_hashing_icp_jump_resets_motion_prediction() -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(20))]
    away = walk(1)[0].copy()
    away[:3, 3] += (0.0, 0.0, -1.2)
    tracker = VoxelHashingIcp(finest_scale=1.0)
    poses, _ = run(tracker, [*frames, room().frame(away, 20)])
    assert not poses[-1].lost
    assert np.array_equal(tracker._T_last_next, np.eye(4))


def test_voxel_hashing_icp_too_small_image_raises() -> None:
    camera = Camera(30, 23, 25.0, 25.0, 14.5, 11.0)
    frame = Frame(0, 0.0, np.zeros((23, 30, 3), np.uint8), np.ones((23, 30), np.float32), camera)
    with pytest.raises(DataError, match=r"finest_scale: expected .*, got 2\.88 px with 0\.5 for images of 30x23 px"):
        VoxelHashingIcp(finest_scale=0.5).track(frame, BayesianTsdf().scene)


ONE_STEP = {
    "finest_scale": 1.0,
    "relocalize": False,
    "iterations_coarse": 0,
    "iterations_middle": 0,
    "iterations_fine": 1,
}


def test_voxel_hashing_icp_accepts_pose_after_good_final_step() -> None:
    """Before the final step, the error is 6 cm and few points agree with the map."""
    start = walk(1)[0]
    frames = [room().frame(T, k) for k, T in enumerate((start, start @ exp_se3(np.array([0.06, 0, 0, 0, 0, 0]))))]
    poses, _ = run(VoxelHashingIcp(**ONE_STEP), frames)
    assert not poses[1].lost
    assert drift(poses[1], frames[1])[0] < 0.03


def test_voxel_hashing_icp_is_lost_after_bad_final_step(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [room().frame(walk(1)[0], k) for k in range(2)]
    assert not any(pose.lost for pose in run(VoxelHashingIcp(**ONE_STEP), frames)[0])
    monkeypatch.setattr(voxel_hashing_icp, "_solved", lambda *_: np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    poses, _ = run(VoxelHashingIcp(**ONE_STEP), frames)
    assert poses[1].lost
    assert "match the map" in poses[1].reason


def aligned(T_world_camera: np.ndarray, agreement: float = 0.85, behind: float = 0.05) -> Alignment:
    """Return an alignment with imperfect agreement, e.g. due to inexact intrinsics."""
    return Alignment(T_world_camera, 0.7, agreement, behind, agreement / (1 - behind), "", "85% agree")


def moved(step: float) -> np.ndarray:
    return exp_se3(np.array([step, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_voxel_hashing_icp_steady_motion_needs_less_agreement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The camera moves by 1 cm per frame. At most 85 % of the points agree with the map."""
    frames = [room().frame(walk(1)[0], k) for k in range(2 * STEADY + 6)]
    ends = iter(moved(0.01 * k) for k in range(1, len(frames)))
    tracker = VoxelHashingIcp(finest_scale=1.0, relocalize=False)
    fuser = assemble(BayesianTsdf, voxel_size=0.02)
    fuser.fuse(frames[0], tracker.track(dataclasses.replace(frames[0], T_world_camera=None), fuser.scene), NOTHING)
    perfect = [True] * STEADY + [False] * (len(frames) - STEADY - 1)
    monkeypatch.setattr(
        tracker, "_align", lambda *_: (a := aligned(next(ends))) and (a._replace(doubt="") if perfect.pop(0) else a)
    )
    lost = [tracker.track(frame, fuser.scene).lost for frame in frames[1 : STEADY + 4]]
    assert not any(lost), "expected no lost frame while the predictions are correct"
    monkeypatch.setattr(tracker, "_align", lambda *_: aligned(tracker._T_world_last @ moved(0.2)))
    assert tracker.track(frames[-2], fuser.scene).lost, "expected a lost frame 20 cm from the prediction"
    for worse in (aligned(tracker._T_world_last, agreement=0.7), aligned(tracker._T_world_last, 0.8, behind=0.15)):
        tracker._lost_frames, tracker._steady_frames = 0, STEADY
        monkeypatch.setattr(tracker, "_align", lambda *_, worse=worse: worse)
        assert tracker.track(frames[-1], fuser.scene).lost


def test_voxel_hashing_icp_uses_features_until_motion_is_steady(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(40)[: STEADY + 4])]
    tracker, asked = VoxelHashingIcp(finest_scale=1.0), []
    search = tracker._pose_from_features
    monkeypatch.setattr(tracker, "_pose_from_features", lambda seen: asked.append(seen.frame.index) or search(seen))
    poses, _ = run(tracker, frames)
    assert not any(pose.lost for pose in poses)
    assert asked == list(range(1, STEADY))


def test_voxel_hashing_icp_features_reject_contradicting_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """All points agree with the map, but the position from features is 30 cm away."""
    frames = [room().frame(walk(1)[0], k) for k in range(2)]
    tracker = VoxelHashingIcp(finest_scale=1.0)
    fuser = assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0)
    fuser.fuse(frames[0], tracker.track(frames[0], fuser.scene), NOTHING)
    elsewhere = AbsolutePose(walk(1)[0] @ moved(0.3), np.ones(50, np.bool_))
    monkeypatch.setattr(tracker, "_pose_from_features", lambda _: elsewhere)
    pose = tracker.track(frames[1], fuser.scene)
    assert pose.lost or np.linalg.norm((inverse(elsewhere.T_world_camera) @ pose.T_world_camera)[:3, 3]) < 0.1


@pytest.mark.parametrize("moving", [False, True])
def test_voxel_hashing_icp_resumes_without_relocalization(moving: bool) -> None:
    """In four frames, half of the depth image is random. The camera is static or moves."""
    there = walk(30)[:14]
    frames = [room().frame(T, k) for k, T in enumerate(there)]
    hidden = [room().frame(there[7 + (k if moving else 0)], 7 + k) for k in range(4)]
    rng = np.random.default_rng(0)
    for frame in hidden:
        frame.depth[:, :80] = rng.uniform(0.5, 4, (120, 80))
    last = frames[11:] if moving else [room().frame(T, 11 + k) for k, T in enumerate(there[7:])]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0, relocalize=False), [*frames[:7], *hidden, *last])
    assert all(pose.lost for pose in poses[7:11])
    assert not any(pose.lost for pose in poses[11:])
    assert drift(poses[-1], last[-1])[0] < 0.006


LARGER = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)


def noisy(step: float, count: int) -> list[Frame]:
    """Return frames with Kinect noise. The camera moves by `step` m and 0.3 `step` rad per frame."""
    rng = np.random.default_rng(0)
    frames = [room().frame(exp_se3(step * k * np.array([1, 0, 0, 0, 0.3, 0])), k, LARGER) for k in range(count)]
    return [
        dataclasses.replace(
            f,
            depth=f.depth
            + rng.normal(0, 1, LARGER.shape).astype(np.float32) * (0.0012 + 0.0019 * (f.depth - 0.4) ** 2),
        )
        for f in frames
    ]


def test_voxel_hashing_icp_static_camera_keeps_pose() -> None:
    frames = noisy(0.0, 40)
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    changes = sum(not np.array_equal(a.T_world_camera, b.T_world_camera) for a, b in pairwise(poses))
    assert changes <= 2
    assert drift(poses[-1], frames[-1])[0] < 0.0006


def test_voxel_hashing_icp_tracks_slow_motion() -> None:
    """Each step of 0.1 mm is below the uncertainty, but the total of 6 mm is not."""
    frames = noisy(0.0001, 60)
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    stops = sum(np.array_equal(a.T_world_camera, b.T_world_camera) for a, b in pairwise(poses))
    assert 20 < stops < 59
    assert drift(poses[-1], frames[-1])[0] < 0.0015


@pytest.mark.parametrize(("step", "held"), [(0.0005, True), (0.002, False)])
def test_voxel_hashing_icp_keeps_pose_for_small_uncertain_motion(step: float, held: bool) -> None:
    """Along a wall with little texture, the uncertainty can be larger than the motion."""
    tracker = VoxelHashingIcp()
    tracker._T_world_last = moved(1.0)
    uncertain = aligned(moved(1.0 + step))._replace(covariance=np.eye(6))
    found = tracker._held(uncertain).T_world_camera
    np.testing.assert_array_equal(found, moved(1.0) if held else uncertain.T_world_camera)
    assert tracker._held(uncertain._replace(covariance=1e-12 * np.eye(6))).T_world_camera is uncertain.T_world_camera


def test_voxel_hashing_icp_covariance_matches_errors() -> None:
    """Errors of the motion between two frames are compared with the covariance."""
    frames = noisy(0.004, 30)
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert poses[0].covariance is not None
    assert not poses[0].covariance.any(), "expected no uncertainty of the first pose, which defines the world"
    squares = []
    for (a, b), (q_a, q_b) in zip(pairwise(poses[5:]), pairwise(frames[5:]), strict=True):
        E = inverse(inverse(q_a.T_world_camera) @ q_b.T_world_camera) @ inverse(a.T_world_camera) @ b.T_world_camera
        e = np.array([*E[:3, 3], E[2, 1], E[0, 2], E[1, 0]])
        squares.append(e @ np.linalg.solve(a.covariance + b.covariance, e) / 6)
    assert 0.02 < np.mean(squares) < 3


def test_voxel_hashing_icp_linear_weights_give_no_covariance() -> None:
    frames = [room().frame(T, k) for k, T in enumerate(walk(3))]
    tracker = VoxelHashingIcp(finest_scale=1.0, residual_weights=ResidualWeights.LINEAR, raw_keyframe=False)
    assert run(tracker, frames)[0][-1].covariance is None


def scattered(frame: Frame, missing: float) -> Frame:
    """Return the frame without depth at random pixels."""
    rng = np.random.default_rng(frame.index)
    return dataclasses.replace(frame, depth=np.where(rng.random(frame.depth.shape) < missing, 0, frame.depth))


def test_voxel_hashing_icp_tracks_scattered_depth() -> None:
    frames = [scattered(room().frame(T, k), 0.7) for k, T in enumerate(walk(30))]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert not any(pose.lost for pose in poses)
    assert drift(poses[-1], frames[-1])[0] < 0.006


def test_voxel_hashing_icp_lost_reason_names_scattered_depth() -> None:
    frames = [scattered(room().frame(T, k), 0.7) for k, T in enumerate(walk(3))]
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0, raw_keyframe=False), frames)
    assert poses[-1].lost
    assert "only 30% of the pixels have depth, most without neighbors" in poses[-1].reason


def coarse(frame: Frame) -> Frame:
    """Return the frame with depth in steps of 3.92 cm, i.e. 8 bits over a range of 10 m."""
    steps = (np.floor(frame.depth / 0.0392) + 0.5) * 0.0392
    return dataclasses.replace(frame, depth=np.where(frame.depth > 0, steps, 0).astype(np.float32))


def test_voxel_hashing_icp_tracks_coarse_depth_without_normals(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [coarse(room().frame(T, k)) for k, T in enumerate(walk(40)[::2])]
    matched: list[float] = []
    align = VoxelHashingIcp._align

    def recorded(*arguments) -> Alignment:
        alignment = align(*arguments)
        matched.append(alignment.matched)
        return alignment

    monkeypatch.setattr(VoxelHashingIcp, "_align", recorded)
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert not any(pose.lost for pose in poses)
    assert max(drift(pose, frame)[0] for pose, frame in zip(poses, frames, strict=True)) < 0.0392, (
        "expected errors below one depth step"
    )
    without_normals, matched[:] = np.mean(matched), []
    monkeypatch.setattr(voxel_hashing_icp, "is_coarse", lambda *_, **__: False)
    run(VoxelHashingIcp(finest_scale=1.0), frames)
    assert np.mean(matched) < 0.9 * without_normals, "expected fewer matches with normals, which depth steps distort"


def test_correction_moves_each_pose_with_its_submap() -> None:
    """The pose of the last frame, the raw keyframe and odometry move with the submap of the last frame."""
    tracker, T_last = VoxelHashingIcp(), np.eye(4)
    first, second = (exp_se3(np.array(xi)) for xi in ([0.3, 0, 0.1, 0, 0.2, 0], [-0.1, 0.2, 0, 0.3, 0, 0]))
    for k in (0, 2, 4, 14, 15):
        frame = dataclasses.replace(frame_at(k), T_odom_camera=pose_at(k))
        T_last = tracker.track(frame, RoomMap()).T_world_camera
        if k == 4:
            tracker.correct(SubmapChange(submap=1))
    assert tracker._T_world_odom is not None
    assert tracker._raw_keyframe is not None
    T_odom, T_raw = tracker._T_world_odom, tracker._raw_keyframe.T_world_camera
    [(_, T_visited), (_, T_revisited)] = tracker._visited
    tracker.correct(SubmapChange({0: first, 1: second}, submap=1))
    np.testing.assert_array_equal(tracker._T_world_last, second @ T_last)
    np.testing.assert_array_equal(tracker._T_world_odom, second @ T_odom)
    np.testing.assert_array_equal(tracker._raw_keyframe.T_world_camera, second @ T_raw)
    for (submap, T), number, expected in zip(
        tracker._visited, (0, 1), (first @ T_visited, second @ T_revisited), strict=True
    ):
        assert submap == number
        np.testing.assert_array_equal(T, expected)
    tracker.correct(SubmapChange(hidden=frozenset({0}), submap=2))
    assert [submap for submap, _ in tracker._visited] == [1]
