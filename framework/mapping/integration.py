"""From a depth image to the map: which blocks it touches, and the running averages of their voxels.

The signed distance is projective, along z; its running average is the TSDF of Curless and Levoy (1996). The truncation
distance widens with depth as the sensor's noise does, and the weight of an observation falls with depth squared.

All kernels are parallel over independent rows or blocks; candidates are gathered in chunks whose number does not
depend on the number of threads, and blocks are numbered in a serial pass, so that the map is the same with any number
of threads.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit, prange

from framework.data import Float64, Frame, Int32
from framework.geometry import inverse
from framework.mapping.sensor import Sensor, pinhole, ray_direction
from framework.mapping.voxel_grid import (
    BLOCK_SIDE,
    BLOCK_VOXELS,
    REGION_SIDE,
    TSDF_MAX,
    WEIGHT_ONE,
    VoxelGrid,
    device,
    find_block,
    grown,
    is_solid,
)
from framework.mapping.voxel_walk import inverses, leave_cell

CHUNKS = 32  # of image rows; fixed, so that the order of blocks does not depend on the number of threads
RECENT = 1024  # block keys that a chunk remembers, to pass on each block about once
GOLDEN = 0.6180339887498949  # rounding offsets frac(k * GOLDEN) are spread evenly, so rounded averages have no bias


@device
def _remember(recent, bx, by, bz):
    """True when the block was passed to `recent` (RECENT, 4) lately; remembers it otherwise."""
    slot = (bx * 73856093 ^ by * 19349669 ^ bz * 83492791) & (RECENT - 1)
    if recent[slot, 3] == 1 and recent[slot, 0] == bx and recent[slot, 1] == by and recent[slot, 2] == bz:
        return True
    recent[slot, 0] = bx
    recent[slot, 1] = by
    recent[slot, 2] = bz
    recent[slot, 3] = 1
    return False


@device
def _note(found, n, bx, by, bz):
    """Writes a block into `found` (M, 3) if there is room; the caller counts on, and asks again with more room."""
    if n < found.shape[0]:
        found[n, 0] = bx
        found[n, 1] = by
        found[n, 2] = bz


@njit(cache=True, nogil=True, parallel=True)
def _surface_blocks(depth, view, sensor, block_size, stride, found, counts):
    """Blocks along the truncation band of every stride-th reading, chunk by chunk, into `found` (CHUNKS, M, 3)."""
    height, width = depth.shape
    rows = (height + stride - 1) // stride
    inverse_size = np.float32(1.0) / block_size
    for chunk in prange(CHUNKS):
        recent = np.zeros((RECENT, 4), np.int32)
        n = 0
        for row in range(chunk * rows // CHUNKS, (chunk + 1) * rows // CHUNKS):
            v = row * stride
            for u in range(0, width, stride):
                d = depth[v, u]
                if d < sensor.min_depth or d > sensor.max_depth:
                    continue
                dx, dy, dz = ray_direction(view, u, v)
                band = sensor.truncation + sensor.truncation_slope * d
                # samples at most half a block apart along the ray
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                steps = int(np.ceil(np.float32(4.0) * band * length * inverse_size))
                for s in range(steps + 1):
                    z = d - band + np.float32(2.0) * band * np.float32(s) / np.float32(steps)
                    bx = int(np.floor((view.t[0] + z * dx) * inverse_size))
                    by = int(np.floor((view.t[1] + z * dy) * inverse_size))
                    bz = int(np.floor((view.t[2] + z * dz) * inverse_size))
                    if not _remember(recent, bx, by, bz):
                        _note(found[chunk], n, bx, by, bz)
                        n += 1
        counts[chunk] = n


@njit(cache=True, nogil=True, parallel=True)
def _free_blocks(grid, depth, view, sensor, block_size, stride, found, counts):
    """Allocated blocks that lie between the camera and the readings, to be carved. Same output as _surface_blocks."""
    height, width = depth.shape
    rows = (height + stride - 1) // stride
    inverse_size = np.float32(1.0) / block_size
    for chunk in prange(CHUNKS):
        recent = np.zeros((RECENT, 4), np.int32)
        n = 0
        key = np.int64(-2)
        region = np.int32(-1)
        region_size = block_size * np.float32(REGION_SIDE)
        for row in range(chunk * rows // CHUNKS, (chunk + 1) * rows // CHUNKS):
            v = row * stride
            for u in range(0, width, stride):
                d = depth[v, u]
                if d < sensor.min_depth or d > sensor.max_depth:
                    continue
                dx, dy, dz = ray_direction(view, u, v)
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                step = np.float32(0.75) * block_size / length
                z = sensor.min_depth
                stop = d - sensor.truncation - sensor.truncation_slope * d
                while z < stop:
                    bx = int(np.floor((view.t[0] + z * dx) * inverse_size))
                    by = int(np.floor((view.t[1] + z * dy) * inverse_size))
                    bz = int(np.floor((view.t[2] + z * dz) * inverse_size))
                    block, key, region = find_block(grid, bx, by, bz, key, region)
                    if block >= 0 and not _remember(recent, bx, by, bz):
                        _note(found[chunk], n, bx, by, bz)
                        n += 1
                    if region >= 0:
                        z += step
                    else:
                        d_world = (dx, dy, dz)
                        z = np.float32(0.1) * step + leave_cell(
                            z, view.t, d_world, inverses(d_world), region_size, np.float32(1.0) / region_size
                        )
        counts[chunk] = n


@njit(cache=True, nogil=True)
def _number_blocks(grid, coords, stamp, frame, active):
    """The blocks at `coords`, each once, in order of first mention, into `active`; returns how many."""
    n = 0
    key = np.int64(-2)
    region = np.int32(-1)
    for i in range(coords.shape[0]):
        block, key, region = find_block(grid, coords[i, 0], coords[i, 1], coords[i, 2], key, region)
        if block >= 0 and stamp[block] != frame:
            stamp[block] = frame
            active[n] = block
            n += 1
    return n


@njit(cache=True, nogil=True, parallel=True)
def _integrate(grid, active, depth, color, camera, sensor, rounding, near_band, near_pixel):
    """Updates distance, weight and colour of every voxel of the active blocks that the depth image sees.

    `camera` holds T_camera_world. `rounding` in [0, 1) is added before values are truncated to integers. near_pixel
    (A, 512) gets the number of the pixel that sees each voxel within near_band m of the measured surface, -1 for the
    others.

    A block is done in passes over its 512 voxels that hold no branches, so that the compiler vectorises them.
    """
    height, width = depth.shape
    depth = depth.ravel()
    color = color.reshape(-1, 3)
    solid = grid.solid  # numba 0.68 loses what is assigned to an element of a tuple's array within prange
    to_units = np.float32(1.0) / grid.tsdf_unit
    one = np.float32(1.0)
    half = np.float32(0.5)
    zero = np.float32(0.0)
    voxel = grid.voxel_size
    full2 = sensor.full_weight_depth * sensor.full_weight_depth
    weight_one = np.float32(WEIGHT_ONE)
    max_weight = sensor.max_weight * weight_one
    most = np.float32(TSDF_MAX)
    white = np.float32(255.0)
    right = np.float32(width) - half
    bottom = np.float32(height) - half
    for a in prange(active.shape[0]):
        block = active[a]
        tsdf = grid.tsdf[block]
        weight = grid.weight[block]
        rgb = grid.color[block]
        near = near_pixel[a]
        pixel = np.empty(BLOCK_VOXELS, np.int32)
        distance = np.empty(BLOCK_VOXELS, np.float32)
        share = np.empty(BLOCK_VOXELS, np.float32)
        x0 = np.float32(grid.block_coords[block, 0] * BLOCK_SIDE) * voxel
        y0 = np.float32(grid.block_coords[block, 1] * BLOCK_SIDE) * voxel
        z0 = np.float32(grid.block_coords[block, 2] * BLOCK_SIDE) * voxel
        for n in range(BLOCK_VOXELS):
            m = np.int32(n)
            x = x0 + np.float32(m & 7) * voxel
            y = y0 + np.float32((m >> 3) & 7) * voxel
            z = z0 + np.float32(m >> 6) * voxel
            px = camera.R[0, 0] * x + camera.R[0, 1] * y + camera.R[0, 2] * z + camera.t[0]
            py = camera.R[1, 0] * x + camera.R[1, 1] * y + camera.R[1, 2] * z + camera.t[1]
            pz = camera.R[2, 0] * x + camera.R[2, 1] * y + camera.R[2, 2] * z + camera.t[2]
            w = one / max(pz, sensor.min_depth)
            u = camera.fx * px * w + camera.cx
            v = camera.fy * py * w + camera.cy
            inside = (pz > sensor.min_depth) & (u > -half) & (v > -half) & (u < right) & (v < bottom)
            # outside the image the pixel is 0, whose reading then must not count: the share is 0
            column = np.int32(u + half) if inside else np.int32(0)
            line = np.int32(v + half) if inside else np.int32(0)
            pixel[n] = line * np.int32(width) + column
            distance[n] = pz
            share[n] = one if inside else zero
        for n in range(BLOCK_VOXELS):
            d = depth[np.uint32(pixel[n])]
            band = sensor.truncation + sensor.truncation_slope * d
            sdf = d - distance[n]
            seen = (share[n] > zero) & (d > sensor.min_depth) & (d < sensor.max_depth) & (sdf > -band)
            w_new = weight_one * min(one, full2 / max(d * d, np.float32(1e-6)))
            w_old = np.float32(weight[n])
            portion = w_new / (w_old + w_new) if seen else zero
            stored = np.float32(tsdf[n])
            target = min(sdf, band) * to_units
            value = stored + portion * (target - stored) if w_old > zero else target
            # near 1, rounding lifts the widest distance to 32768, which would wrap round to UNSEEN
            value = max(-most, min(np.floor(value + rounding), most))
            tsdf[n] = np.int16(value) if seen else tsdf[n]
            weight[n] = np.uint16(min(w_old + w_new, max_weight)) if seen else weight[n]
            near[n] = pixel[n] if seen & (abs(sdf) <= near_band) else np.int32(-1)
            share[n] = portion if sdf < band else zero  # colour belongs to the surface, not to the air before it
        solid[block] = is_solid(tsdf)
        for n in range(BLOCK_VOXELS):
            if share[n] > zero:
                for c in range(3):
                    old = np.float32(rgb[n, c])
                    mean = old + share[n] * (np.float32(color[pixel[n], c]) - old)
                    rgb[n, c] = np.uint8(min(mean + rounding, white))


class Integrator:
    """Integrates frames into a grid; remembers what it needs between frames."""

    def __init__(self, voxels: VoxelGrid, sensor: Sensor) -> None:
        self.voxels = voxels
        self.sensor = sensor
        self.frames = 0
        self._stamp = np.zeros(0, np.int32)  # (B,) the last frame, counted from 1, in which a block was active
        self._near_pixel = np.empty((0, BLOCK_VOXELS), np.int32)
        self._found = np.empty((CHUNKS, 4096, 3), np.int32)

    def integrate(self, frame: Frame, T_world_camera: Float64, near_band: float) -> tuple[Int32, Int32]:
        """Integrates one frame.

        Returns the numbers of the blocks it saw, (A,), and for each of their voxels within near_band m of the measured
        surface the number v * width + u of the pixel that sees it, -1 for the others, (A, 512); valid until the next
        call.

        Raises MapFullError when the block budget is reached; the frame is then not integrated.
        """
        self.frames += 1
        active = self._find_blocks(frame, T_world_camera)
        rounding = np.float32((self.frames * GOLDEN) % 1.0)
        view = pinhole(frame.camera, inverse(T_world_camera))
        if len(self._near_pixel) < len(active):
            self._near_pixel = np.empty((2 * len(active), BLOCK_VOXELS), np.int32)
        near_pixel = self._near_pixel[: len(active)]
        _integrate(
            self.voxels.grid,
            active,
            frame.depth,
            frame.color,
            view,
            self.sensor,
            rounding,
            np.float32(near_band),
            near_pixel,
        )
        return active, near_pixel

    def _find_blocks(self, frame: Frame, T_world_camera: Float64) -> Int32:
        """The blocks around the surface that the frame sees (allocated here) and those that it sees through."""
        view = pinhole(frame.camera, T_world_camera)
        block_size = np.float32(BLOCK_SIDE * self.voxels.grid.voxel_size)
        # readings this far apart are at most a quarter of a block apart at the greatest depth
        footprint = float(self.sensor.max_depth) / frame.camera.fx
        stride = max(1, min(8, int(0.25 * block_size / footprint)))
        surface = self._gathered(_surface_blocks, frame.depth, view, self.sensor, block_size, stride)
        self.voxels.allocate(surface)
        seen_through = self._gathered(
            _free_blocks, self.voxels.grid, frame.depth, view, self.sensor, block_size, 2 * stride
        )
        coords = np.concatenate([surface, seen_through])
        capacity = len(self.voxels.grid.block_coords)
        if len(self._stamp) < capacity:
            self._stamp = grown(self._stamp, capacity, 0)
        active = np.empty(len(coords), np.int32)
        return active[: _number_blocks(self.voxels.grid, coords, self._stamp, self.frames, active)]

    def _gathered(self, kernel: Callable[..., None], *arguments: object) -> Int32:
        """What `kernel` finds, chunk after chunk, (N, 3); more room is made until it fits."""
        counts = np.zeros(CHUNKS, np.int32)
        while True:
            kernel(*arguments, self._found, counts)
            if counts.max() <= self._found.shape[1]:
                return np.concatenate([self._found[chunk, :n] for chunk, n in enumerate(counts)])
            self._found = np.empty((CHUNKS, 2 * int(counts.max()), 3), np.int32)
