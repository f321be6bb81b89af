"""Tests for the odometry of Open3D as a tracker."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from threading import Event

import numpy as np
import open3d as o3d
import pytest

from framework.data import Frame, Pose
from framework.errors import ConfigError
from framework.geometry import exp_se3, inverse, rotation_angle
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.trackers.open3d_odometry import Method, Open3dOdometry, Reference
from tests.support import registered
from tests.support.scenes.analytic_scene import NOTHING, walk
from tests.support.scenes.papered_room import CAMERA, papered_frame

LOOKING_INTO_A_CORNER = exp_se3(np.array([0, 0, 0, 0.5, 0.6, 0]))
BEST = [
    ({}, 0.01),
    # with color, Open3D drifts by a third of the motion, even on exact images
    ({"method": Method.HYBRID, "reference": Reference.PREVIOUS_FRAME}, 0.05),
    ({"method": Method.INTENSITY, "reference": Reference.PREVIOUS_FRAME}, 0.05),
]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [papered_frame(T @ LOOKING_INTO_A_CORNER, k) for k, T in enumerate(walk(12))]


DURING_IMPORT = """
import sys, threading, time
from plugins.trackers.open3d_odometry import Open3dOdometry
threading.Thread(target=__import__, args=("open3d",)).start()
while "open3d" not in sys.modules:
    time.sleep(0.001)
Open3dOdometry()
"""


def test_open3d_odometry_waits_for_import_in_another_thread() -> None:
    """The back end imports Open3D in a thread."""
    done = subprocess.run([sys.executable, "-c", DURING_IMPORT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def run(tracker: Open3dOdometry, frames: list[Frame]) -> list[Pose]:
    fuser = assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0)
    poses = []
    for frame in frames:
        pose = tracker.track(frame, fuser.scene)
        if not pose.lost:
            fuser.fuse(frame, pose, NOTHING)
        poses.append(pose)
    return poses


def assert_near(pose: Pose, frame: Frame, meters: float) -> None:
    assert frame.T_world_camera is not None
    error = inverse(frame.T_world_camera) @ pose.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < meters
    assert rotation_angle(error[:3, :3]) < meters


@pytest.mark.parametrize(("parameters", "meters"), BEST)
def test_open3d_odometry_recovers_known_motion(frames: list[Frame], parameters: dict, meters: float) -> None:
    poses = run(Open3dOdometry(**parameters), frames)
    assert not any(pose.lost for pose in poses)
    for pose, frame in zip(poses, frames, strict=True):
        assert_near(pose, frame, meters)
    assert np.linalg.norm(poses[-1].T_world_camera[:3, 3] - poses[0].T_world_camera[:3, 3]) > 0.05, (
        "expected a camera that moved"
    )


@pytest.mark.parametrize(("parameters", "meters"), BEST)
def test_open3d_odometry_resumes_after_uninformative_frames(
    frames: list[Frame], parameters: dict, meters: float
) -> None:
    rng = np.random.default_rng(0)
    shape = CAMERA.shape
    covered = replace(frames[4], depth=np.zeros(shape, np.float32), color=np.zeros((*shape, 3), np.uint8))
    garbage = replace(
        frames[5],
        depth=rng.uniform(0.5, 4, shape).astype(np.float32),
        color=rng.integers(0, 255, (*shape, 3)).astype(np.uint8),
    )
    poses = run(Open3dOdometry(**parameters), [*frames[:4], covered, garbage, *frames[6:8]])
    assert [pose.lost for pose in poses] == [False] * 4 + [True] * 2 + [False] * 2
    assert poses[4].reason == "the frame has no depth"
    assert poses[5].reason
    assert "\n" not in poses[5].reason
    np.testing.assert_array_equal(poses[5].T_world_camera, poses[3].T_world_camera)
    assert_near(poses[-1], frames[7], meters)


@contextmanager
def open3d_threads(threads: int) -> Iterator[None]:
    """Set Open3D's thread limit in the `with` body, 0 = no limit, while another thread uses Open3D."""
    ended = Event()
    points = np.random.default_rng(0).random((20_000, 3), np.float32)

    def load() -> None:
        while not ended.is_set():
            o3d.t.geometry.PointCloud(o3d.core.Tensor(points)).estimate_normals(10)

    o3d.utility.set_max_threads(threads)
    with ThreadPoolExecutor(1) as pool:
        loading = pool.submit(load)
        try:
            yield
        finally:
            ended.set()
            loading.result()
            o3d.utility.set_max_threads(0)


@pytest.mark.parametrize(("parameters", "meters"), BEST)
def test_open3d_odometry_is_independent_of_threads(frames: list[Frame], parameters: dict, meters: float) -> None:
    alone = run(Open3dOdometry(**parameters), frames[:4])
    for threads in (0, 1, 2):
        with open3d_threads(threads):
            loaded = run(Open3dOdometry(**parameters), frames[:4])
        for pose, expected in zip(loaded, alone, strict=True):
            np.testing.assert_array_equal(pose.T_world_camera, expected.T_world_camera)


def test_open3d_odometry_restores_thread_limit(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []
    monkeypatch.setattr(o3d.utility, "get_max_threads", lambda: 2)
    monkeypatch.setattr(o3d.utility, "set_max_threads", limits.append)
    run(Open3dOdometry(), frames[:2])
    assert limits == [1, 2]


def test_open3d_odometry_empty_map_is_lost_with_reason(frames: list[Frame]) -> None:
    tracker, scene = Open3dOdometry(), BayesianTsdf().scene
    assert not tracker.track(frames[0], scene).lost
    pose = tracker.track(frames[1], scene)
    assert pose.lost
    assert "\n" not in pose.reason


def test_open3d_odometry_starts_at_first_frame_with_depth(frames: list[Frame]) -> None:
    covered = replace(frames[0], depth=np.zeros(CAMERA.shape, np.float32))
    poses = run(Open3dOdometry(), [covered, *frames[1:4]])
    assert [pose.lost for pose in poses] == [True, False, False, False]
    assert_near(poses[-1], frames[3], 0.01)


@pytest.mark.parametrize("bound", [{"max_translation": 1e-3}, {"max_rotation": 1e-3}])
def test_open3d_odometry_implausible_step_is_lost(frames: list[Frame], bound: dict[str, float]) -> None:
    pose = run(Open3dOdometry(**bound), [frames[0], frames[2]])[1]
    assert pose.lost
    assert "implausible step of" in pose.reason


def test_open3d_odometry_method_is_set_by_name() -> None:
    assert registered.built("tracker", "open3d_odometry", "tracker.method=INTENSITY").method is Method.INTENSITY
    hybrid = registered.built("tracker", "open3d_odometry_hybrid")
    assert (hybrid.method, hybrid.reference) == (Method.HYBRID, Reference.PREVIOUS_FRAME)
    with pytest.raises(ConfigError, match="method"):
        registered.built("tracker", "open3d_odometry", "tracker.method=MAGIC")
    with pytest.raises(ConfigError, match=r"Open3dOdometry\.min_matched"):
        Open3dOdometry(min_matched=2.0)
