"""Ray casting of camera views, from coarse to fine.

1. The blocks in view are projected to image tiles. This bounds the depth range of the rays in each tile.
2. A coarse grid of rays is cast by sphere tracing. Rays skip empty regions and blocks in one step.
3. Depths between neighboring rays on one surface are interpolated and refined by Newton's method. If this fails, the
   pixel is searched individually.

The spacing of the coarse rays is smaller than the details of the map, so that interpolation misses no surface. Where
the spacing is larger, all pixels are searched.

Rays are o + z * d. The origin o is in voxels, the depth z in m and the direction d in voxels per m.
"""

from __future__ import annotations

import numpy as np

from framework.data import Camera, Float32, Float64, SurfaceView, View, check_array, check_view
from framework.geometry import inverse
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.voxels.allocation_kernels import solid_blocks_in_view
from framework.mapping.voxels.integration_parameters import Sensor, pinhole
from framework.mapping.voxels.raycasting_kernels import (
    DETAIL,
    MAX_SHIFT,
    TILE,
    bound_tiles,
    cast_coarse,
    cast_fine,
    cast_near,
    label,
    paint,
)
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.sensors.noise_models import SensorKind

MAX_STRIDE = TILE  # maximum distance between coarse rays, px


def tile_bounds(voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Float32]:
    """Return the minimum and maximum depth (Y, X), m, of the blocks in view in each image tile.

    If a tile has no blocks, the minimum is larger than the maximum.
    """
    tiles = tuple((side + TILE - 1) // TILE for side in camera.shape)
    tile_near, tile_far = np.full(tiles, sensor.max_depth), np.full(tiles, sensor.min_depth)
    view = pinhole(camera, inverse(T_world_camera))
    _, depths, pixels = solid_blocks_in_view(
        voxels.grid, voxels.region_count, voxels.block_count, view, sensor.min_depth, sensor.max_depth, camera.shape
    )
    bound_tiles(depths, pixels, tile_near, tile_far)
    return tile_near, tile_far


def cast_view(
    voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64, readings: Float32 | None = None,
    kind: SensorKind = SensorKind.KINECT_V1,
) -> tuple[Float32, Float32]:  # fmt: skip
    """Return the depth (H, W), m, and the world-frame normals (H, W, 3) of the visible surface.

    The depth is 0 where there is no surface.

    Args:
        voxels: The voxel grid.
        sensor: The integration parameters.
        camera: The camera of the view.
        T_world_camera: The camera pose (4, 4).
        readings: The depth image (H, W), m, of a sensor at this pose. If given, only the surface near or in front of
            these depths is searched.
        kind: The sensor that measured `readings`.
    """
    tile_near, tile_far = tile_bounds(voxels, sensor, camera, T_world_camera)
    view = pinhole(camera, T_world_camera)
    stride = _stride(camera, float(voxels.grid.voxel_size), float(sensor.max_depth))
    rays_y, rays_x = (max(1, -(-(side - 1) // stride)) + 1 for side in camera.shape)  # with last row and column
    coarse = np.empty((rays_y, rays_x), np.float32)
    if readings is None:
        limits = np.full(camera.shape, sensor.max_depth)
        cast_coarse(voxels.grid, view, tile_near, tile_far, stride, camera.shape, coarse)
    else:
        shift = np.float32(MAX_SHIFT) * voxels.grid.voxel_size
        limits = np.where((readings > 0) & (readings < sensor.max_depth), readings + shift, np.float32(0.0))
        cast_near(voxels.grid, view, tile_near, tile_far, limits, stride, readings, kind.noise, coarse)
    depth = np.empty(camera.shape, np.float32)
    normals = np.empty((*camera.shape, 3), np.float32)
    cast_fine(voxels.grid, view, tile_near, tile_far, limits, stride, coarse, depth, normals)
    return depth, normals


def _stride(camera: Camera, voxel_size: float, max_depth: float) -> int:
    """Return the spacing of the coarse rays, px, a power of 2."""
    # resolves the details of the map at any depth
    resolved = DETAIL * voxel_size * min(camera.fx, camera.fy) / max_depth
    return 1 << int(np.log2(min(max(resolved, 1.0), MAX_STRIDE)))


def tiles_around(camera: Camera, u: int, v: int) -> tuple[Camera, int, int]:
    """Return the camera of the image tiles that determine pixel (u, v), and the pixel in its image."""
    left, top = TILE * (u // TILE), TILE * (v // TILE)
    # pixels are interpolated between rays at the corners of their tile, which belong to the next tiles
    right, bottom = min(left + 2 * TILE, camera.width), min(top + 2 * TILE, camera.height)
    return camera.cropped(left, top, right, bottom), u - left, v - top


def render(voxels: VoxelGrid, evidence: Evidence, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> View:
    """Return the view of the map with labels."""
    surface = render_surface(voxels, sensor, camera, T_world_camera)
    instance_ids = np.empty(camera.shape, np.int32)
    class_ids = np.empty(camera.shape, np.int32)
    label(voxels.grid, evidence, pinhole(camera, T_world_camera), surface.depth, instance_ids, class_ids)
    return View(**vars(surface), instance_ids=instance_ids, class_ids=class_ids)


def render_surface(
    voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64, readings: Float32 | None = None,
    kind: SensorKind = SensorKind.KINECT_V1,
) -> SurfaceView:  # fmt: skip
    """Return the view of the map without labels.

    See `cast_view` for the arguments.

    Raises:
        DataError: If the camera, its pose or the readings are invalid.
    """
    check_view(camera, T_world_camera)
    if readings is not None:
        check_array("depth", readings, camera.shape, np.float32)
    depth, normals = cast_view(voxels, sensor, camera, T_world_camera, readings, kind)
    color = np.empty((*camera.shape, 3), np.uint8)
    paint(voxels.grid, pinhole(camera, T_world_camera), depth, color)
    return SurfaceView(camera, T_world_camera, depth, normals, color)
