"""Tests for rendered views of the map, compared with exact depth, normals and colors."""

import numpy as np
import pytest

from framework.config.composition import composed
from framework.data import Camera, Frame
from framework.interfaces import MapFuser
from framework.mapping.labels.evidence_rows import EvidenceRows
from framework.mapping.voxels import raycasting
from framework.mapping.voxels.integration import Integrator
from framework.mapping.voxels.integration_parameters import Sensor, pinhole
from framework.mapping.voxels.raycasting import cast_view, render, render_surface, tile_bounds
from framework.mapping.voxels.raycasting_kernels import TILE, cast_coarse
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_walk import inverses, leave_cell
from framework.registry import build
from framework.sensors.noise_models import SensorKind
from tests.support.scenes.analytic_scene import Scene, pose, room, walk

VOXEL = 0.02
SENSOR = Sensor(*map(np.float32, (4 * VOXEL, 0.0, 0.2, 4.0, 100.0, 10.0)))
CAMERA = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)


def mapped(scene: Scene, poses: list[np.ndarray]) -> VoxelGrid:
    integrator = Integrator(VoxelGrid(VOXEL, SENSOR.max_truncation, 100_000), SENSOR)
    for k, T in enumerate(poses):
        integrator.integrate(scene.frame(T, k, CAMERA), T, VOXEL)
    return integrator.voxels


@pytest.mark.parametrize("slant", [0.0, 0.4, 0.8, 1.1])
def test_raycast_slanted_plane_depth_is_unbiased(slant: float) -> None:
    """If a pixel or voxel center were off by half a unit, the bias would depend on the slant."""
    n = np.array([np.sin(slant), 0.3, -np.cos(slant)]) / np.linalg.norm([np.sin(slant), 0.3, -np.cos(slant)])
    scene = Scene(planes=[(n, n @ np.array([0.0, 0.0, 1.8]))])
    voxels = mapped(scene, walk(20))
    T = pose(0.05, 0.02, 0.03, (0.02, 0.03, 0.0))
    view = render(voxels, EvidenceRows(voxels).evidence, SENSOR, CAMERA, T)
    exact, _, _ = scene.render(CAMERA, T)
    both = (view.depth > 0) & (exact > 0)
    assert both.mean() > 0.5 * (exact[exact < 3.5] > 0).mean() * (exact < 3.5).mean()
    error = (view.depth - exact)[both]
    assert np.median(np.abs(error)) < 0.1 * VOXEL
    assert abs(np.median(error)) < 0.05 * VOXEL
    assert np.median(view.normals_world[both] @ n) > 0.999


def test_raycast_noisy_distant_wall_is_unbiased() -> None:
    """The noise exceeds a voxel. Depth in front of and behind the surface must have equal weights."""
    voxel, depth = 0.01, 4.0
    sensor = Sensor(*map(np.float32, (4 * voxel, 0.01, 0.2, 5.0, 200.0, 1.5)))
    integrator = Integrator(VoxelGrid(voxel, sensor.max_truncation, 100_000), sensor)
    rng = np.random.default_rng(0)
    camera = Camera(80, 60, 65.5, 65.5, 39.5, 29.5)
    for _ in range(60):
        wall = rng.normal(depth, SensorKind.KINECT_V1.sigma(depth), camera.shape).astype(np.float32)
        frame = Frame(0, 0.0, np.zeros((*camera.shape, 3), np.uint8), wall, camera)
        integrator.integrate(frame, np.eye(4), voxel)
    seen, _ = cast_view(integrator.voxels, sensor, camera, np.eye(4))
    assert abs(np.median(seen[seen > 0]) - depth) < 0.2 * voxel


def test_raycast_spheres_have_accurate_depth_without_holes() -> None:
    scene = room()
    voxels = mapped(scene, walk(30))
    T = walk(30)[15]
    view = render(voxels, EvidenceRows(voxels).evidence, SENSOR, CAMERA, T)
    exact, color, surface = scene.render(CAMERA, T)
    on_sphere = surface > len(scene.planes)
    both = (view.depth > 0) & on_sphere
    assert both.sum() > 0.9 * on_sphere.sum(), "expected no holes in mapped areas"
    assert np.median(np.abs(view.depth - exact)[both]) < 0.1 * VOXEL
    assert np.median(np.abs(view.color.astype(float) - color)[both]) < 6
    assert (view.instance_ids == 0).all()
    assert (view.class_ids == -1).all()


def test_raycast_without_front_face_in_view_is_empty() -> None:
    voxels = mapped(room(), [pose()])
    evidence = EvidenceRows(voxels).evidence
    away = render(voxels, evidence, SENSOR, CAMERA, pose(rotvec=(0, np.pi, 0)))
    assert (away.depth == 0).all()
    behind = render(voxels, evidence, SENSOR, CAMERA, pose(z=5.0, rotvec=(0, np.pi, 0)))
    assert (behind.depth == 0).mean() > 0.95, "expected no rendered back faces"
    empty = VoxelGrid(VOXEL, SENSOR.max_truncation, 10)
    nothing = render(empty, EvidenceRows(empty).evidence, SENSOR, CAMERA, pose())
    assert (nothing.depth == 0).all()


@pytest.mark.parametrize("d", [0.0, -0.0, 1e-20, -1e-20])
def test_leave_cell_axis_parallel_ray_exits_opposite_side(d: float) -> None:
    """A ray along a block face must not advance in steps of 0.001 voxels.

    Such rays are in the middle column of a camera with cx at a pixel center.
    """
    direction = tuple(np.float32([d, d, 1.0]))
    start = tuple(np.float32([0.03, -0.05, 0.01]))
    side = np.float32(0.16)
    assert leave_cell(np.float32(0.0), start, direction, inverses(direction), side, 1 / side) == pytest.approx(0.15)


@pytest.mark.parametrize("d", [0.3, -0.3])
def test_leave_cell_slanted_ray_exits_nearest_border(d: float) -> None:
    direction = tuple(np.float32([d, 0.0, 1.0]))
    start = tuple(np.float32([0.02 if d < 0 else 0.14, 0.0, 0.0]))
    side = np.float32(0.16)
    z = leave_cell(np.float32(0.0), start, direction, inverses(direction), side, 1 / side)
    assert z == pytest.approx(0.02 / 0.3, rel=1e-4)


@pytest.mark.parametrize("k", range(6))
def test_raycast_bounds_match_exhaustive_search(k: int) -> None:
    """A search along the complete ray of every pixel finds no other surface."""
    voxels = mapped(room(), [pose()])
    camera = Camera(161, 119, 90.0, 95.0, 70.0, 61.0) if k % 2 else CAMERA
    rng = np.random.default_rng(k)
    T = pose(*rng.uniform(-0.8, 0.8, 3), tuple(rng.uniform(-0.7, 0.7, 3)))
    depth, _ = cast_view(voxels, SENSOR, camera, T)
    exhaustive = every_ray(voxels, T, camera)
    assert (exhaustive > 0).mean() > 0.1
    # at the ragged border of the map, gaps depend on where a step starts
    assert ((depth == 0) & (exhaustive > 0)).mean() < 4e-3
    assert ((depth > 0) & (exhaustive == 0)).mean() < 15e-3
    both = (depth > 0) & (exhaustive > 0)
    assert np.quantile(np.abs(depth - exhaustive)[both], 0.99) < 0.05 * VOXEL


@pytest.mark.parametrize("sparse", ["every pixel", "every fourth column", "one in ten"])
def test_raycast_near_sensor_depth_finds_surface(sparse: str) -> None:
    """The surface must be found at all pixels with sensor depth, including those between the coarse rays."""
    voxels = mapped(room(), [pose()])
    T = pose(0.1, -0.05, 0.1, (0.05, 0.1, 0.0))
    exhaustive = every_ray(voxels, T)
    readings = np.where(exhaustive > 0, exhaustive + np.float32(0.3 * VOXEL), np.float32(0))
    if sparse == "every fourth column":
        readings[:, np.arange(readings.shape[1]) % 4 != 1] = 0
    elif sparse == "one in ten":
        readings[np.random.default_rng(0).uniform(size=readings.shape) > 0.1] = 0
    depth = render_surface(voxels, SENSOR, CAMERA, T, readings).depth
    given = readings > 0
    assert given.sum() > 500
    assert (depth[~given] == 0).all()
    assert (depth[given] > 0).mean() > 0.99
    found = given & (depth > 0)
    assert np.quantile(np.abs(depth - exhaustive)[found], 0.99) < 0.05 * VOXEL


def test_raycast_ignores_surface_beyond_sensor_range() -> None:
    """The map was made with a sensor that has a longer range."""
    voxels = mapped(room(), [pose()])
    farthest = cast_view(voxels, SENSOR, CAMERA, pose())[0].max()
    short = SENSOR._replace(max_depth=np.float32(0.8 * farthest))
    for k in range(4):
        depth, _ = cast_view(voxels, short, CAMERA, pose(rotvec=(0, 0.1 * k, 0)))
        assert (depth > 0).any()
        assert depth.max() <= short.max_depth


def every_ray(voxels: VoxelGrid, T: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Return the depth (H, W), m, found by a search along the complete ray of every pixel."""
    tiles = tuple((side + TILE - 1) // TILE for side in camera.shape)
    near, far = (np.full(tiles, bound, np.float32) for bound in (SENSOR.min_depth, SENSOR.max_depth))
    depth = np.empty((camera.height + 1, camera.width + 1), np.float32)
    cast_coarse(voxels.grid, pinhole(camera, T), near, far, 1, camera.shape, depth)
    return depth[:-1, :-1]


def test_tile_bounds_ignore_block_next_to_camera() -> None:
    voxels = mapped(room(), walk(3))
    voxels.allocate(np.int32([[0, 2, 0]]))  # 32 cm below the camera, out of view
    voxels.grid.solid[voxels.block_count - 1] = True
    tile_near, _ = tile_bounds(voxels, SENSOR, CAMERA, pose())
    assert np.quantile(tile_near[:20], 0.1) > 0.5


@pytest.mark.parametrize("fuser", ["bayesian_tsdf", "object_volumes", "class_only_fusion"])
def test_render_near_uses_noise_of_sensor(fuser: str, monkeypatch: pytest.MonkeyPatch) -> None:
    noises = []
    monkeypatch.setattr(raycasting, "cast_near", lambda *given: noises.append(given[-2]) or given[-1].fill(0))
    scene = build(MapFuser, composed(f"fuser={fuser}").fuser).scene
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    scene.render_near(CAMERA, np.eye(4), depth)
    scene.render_near(CAMERA, np.eye(4), depth, SensorKind.PHONE_LIDAR)
    assert noises == [SensorKind.KINECT_V1.noise, SensorKind.PHONE_LIDAR.noise]
