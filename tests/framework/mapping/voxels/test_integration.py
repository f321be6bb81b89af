"""Tests for TSDF integration, compared with a slow reference and with exact surfaces."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from framework.data import Frame
from framework.errors import FrameError, MapFullError
from framework.geometry import inverse
from framework.mapping.voxels import integration
from framework.mapping.voxels.integration import GOLDEN, Integrator, SeenBlocks
from framework.mapping.voxels.integration_kernels import MIN_WEIGHT_BEHIND
from framework.mapping.voxels.integration_parameters import Sensor
from framework.mapping.voxels.tsdf_volume import VoxelHashing
from framework.mapping.voxels.voxel_grid import TSDF_MAX, WEIGHT_ONE, VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import OUTDATED, UNSEEN, mark_outdated
from framework.registry import assemble
from framework.sensors.noise_models import SensorKind
from tests.support.scenes.analytic_scene import CAMERA, pose, room, walk
from tests.support.thread_counts import by_one_thread_and_two

SENSOR = Sensor(*map(np.float32, (0.08, 0.01, 0.2, 4.0, 100.0, 1.5)))
VOXEL = 0.02


def new_integrator() -> Integrator:
    return Integrator(VoxelGrid(VOXEL, SENSOR.max_truncation, 100_000), SENSOR)


def seen_by(integrator: Integrator, frame: Frame, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the updated blocks (A,) and the pixel of each voxel (A, 512), -1 = far from the surface."""
    seen = integrator.integrate(frame, T_world_camera, VOXEL)
    pixels = np.full((len(seen.blocks), 512), -1)
    for a, (first, count) in enumerate(zip(seen.near_start, seen.near_count, strict=True)):
        voxels = seen.near_voxel[first : first + count]
        assert (np.diff(voxels.astype(int)) > 0).all()
        pixels[a, voxels] = seen.near_pixel[first : first + count]
    return seen.blocks, pixels


def test_integration_of_one_frame_matches_reference() -> None:
    """The reference updates all voxels of the blocks with NumPy in double precision."""
    frame = room().frame(pose(0.1, -0.05, 0.0, (0.1, -0.2, 0.05)))
    integrator = new_integrator()
    active, near_pixel = seen_by(integrator, frame, frame.T_world_camera)
    grid = integrator.voxels.grid
    i, j, k = np.meshgrid(*[np.arange(8)] * 3, indexing="ij")
    offsets = np.stack([i, j, k], axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    points = (grid.block_coords[active][:, None] * 8 + offsets) * VOXEL
    T_camera_world = inverse(frame.T_world_camera)
    p = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    u = CAMERA.fx * p[..., 0] / p[..., 2] + CAMERA.cx
    v = CAMERA.fy * p[..., 1] / p[..., 2] + CAMERA.cy
    column, row = np.floor(u + 0.5).astype(int), np.floor(v + 0.5).astype(int)
    inside = (p[..., 2] > SENSOR.min_depth) & (column >= 0) & (row >= 0)
    inside &= (column < CAMERA.width) & (row < CAMERA.height)
    d = np.where(inside, frame.depth[row.clip(0, CAMERA.height - 1), column.clip(0, CAMERA.width - 1)], 0)
    band = SENSOR.truncation + SENSOR.truncation_slope * d
    seen = inside & (d > SENSOR.min_depth) & (d < SENSOR.max_depth) & (d - p[..., 2] >= -band)
    distance = np.minimum(d - p[..., 2], band)
    # in float32, voxels at a pixel border or at the edge of the band can be rounded to either side
    clear = (np.abs(u + 0.5 - np.round(u + 0.5)) > 1e-3) & (np.abs(v + 0.5 - np.round(v + 0.5)) > 1e-3)
    clear &= (np.abs(d - p[..., 2] + band) > 1e-4) & inside
    stored = grid.tsdf[active]
    assert ((stored != UNSEEN) == seen)[clear].all()
    both = clear & seen
    assert both.sum() > 20_000
    unit = SENSOR.max_truncation / TSDF_MAX
    assert np.abs(stored * unit - distance)[both].max() < 2e-5
    near = np.where(seen & (np.abs(d - p[..., 2]) <= VOXEL), row * CAMERA.width + column, -1)
    clear_band = clear & (np.abs(np.abs(d - p[..., 2]) - VOXEL) > 1e-4)
    assert (near_pixel == near)[clear_band].all()
    behind = np.clip((band + d - p[..., 2]) / (SENSOR.truncation - VOXEL), MIN_WEIGHT_BEHIND, 1)
    expected_weight = behind * np.minimum(1, (SENSOR.full_weight_depth / np.maximum(d, 1e-9)) ** 2) * WEIGHT_ONE
    assert np.abs(grid.weight[active] - np.maximum(expected_weight, 1))[both].max() < 1.001


@pytest.mark.parametrize("promised", [100_000, 10], ids=["reserved", "not reserved"])
def test_integration_reuses_reserved_memory_for_more_blocks(monkeypatch: pytest.MonkeyPatch, promised: int) -> None:
    monkeypatch.setattr(integration, "reserved", lambda most, make: make(min(most, promised)))
    integrator, T = new_integrator(), walk(1)[0]
    frame = room().frame(T, 0)
    left = replace(frame, depth=np.where(np.arange(CAMERA.width) < 20, frame.depth, np.float32(0.0)))
    few = integrator.integrate(left, T, VOXEL)
    more = integrator.integrate(frame, T, VOXEL)
    assert len(more.blocks) > 2 * len(few.blocks) > 20
    assert np.shares_memory(few.near_pixel, more.near_pixel) == (promised == 100_000)

    alone = new_integrator().integrate(frame, T, VOXEL)
    assert near_pixels(more) == near_pixels(alone)


def near_pixels(seen: SeenBlocks) -> list[int]:
    """Return the sorted pixels of all voxels near the surface, one entry per voxel."""
    parts = zip(seen.near_start.tolist(), seen.near_count.tolist(), strict=True)
    return sorted(p for first, count in parts for p in seen.near_pixel[first : first + count].tolist())


def test_integration_allocates_blocks_near_surface() -> None:
    """Blocks are allocated in the whole truncation band, not only along the rays."""
    frame = room().frame(pose())
    integrator = new_integrator()
    integrator.integrate(frame, frame.T_world_camera, VOXEL)
    v, u = np.nonzero(frame.depth)
    d = frame.depth[v, u]
    surface = np.stack([(u - CAMERA.cx) / CAMERA.fx * d, (v - CAMERA.cy) / CAMERA.fy * d, d], axis=-1)
    blocks = {tuple(c) for c in integrator.voxels.grid.block_coords[: integrator.voxels.block_count]}
    wanted = {tuple(c) for c in np.floor(surface / (8 * VOXEL)).astype(int)}
    assert len(wanted - blocks) <= 0.02 * len(wanted), (
        "expected only blocks seen by fewer pixels than the stride to be missing"
    )


@pytest.mark.parametrize("frame_number", [987, 2584, 121393])
def test_integration_rounding_does_not_wrap_around(frame_number: int) -> None:
    """In these frames, the rounding offset is almost 1 and must not cause an overflow."""
    assert (frame_number * GOLDEN) % 1.0 > 0.9995
    scene = room()
    frame = scene.frame(pose())
    frame.color[:] = 255
    integrator = Integrator(VoxelGrid(VOXEL, 0.08, 100_000), SENSOR._replace(truncation_slope=np.float32(0.0)))
    for number in (1, frame_number):
        integrator.frames = number - 1
        active, near = seen_by(integrator, frame, np.eye(4))
    grid = integrator.voxels.grid
    seen = grid.weight[active] > 0
    assert (grid.tsdf[active][seen] != UNSEEN).all()
    assert (grid.tsdf[active][seen] == TSDF_MAX).sum() > 10_000
    assert (channels(grid.color[active][near >= 0]) == 255).all()


def channels(packed: np.ndarray) -> np.ndarray:
    """Return the RGB colors (N, 3), 0 to 255, of packed colors (N,)."""
    return np.stack([packed & 1023, (packed >> 10) & 1023, (packed >> 20) & 1023], axis=-1) / 4


@pytest.mark.parametrize("depth", [0.0, 0.1, 7.0])
def test_integration_outside_sensor_range_allocates_no_blocks(depth: float) -> None:
    frame = Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), np.full(CAMERA.shape, depth, np.float32), CAMERA)
    integrator = new_integrator()
    integrator.integrate(frame, np.eye(4), VOXEL)
    assert integrator.voxels.block_count == 0


@pytest.mark.parametrize(
    ("options", "T", "error", "message"),
    [
        (
            {"voxel_size": 1e-4, "truncation_slope": 1.0, "max_depth": 1000.0},
            0.0,
            MapFullError,
            r"fuser\.truncation_slope: expected a truncation band of at most .* blocks",
        ),
        (
            {"voxel_size": 1e-4, "truncation": 50.0},
            0.0,
            MapFullError,
            r"fuser\.max_blocks: expected at most .* blocks in the map, got at least [0-9]+ for one frame",
        ),
        (
            {"voxel_size": 1e-3},
            9e3,
            FrameError,
            r"tracker: expected surfaces within .* m of the origin \(fuser\.voxel_size=.* m\), got 90[0-9.]+ m",
        ),
    ],
)
def test_integration_over_limits_raises_before_allocation(
    options: dict[str, float], T: float, error: type[Exception], message: str
) -> None:
    volume = assemble(VoxelHashing, max_blocks=1000, **options).new_volume()
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = T
    depth = np.linspace(0.5, 4.5, CAMERA.width * CAMERA.height, dtype=np.float32).reshape(CAMERA.shape)
    frame = Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), depth, CAMERA)
    tracemalloc.start()
    try:
        with pytest.raises(error, match=message):
            volume.integrate(frame, T_world_camera, 0.01)
        assert tracemalloc.get_traced_memory()[1] < 3e8
    finally:
        tracemalloc.stop()


def test_integration_stores_color_only_near_surface() -> None:
    frame = room().frame(pose())
    frame.color[:] = (10, 200, 90)
    sensor = SENSOR._replace(truncation_slope=np.float32(0.0))
    integrator = Integrator(VoxelGrid(VOXEL, sensor.max_truncation, 100_000), sensor)
    active, near = seen_by(integrator, frame, np.eye(4))
    grid = integrator.voxels.grid
    assert np.abs(channels(grid.color[active][near >= 0]) - (10, 200, 90)).max() <= 0.25
    air = grid.tsdf[active] == TSDF_MAX
    assert air.sum() > 1000
    assert (grid.color[active][air] == 0).all()


def test_integration_does_not_average_color_of_free_space() -> None:
    """The initial color of free space is black. If a wall moves there, its color must not be mixed with black."""
    integrator = new_integrator()
    for depth, frames in ((1.5, 5), (1.4, 13)):
        wall = np.full(CAMERA.shape, depth, np.float32)
        frame = Frame(0, 0.0, np.full((*CAMERA.shape, 3), 200, np.uint8), wall, CAMERA)
        for _ in range(frames):
            integrator.integrate(frame, np.eye(4), VOXEL)
    grid = integrator.voxels.grid
    packed = grid.color[: integrator.voxels.block_count]
    assert (packed == 0).any()
    assert np.abs(channels(packed[packed > 0]) - 200).max() <= 0.25


def test_integration_next_observation_replaces_outdated_color() -> None:
    integrator = new_integrator()
    wall = np.full(CAMERA.shape, 1.5, np.float32)
    wall[:, CAMERA.width // 2 :] = 0  # visible only in the first frames
    whole = np.full(CAMERA.shape, 1.5, np.float32)

    def integrate(depth: np.ndarray, level: int) -> None:
        color = np.full((*CAMERA.shape, 3), level, np.uint8)
        integrator.integrate(Frame(0, 0.0, color, depth, CAMERA), np.eye(4), VOXEL)

    for _ in range(20):
        integrate(whole, 200)
    grid, blocks = integrator.voxels.grid, integrator.voxels.block_count
    mark_outdated(grid.color, blocks)
    assert np.abs(channels(grid.color[:blocks][grid.color[:blocks] > 0]) - 200).max() <= 0.25
    integrate(wall, 40)
    levels = channels(grid.color[:blocks][grid.color[:blocks] > 0])[:, 0]
    assert set(np.round(levels)) == {40, 200}
    integrate(wall, 80)
    averaged = channels(grid.color[:blocks][(grid.color[:blocks] > 0) & (grid.color[:blocks] < OUTDATED)])[:, 0]
    assert (averaged > 40).all()
    assert (averaged < 60).all()  # the depth weight is not reset


def test_integration_limits_weight_to_maximum() -> None:
    frame = room().frame(pose())
    for most in (3.0, 255.0):
        sensor = SENSOR._replace(max_weight=np.float32(most), full_weight_depth=np.float32(100.0))
        integrator = Integrator(VoxelGrid(VOXEL, SENSOR.max_truncation, 100_000), sensor)
        for _ in range(int(most) + 3):
            integrator.integrate(frame, np.eye(4), VOXEL)
        assert integrator.voxels.grid.weight[: integrator.voxels.block_count].max() == most * WEIGHT_ONE


def test_integration_averages_noise() -> None:
    """After 40 frames with noise of 10 mm, the noise of voxels near the surface is about 10 / sqrt(40) mm."""
    frame = room().frame(pose())
    integrator = new_integrator()
    rng = np.random.default_rng(0)
    for _ in range(40):
        noisy = (frame.depth + rng.normal(0, 0.01, frame.depth.shape)).astype(np.float32)
        integrator.integrate(Frame(0, 0.0, frame.color, noisy, CAMERA), np.eye(4), VOXEL)
    clean = new_integrator()
    clean.integrate(frame, np.eye(4), VOXEL)
    n = min(integrator.voxels.block_count, clean.voxels.block_count)
    ours = {tuple(c): b for b, c in enumerate(integrator.voxels.grid.block_coords[: integrator.voxels.block_count])}
    unit = SENSOR.max_truncation / TSDF_MAX
    errors = []
    for block in range(n):
        other = ours.get(tuple(clean.voxels.grid.block_coords[block]))
        near = np.abs(clean.voxels.grid.tsdf[block] * unit) < 0.02
        if other is not None:
            difference = integrator.voxels.grid.tsdf[other].astype(float) - clean.voxels.grid.tsdf[block]
            errors.append(difference[near] * unit)
    assert np.std(np.concatenate(errors)) == pytest.approx(0.01 / np.sqrt(40), rel=0.15)


def test_integration_removes_object_from_observed_free_space() -> None:
    """A sphere is removed from the scene, and the camera then observes the wall behind the sphere."""
    scene, empty = room(), room()
    empty.spheres = []
    integrator = new_integrator()
    integrator.integrate(scene.frame(pose()), np.eye(4), VOXEL)
    grid = integrator.voxels.grid
    before = int(
        ((grid.tsdf[: integrator.voxels.block_count] < 0) & (grid.weight[: integrator.voxels.block_count] > 0)).sum()
    )
    assert before > 0
    for _ in range(10):
        integrator.integrate(empty.frame(pose()), np.eye(4), VOXEL)
    center = np.array([-0.5, 0.6, 1.62])  # m, on the front of the first sphere
    block = {tuple(c): b for b, c in enumerate(grid.block_coords[: integrator.voxels.block_count])}
    voxel = np.round(center / VOXEL).astype(int)
    b = block[tuple(voxel >> 3)]
    x, y, z = voxel & 7
    assert integrator.voxels.grid.tsdf[b, (z * 8 + y) * 8 + x] > 0


def test_integration_is_independent_of_thread_count() -> None:
    def integrated() -> list[bytes]:
        integrator = new_integrator()
        for k, T in enumerate(walk(4)):
            integrator.integrate(room().frame(T, k), T, VOXEL)
        n = integrator.voxels.block_count
        grid = integrator.voxels.grid
        return [a[:n].tobytes() for a in (grid.block_coords, grid.tsdf, grid.weight, grid.color)]

    by_one, by_two = by_one_thread_and_two(integrated)
    assert by_one == by_two


@pytest.mark.parametrize(
    ("kind", "weight"),
    [
        (SensorKind.KINECT_V1, (1.5 / 3) ** 2),
        (SensorKind.REALSENSE_D435, (1.5 / 3) ** 2),
        (SensorKind.TIME_OF_FLIGHT, (2.2 / 3) ** 2),
        (SensorKind.PHONE_LIDAR, 1.0),
        (SensorKind.EXACT, 1.0),
    ],
)
def test_integration_weight_depends_on_sensor_noise(kind: SensorKind, weight: float) -> None:
    integrator = new_integrator()
    color, depth = np.zeros((*CAMERA.shape, 3), np.uint8), np.full(CAMERA.shape, 3.0, np.float32)
    integrator.integrate(Frame(0, 0.0, color, depth, CAMERA, sensor=kind), np.eye(4), VOXEL)
    used = integrator.voxels.grid.weight[: integrator.voxels.block_count]  # the other blocks are uninitialized
    assert used.max() == int(WEIGHT_ONE * weight)
    assert integrator.sensor == SENSOR
