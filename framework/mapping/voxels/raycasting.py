"""What a camera sees of the map, by sphere tracing through its blocks, coarse to fine.

First the blocks in view are projected to image tiles, which bounds the depths that each tile's rays must search. Then
every few pixels a ray crosses absent regions and blocks in one step each, walks the truncated distance field by steps
of the distance itself, and finds the surface where the field changes from positive to negative. Between such rays that
meet one surface, the depth of the pixels is interpolated, and refined on the trilinear field (Newton's method), a row
of the image at a time. Where that fails, the pixel gets a full search of its own.

A surface narrower than the distance between the coarse rays could be overlooked by interpolation. So that distance is
kept below the size of the map's own details, and where it is not, all pixels are searched.

Rays are in voxels: o + z * d with d in voxels for each m of depth z.
"""

from __future__ import annotations

import numpy as np

from framework.data import Camera, Float32, Float64, SurfaceView, View, check_array, check_view
from framework.geometry import inverse
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.voxels.frustum_kernels import solid_blocks_in_view
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

MAX_STRIDE = 8  # px between coarse rays


def tile_bounds(voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Float32]:
    """(near, far), each (Y, X) m: the depths between which the rays of each tile can meet a block."""
    tiles = tuple((side + TILE - 1) // TILE for side in camera.shape)
    tile_near, tile_far = np.full(tiles, sensor.max_depth), np.full(tiles, sensor.min_depth)
    _, depths, pixels = solid_blocks_in_view(
        voxels.grid,
        voxels.region_count,
        voxels.block_count,
        pinhole(camera, inverse(T_world_camera)),
        sensor.min_depth,
        sensor.max_depth,
        camera.shape,
    )
    bound_tiles(depths, pixels, tile_near, tile_far)
    return tile_near, tile_far


def cast_view(voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Float32]:
    """(depth (H, W) m, normals (H, W, 3) world) of the surface that `camera` sees; depth 0 where there is none."""
    tile_near, tile_far = tile_bounds(voxels, sensor, camera, T_world_camera)
    view = pinhole(camera, T_world_camera)
    stride = _stride(camera, float(voxels.grid.voxel_size), float(sensor.max_depth))
    coarse = _coarse(camera, stride)
    cast_coarse(voxels.grid, view, tile_near, tile_far, stride, camera.shape, coarse)
    depth = np.empty(camera.shape, np.float32)
    normals = np.empty((*camera.shape, 3), np.float32)
    limits = np.full(camera.shape, sensor.max_depth)
    cast_fine(voxels.grid, view, tile_near, tile_far, limits, stride, coarse, depth, normals)
    return depth, normals


def _coarse(camera: Camera, stride: int) -> Float32:
    """Room for the depths of every stride-th pixel and of the image's last row and column."""
    rays_y, rays_x = (max(1, -(-(side - 1) // stride)) + 1 for side in camera.shape)
    return np.empty((rays_y, rays_x), np.float32)


def _stride(camera: Camera, voxel_size: float, max_depth: float) -> int:
    """The pixels between coarse rays, a power of 2: so many that details of the map are resolved at any depth."""
    resolved = DETAIL * voxel_size * min(camera.fx, camera.fy) / max_depth
    return 1 << int(np.log2(min(max(resolved, 1.0), MAX_STRIDE)))


def render(voxels: VoxelGrid, evidence: Evidence, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> View:
    """What `camera` sees of the map, between the sensor's nearest and farthest depth."""
    surface = render_surface(voxels, sensor, camera, T_world_camera)
    instance_ids = np.empty(camera.shape, np.int32)
    class_ids = np.empty(camera.shape, np.int32)
    label(voxels.grid, evidence, pinhole(camera, T_world_camera), surface.depth, instance_ids, class_ids)
    return View(**vars(surface), instance_ids=instance_ids, class_ids=class_ids)


def render_surface(voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> SurfaceView:
    """The same without labels. Raises DataError where the camera or its pose is none."""
    check_view(camera, T_world_camera)
    depth, normals = cast_view(voxels, sensor, camera, T_world_camera)
    color = np.empty((*camera.shape, 3), np.uint8)
    paint(voxels.grid, pinhole(camera, T_world_camera), depth, color)
    return SurfaceView(camera, T_world_camera, depth, normals, color)


def render_near(
    voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64, readings: Float32
) -> SurfaceView:
    """The surface that `camera` sees at its `readings` (H, W) m, or in front of them.

    Readings beyond the sensor's farthest depth are not looked for: the map has not taken them either. Raises DataError
    where the camera, its pose or the readings are none.
    """
    check_view(camera, T_world_camera)
    check_array("depth", readings, camera.shape, np.float32)
    tile_near, tile_far = tile_bounds(voxels, sensor, camera, T_world_camera)
    view = pinhole(camera, T_world_camera)
    stride = _stride(camera, float(voxels.grid.voxel_size), float(sensor.max_depth))
    coarse = _coarse(camera, stride)
    shift = np.float32(MAX_SHIFT) * voxels.grid.voxel_size
    limits = np.where((readings > 0) & (readings < sensor.max_depth), readings + shift, np.float32(0.0))
    cast_near(voxels.grid, view, tile_near, tile_far, limits, stride, readings, coarse)
    depth = np.empty(camera.shape, np.float32)
    normals = np.empty((*camera.shape, 3), np.float32)
    cast_fine(voxels.grid, view, tile_near, tile_far, limits, stride, coarse, depth, normals)
    color = np.empty((*camera.shape, 3), np.uint8)
    paint(voxels.grid, view, depth, color)
    return SurfaceView(camera, T_world_camera, depth, normals, color)
