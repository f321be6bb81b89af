"""Kernels of lifting.py."""

from __future__ import annotations

from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Float64, Int32, Int64


@njit(cache=True, nogil=True, parallel=True)
def move_masks(masks: Bool, color_pixels: Int32, moved: Bool) -> None:
    """Resample masks to the pixels of the depth image.

    Args:
        masks: The masks (N, H, W) of the color image.
        color_pixels: The flat index (H, W) of the color pixel of each depth pixel, -1 = none.
        moved: The output (N, H, W), False where there is no color pixel.
    """
    count, height, width = masks.shape
    for v in prange(height):
        for k in range(count):
            mask = masks[k].ravel()
            for u in range(width):
                index = color_pixels[v, u]
                moved[k, v, u] = mask[index] if index >= 0 else False


@njit(cache=True, nogil=True, parallel=True)
def count_readings(masks: Bool, depth: Float32, counts: Int64) -> None:
    """Write the number of depth readings in each row of each mask to counts[1:] (N * H,)."""
    height = depth.shape[0]
    for row in prange(masks.shape[0] * height):
        k, v = row // height, row % height
        count = 0
        for u in range(depth.shape[1]):
            count += masks[k, v, u] & (depth[v, u] > 0)
        counts[row + 1] = count


@njit(cache=True, nogil=True, parallel=True)
def gather_readings(
    masks: Bool, depth: Float32, camera: tuple[float, float, float, float], T: Float64, starts: Int64,
    points_world: Float32, pixels: Int32, cluster: Int32,
) -> None:  # fmt: skip
    """Collect the depth readings in the masks as points, mask by mask and row by row.

    Args:
        masks: The masks (N, H, W).
        depth: The depth image (H, W), m.
        camera: The intrinsics fx, fy, cx, cy, px.
        T: The camera pose T_world_camera (4, 4).
        starts: The index (N * H + 1,) of the first point of each row of each mask.
        points_world: The output (P, 3), m.
        pixels: The output (P, 2), u and v.
        cluster: The output (P,), the mask of each point.
    """
    height = depth.shape[0]
    fx, fy, cx, cy = camera
    for row in prange(masks.shape[0] * height):
        if starts[row] == starts[row + 1]:
            continue
        k, v = row // height, row % height
        p = starts[row]
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if masks[k, v, u] and z > 0:
                x, y = (u - cx) / fx * z, (v - cy) / fy * z
                for i in range(3):
                    points_world[p, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]
                pixels[p, 0], pixels[p, 1] = u, v
                cluster[p] = k
                p += 1
