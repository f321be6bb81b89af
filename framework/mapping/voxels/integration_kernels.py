"""Kernels of integration.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.voxel_grid import TSDF_MAX, WEIGHT_ONE
from framework.mapping.voxels.voxel_grid_kernels import (
    BLOCK_SIDE,
    BLOCK_VOXELS,
    COLORED,
    OUTDATED,
    device,
    is_solid,
    one_more,
    pack_color,
    unpack_color,
)
from framework.mapping.voxels.voxel_walk import prefetch_row

LAYER_VOXELS = BLOCK_SIDE**2
GROUP = 16  # number of successive blocks that one thread updates; their near voxels are contiguous
FAR = 1e9  # depth or distance of voxels without an observation, m
# weight at the far end of the truncation band, as a fraction of the full weight; > 0, so that voxels count as observed
MIN_WEIGHT_BEHIND = 0.02


@device
def _project_voxels(grid, block, camera, min_depth, shape, pixel, scratch):
    """Compute the pixel (512,) and the depth, m, of each voxel of a block.

    The pose in `camera` is T_camera_world. The depths are written to the first half of `scratch`. Voxels outside the
    image get pixel 0 and a depth larger than any reading.
    """
    # eq. (6) of docs/method.md
    zero, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    seven, three = np.int32(7), np.int32(3)
    width = np.int32(shape[1])
    x0 = np.float32(grid.block_coords[block, 0] * BLOCK_SIDE)
    y0 = np.float32(grid.block_coords[block, 1] * BLOCK_SIDE)
    z0 = np.float32(grid.block_coords[block, 2] * BLOCK_SIDE)
    voxel = grid.voxel_size
    R00, R01, R02, t0 = camera.R[0, 0] * voxel, camera.R[0, 1] * voxel, camera.R[0, 2] * voxel, camera.t[0]
    R10, R11, R12, t1 = camera.R[1, 0] * voxel, camera.R[1, 1] * voxel, camera.R[1, 2] * voxel, camera.t[1]
    R20, R21, R22, t2 = camera.R[2, 0] * voxel, camera.R[2, 1] * voxel, camera.R[2, 2] * voxel, camera.t[2]
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx + half, camera.cy + half
    right, bottom = np.float32(shape[1]), np.float32(shape[0])
    for layer in range(BLOCK_SIDE):
        z = z0 + np.float32(np.int32(layer))
        layer_x, layer_y, layer_z = R02 * z + t0, R12 * z + t1, R22 * z + t2
        start = layer * LAYER_VOXELS
        for n in range(LAYER_VOXELS):
            m = np.int32(n)
            x, y = x0 + np.float32(np.int32(m & seven)), y0 + np.float32(np.int32(m >> three))
            px = R00 * x + R01 * y + layer_x
            py = R10 * x + R11 * y + layer_y
            pz = R20 * x + R21 * y + layer_z
            w = one / max(pz, min_depth)
            u = fx * px * w + cx
            v = fy * py * w + cy
            inside = (pz > min_depth) & (u > zero) & (v > zero) & (u < right) & (v < bottom)
            index = np.int32(np.int32(v) * width + np.int32(u))
            pixel[start + n] = index if inside else np.int32(0)
            scratch[start + n] = pz if inside else np.float32(FAR)


@device
def _average_distances(tsdf, weight, voxel, to_units, sensor, rounding, near_band, scratch):
    """Update the weights and the running averages of the distances (512,) of a block.

    Returns the number of voxels with a new color, and the number of voxels near the surface.

    Args:
        tsdf: The stored distances (512,), modified in place.
        weight: The weights (512,), modified in place.
        voxel: The voxel size, m.
        to_units: The stored distance units per m.
        sensor: The integration parameters.
        rounding: The offset in [0, 1) before rounding down.
        near_band: The maximum distance of near voxels from the surface, m.
        scratch: The depth of each voxel, then the depth reading of each voxel, m. They are replaced by the distance to
            the surface, m, and by the weight of the new color, 0 = no color.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    full2 = sensor.full_weight_depth * sensor.full_weight_depth
    weight_one = np.float32(WEIGHT_ONE)
    max_weight = sensor.max_weight * weight_one
    most, least = np.float32(TSDF_MAX), np.float32(MIN_WEIGHT_BEHIND)
    ramp = one / max(sensor.truncation - voxel, np.float32(0.5) * voxel)
    colored = near = np.int32(0)
    for n in range(BLOCK_VOXELS):
        d = scratch[n + BLOCK_VOXELS]
        band = sensor.truncation + sensor.truncation_slope * d
        sdf = d - scratch[n]
        seen = (d > sensor.min_depth) & (d < sensor.max_depth) & (sdf > -band)
        # Behind the surface, the weight falls with the distance, because observations from the other side contradict
        # these voxels. The band widens with the noise, and only its far end loses weight. Otherwise noise would
        # displace surfaces.
        behind = max(least, min((band + sdf) * ramp, one))
        w_new = max(one, weight_one * behind * min(one, full2 / max(d * d, np.float32(1e-6))))
        w_old = np.float32(weight[n])
        portion = w_new / (w_old + w_new) if seen else zero
        stored = np.float32(tsdf[n])
        target = min(sdf, band) * to_units
        value = stored + portion * (target - stored) if w_old > zero else target
        # rounding near 1 could increase the largest distance to 32768, which would wrap to UNSEEN
        value = max(-most, min(np.floor(value + rounding), most))
        tsdf[n] = np.int16(value) if seen else tsdf[n]
        weight[n] = np.uint16(min(w_old + w_new, max_weight)) if seen else weight[n]
        scratch[n] = sdf if seen else np.float32(FAR)
        # only the surface has a color, not the free space in front of it
        at_surface = seen & (sdf < band)
        scratch[n + BLOCK_VOXELS] = portion if at_surface else zero
        colored = one_more(colored, at_surface)
        near = one_more(near, seen & (abs(sdf) <= near_band))
    return colored, near


@device
def _average_colors(packed, color, pixel, start, rounding, scratch, seen):
    """Update the running averages of the packed colors of one layer of a block.

    Args:
        packed: The packed colors (512,) of the block, modified in place.
        color: The RGBA bytes of the image.
        pixel: The pixel (512,) of each voxel.
        start: The first voxel of the layer.
        rounding: The offset in [0, 1) before rounding down.
        scratch: The weights of the new colors in the second half, 0 = no color.
        seen: Scratch memory (64,).
    """
    byte, one_byte, two_bytes = np.int32(255), np.int32(8), np.int32(16)
    zero, one, four, brightest = np.float32(0.0), np.float32(1.0), np.float32(4.0), np.float32(4 * 255)
    for n in range(LAYER_VOXELS):
        seen[n] = color[np.uint32(pixel[start + n])]
    for n in range(LAYER_VOXELS):
        old, weight = packed[start + n], scratch[start + n + BLOCK_VOXELS]
        current = (old & (COLORED | OUTDATED)) == COLORED
        fresh = (weight > zero) & (not current)  # free space has weight, but no color
        weight = one if fresh else weight
        new = np.int32(seen[n])
        red, green, blue = unpack_color(old)
        red += weight * (four * np.float32(np.int32(new & byte)) - red)
        green += weight * (four * np.float32(np.int32((new >> one_byte) & byte)) - green)
        blue += weight * (four * np.float32(np.int32((new >> two_bytes) & byte)) - blue)
        mean = pack_color(
            min(red + rounding, brightest), min(green + rounding, brightest), min(blue + rounding, brightest)
        )
        packed[start + n] = mean if weight > zero else old


@device
def _is_colored(scratch, start):
    """Return True if any voxel of the layer has a new color."""
    largest = np.float32(0.0)
    for n in range(LAYER_VOXELS):
        largest = max(largest, scratch[start + n + BLOCK_VOXELS])
    return largest > np.float32(0.0)


@device
def _list_near(pixel, near_band, near_voxel, near_pixel, entry, scratch):
    """List the voxels of a block near the surface, and their pixels, from index `entry` on.

    The first half of `scratch` contains the distance of each voxel to the surface, m.
    """
    for layer in range(BLOCK_SIDE):
        begin = layer * LAYER_VOXELS
        word = np.uint64(0)  # comparisons of a layer as bits, which the compiler vectorizes
        for n in range(LAYER_VOXELS):
            word |= np.uint64(abs(scratch[begin + n]) <= near_band) << np.uint64(n)
        while word != np.uint64(0):
            n = begin + lowest_bit(word)
            word &= word - ONE
            near_voxel[entry] = np.uint16(n)
            near_pixel[entry] = pixel[n]
            entry += 1


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def integrate(grid, seen, depth, color, camera, sensor, rounding, near_band):
    """Update the distance, weight and color of the voxels that are visible in a depth image.

    Args:
        grid: The voxel grid.
        seen: The blocks to update. Their voxels near the surface are written to the other arrays.
        depth: The depth image (H, W), m.
        color: The RGBA bytes (H, W) of the color image.
        camera: The camera with the pose T_camera_world.
        sensor: The integration parameters.
        rounding: The offset in [0, 1) before values are rounded down to integers.
        near_band: The maximum distance of near voxels from the surface, m.
    """
    # The passes over the voxels of a block have no branches and share one scratch array, so that the compiler can
    # vectorize them.
    # Numba 0.68 loses assignments to an element of a tuple's array within prange.
    active, near_start, near_count, near_voxel, near_pixel = seen
    solid = grid.solid
    shape = depth.shape
    depth = depth.ravel()
    color = color.ravel()
    to_units = np.float32(1.0) / grid.tsdf_unit
    last = active.shape[0] - 1
    for group in prange((active.shape[0] + GROUP - 1) // GROUP):
        pixel = np.empty(BLOCK_VOXELS, np.int32)
        scratch = np.empty(2 * BLOCK_VOXELS, np.float32)
        layer_colors = np.empty(LAYER_VOXELS, np.uint32)
        start = group * GROUP * BLOCK_VOXELS
        for a in range(group * GROUP, min((group + 1) * GROUP, active.shape[0])):
            block = active[a]
            after = np.int64(active[min(a + 1, last)])
            prefetch_row(grid.tsdf, after)
            prefetch_row(grid.weight, after)
            prefetch_row(grid.color, after)
            tsdf, weight, packed = grid.tsdf[block], grid.weight[block], grid.color[block]
            _project_voxels(grid, block, camera, sensor.min_depth, shape, pixel, scratch)
            for n in range(BLOCK_VOXELS):
                scratch[n + BLOCK_VOXELS] = depth[np.uint32(pixel[n])]
            colored_voxels, near_voxels = _average_distances(
                tsdf, weight, grid.voxel_size, to_units, sensor, rounding, near_band, scratch
            )
            solid[block] = is_solid(tsdf)
            for layer in range(BLOCK_SIDE if colored_voxels > 0 else 0):
                if _is_colored(scratch, layer * LAYER_VOXELS):
                    _average_colors(packed, color, pixel, layer * LAYER_VOXELS, rounding, scratch, layer_colors)
            if near_voxels > 0:
                _list_near(pixel, near_band, near_voxel, near_pixel, start, scratch)
            near_start[a], near_count[a] = start, near_voxels
            start += near_voxels
