"""Acceptance tests for the default tracker.

Poses must be accurate on exact scenes, and the map must be accurate despite bad frames. Longer runs are part of the
benchmarks: `pytest tests/benchmarks -k slam`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

import numba
import numpy as np
import open3d as o3d
import pytest

from framework.data import Frame, Pose
from framework.datasets.rgbd_folder import RgbdFolder
from framework.evaluation.trajectory import evaluate
from framework.geometry import inverse
from framework.interfaces import SceneMap
from framework.registry import assemble
from framework.synthetic.sequence import Synthetic
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.trackers.voxel_hashing_icp import VoxelHashingIcp
from tests.support.rendered_frames import rendered_frames
from tests.support.scenes.analytic_scene import CAMERA, NOTHING, Scene, pose

pytestmark = pytest.mark.acceptance

VOXEL = 0.02  # m, for the small images of these tests
WRONG = 0.04  # m, two voxels; a pose with a larger error must be lost


def run(tracker: VoxelHashingIcp, frames: Iterable[Frame], voxel_size: float = VOXEL) -> tuple[list[Pose], SceneMap]:
    """Track and fuse all frames. Lost frames are not fused, like in the pipeline."""
    fuser = assemble(BayesianTsdf, voxel_size=voxel_size)
    poses = []
    for frame in frames:
        poses.append(tracker.track(frame, fuser.scene))
        if not poses[-1].lost:
            fuser.fuse(frame, poses[-1], NOTHING)
    return poses, fuser.scene


def drift(tracked: Pose, frame: Frame) -> float:
    """Return the distance, m, between the estimated and the true position."""
    assert frame.T_world_camera is not None
    return float(np.linalg.norm((inverse(frame.T_world_camera) @ tracked.T_world_camera)[:3, 3]))


def drifts(poses: Sequence[Pose], frames: Sequence[Frame]) -> np.ndarray:
    """Return the distances (n,), m, between estimated and true positions, NaN = lost."""
    return np.array([np.nan if p.lost else drift(p, f) for p, f in zip(poses, frames, strict=True)])


@pytest.fixture(scope="module")
def wall() -> list[Frame]:
    """Return frames of a camera that moves 0.6 m along a flat, textured wall. The depth noise is 2 mm.

    This motion is only determined by the texture.
    """
    scene = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=1.0)
    rng = np.random.default_rng(0)
    exact = [scene.frame(pose(0.01 * k, 0.02 * np.sin(0.1 * k)), k) for k in range(60)]
    noise = [rng.normal(0, 0.002, CAMERA.shape).astype(np.float32) for _ in exact]
    return [dataclasses.replace(f, depth=f.depth + n) for f, n in zip(exact, noise, strict=True)]


def test_tracking_with_color_is_accurate_on_flat_wall(wall: list[Frame]) -> None:
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0), wall)
    assert not any(p.lost for p in poses)
    assert drift(poses[-1], wall[-1]) < 0.01


@pytest.mark.parametrize("min_information", [VoxelHashingIcp.min_information, 0.0], ids=["default", "unchecked"])
def test_tracking_without_color_drifts_or_is_lost_on_flat_wall(min_information: float, wall: list[Frame]) -> None:
    poses, _ = run(VoxelHashingIcp(finest_scale=1.0, color_weight=0.0, min_information=min_information), wall)
    assert any(p.lost for p in poses) or drift(poses[-1], wall[-1]) > 0.1


def test_tracking_drift_without_noise_is_below_one_voxel() -> None:
    """The frames are the first 40 frames of a benchmark, with voxels of 1 cm."""
    room = Synthetic(frames=240, stop=40, noise=0.0)
    frames = rendered_frames(room)
    poses, _ = run(VoxelHashingIcp(), frames, voxel_size=0.01)
    assert not any(p.lost for p in poses)
    assert drift(poses[-1], frames[39]) < 0.002


def test_tracking_with_color_is_not_less_accurate(shared_data: Path) -> None:
    """Color must not increase the trajectory error in a real kitchen."""
    frames = list(RgbdFolder(shared_data / "redkitchen", stop=80, stride=2))
    truth = [f.T_world_camera for f in frames]
    both, alone = (evaluate(truth, run(VoxelHashingIcp(color_weight=w), frames)[0]) for w in (0.1, 0.0))
    assert both.frames == len(frames), "expected no lost frame"
    assert both.ate_rmse_m < 0.015
    assert both.ate_rmse_m < alone.ate_rmse_m + 0.001


class Surface:
    """The exact surface of a synthetic room."""

    def __init__(self, room: Synthetic) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        surfaces = room.room.surfaces
        self._scene.add_triangles(
            o3d.core.Tensor(surfaces.vertices), o3d.core.Tensor(surfaces.triangles.astype(np.uint32))
        )

    def error(self, scene: SceneMap) -> tuple[float, float]:
        """Return the median distance of the mesh vertices, m, and the fraction of vertices that are two voxels away."""
        distance = self._scene.compute_distance(o3d.core.Tensor(scene.mesh().vertices)).numpy()
        return float(np.median(distance)), float((distance > 2 * VOXEL).mean())


@pytest.fixture(scope="module")
def room() -> Synthetic:
    """Return a furnished room with Kinect noise and images of 320x240 px."""
    return Synthetic(frames=240, stop=80, width=320, height=240)


@pytest.fixture(scope="module")
def frames(room: Synthetic) -> list[Frame]:
    return rendered_frames(room)


@pytest.fixture(scope="module")
def surface(room: Synthetic) -> Surface:
    return Surface(room)


@pytest.fixture(scope="module")
def elsewhere() -> list[Frame]:
    return rendered_frames(Synthetic(scene="elsewhere", frames=240, stop=3, width=320, height=240))


@pytest.fixture(scope="module")
def clean_error(frames: list[Frame], surface: Surface) -> tuple[float, float]:
    """Return the errors of the map without bad frames, see `Surface.error`."""
    return surface.error(run(VoxelHashingIcp(), [*frames[:60], *frames[60:5:-1]])[1])


def black(frame: Frame) -> Frame:
    """Return the frame with black color and without depth."""
    return dataclasses.replace(frame, depth=np.zeros_like(frame.depth), color=np.zeros_like(frame.color))


def plain(frame: Frame) -> Frame:
    """Return the frame with a blank wall at 1 m."""
    return dataclasses.replace(frame, depth=np.full_like(frame.depth, 1.0), color=np.full_like(frame.color, 200))


def garbage(frame: Frame) -> Frame:
    rng = np.random.default_rng([7, frame.index])
    return dataclasses.replace(
        frame,
        depth=rng.uniform(0.4, 5.0, frame.depth.shape).astype(np.float32),
        color=rng.integers(0, 256, frame.color.shape, np.uint8),
    )


def assert_robust(
    poses: list[Pose], shown: list[Frame], error: tuple[float, float], clean: tuple[float, float]
) -> None:
    """Check that wrong poses are lost, that the last poses are correct, and that the map is accurate."""
    off = drifts(poses, shown)
    worst = np.nanargmax(off)
    assert off[worst] < WRONG, f"frame {worst}: expected an error below {WRONG} m or a lost pose, got {off[worst]:.3f}"
    assert not np.isnan(off[-10:]).any(), (
        f"expected tracked frames in the mapped area, got lost frames: {poses[-1].reason}"
    )
    assert error[0] < clean[0] + 0.1 * VOXEL
    assert error[1] < clean[1] + 0.02


def there_and_back(frames: list[Frame], begin: int, bad: list[Frame], end: int) -> list[Frame]:
    """Return the frames with [begin, end) replaced with `bad`, ten more frames, and the way back to the start."""
    return [*frames[:begin], *bad, *frames[end : end + 10], *frames[end + 10 : 5 : -1]]


@pytest.mark.parametrize(
    ("spoilt", "count"),
    [
        (black, 10),
        (plain, 10),
        (garbage, 1),
        (garbage, 5),
    ],
)
def test_tracking_of_bad_frames_keeps_map_accurate(
    spoilt, count: int, frames: list[Frame], surface, clean_error
) -> None:
    shown = there_and_back(frames, 25, [spoilt(f) for f in frames[25 : 25 + count]], 25 + count)
    poses, scene = run(VoxelHashingIcp(), shown)
    assert all(p.lost for p in poses[25 : 25 + count])
    assert_robust(poses, shown, surface.error(scene), clean_error)


def test_tracking_after_cut_to_other_room_keeps_map_accurate(
    frames: list[Frame], elsewhere, surface, clean_error
) -> None:
    bad = [dataclasses.replace(f, depth=e.depth, color=e.color) for f, e in zip(frames[25:28], elsewhere, strict=True)]
    shown = there_and_back(frames, 25, bad, 28)
    poses, scene = run(VoxelHashingIcp(), shown)
    assert all(p.lost for p in poses[25:28])
    assert_robust(poses, shown, surface.error(scene), clean_error)


@pytest.mark.parametrize("missing", [3, 5, 20, 40])
def test_tracking_after_jump_is_accurate_or_lost(missing: int, frames: list[Frame], surface, clean_error) -> None:
    """The jumps are 4, 9, 30 and 58 cm, and 2, 5, 17 and 33 degrees."""
    shown = there_and_back(frames, 25, [], 25 + missing)
    poses, scene = run(VoxelHashingIcp(), shown)
    assert_robust(poses, shown, surface.error(scene), clean_error)


def test_tracking_after_jump_in_real_video_is_accurate_or_lost(shared_data: Path) -> None:
    """The reference poses have errors of one to two centimeters."""
    frames = list(RgbdFolder(shared_data / "redkitchen", stop=70))
    shown = [*frames[:25], *frames[45:55], *frames[55:5:-2]]
    poses, _ = run(VoxelHashingIcp(), shown)
    off = drifts(poses, shown)
    assert np.nanmax(off) < WRONG
    assert not np.isnan(off[-5:]).any()


def test_tracking_of_sparse_video_is_accurate() -> None:
    """Steps of 6 cm and 3 degrees alternate with steps of 40 cm and 22 degrees, which a motion model cannot predict."""
    video = Synthetic(frames=240, stop=200, width=320, height=240)
    sparse = rendered_frames(video, [k for k in range(200) if k % 32 in (0, 4)])
    poses, _ = run(VoxelHashingIcp(), sparse)
    assert not any(p.lost for p in poses)
    assert drifts(poses, sparse).max() < WRONG / 2
    alone, _ = run(VoxelHashingIcp(relocalize=False), sparse[:4])
    assert any(p.lost for p in alone), "expected lost frames without features"


BALL = (np.array([-1.2, 0.8, 2.2]), 0.25)


@pytest.mark.parametrize("spheres", [[BALL], []], ids=["ball", "bare"])
def test_tracking_of_textureless_wall_is_lost(spheres: list[tuple[np.ndarray, float]]) -> None:
    """The camera moves from a corner to a wall without texture, and back."""
    corner = Scene(
        planes=[
            (np.array([0.0, 0.0, -1.0]), -2.5),
            (np.array([0.0, -1.0, 0.0]), -1.0),
            (np.array([1.0, 0.0, 0.0]), -1.6),
        ],
        spheres=spheres,
        contrast=0.0,
    )
    there = [pose(-1.1 + 1.6 * s, 0.5 - 0.8 * s, 1.0) for s in np.linspace(0, 1, 100)]
    shown = [corner.frame(T, k) for k, T in enumerate([*there, *there[::-1]])]
    wall_only = [bool((corner.render(CAMERA, f.T_world_camera)[2] == 1).all()) for f in shown]
    assert sum(wall_only) >= 20
    poses, scene = run(VoxelHashingIcp(finest_scale=1.0), shown)
    errors = drifts(poses, shown)
    assert all(p.lost for p, blank in zip(poses, wall_only, strict=True) if blank)
    assert np.nanmax(errors) < WRONG
    assert not np.isnan(errors[-10:]).any()
    assert np.median(corner.distance(scene.mesh().vertices.astype(float))) < 0.1 * VOXEL


def test_tracking_does_not_depend_on_thread_count(frames: list[Frame], tmp_path: Path) -> None:
    saved, tracked = [], []
    before = numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        poses, scene = run(VoxelHashingIcp(), [*frames[:12], garbage(frames[12]), *frames[40:43], *frames[12:15]])
        scene.save(tmp_path / "map.npz")
        saved.append((tmp_path / "map.npz").read_bytes())
        tracked.append(np.array([p.T_world_camera for p in poses]))
    numba.set_num_threads(before)
    assert np.array_equal(*tracked)
    assert saved[0] == saved[1]
