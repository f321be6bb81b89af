"""Kernels of color_to_depth.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit

MIN_DEPTH = 0.05  # minimum depth of projected points in the color image, m


# Not parallel: on two cores, its second thread would wait for the thread that reads the next frame.
@njit(cache=True, nogil=True, error_model="numpy")
def register_colors(depth, otherwise, intrinsics, T_color_depth, color, registered, pixels):
    """Set the color of each depth pixel to the nearest color.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        otherwise: The assumed depth of pixels without a reading, m.
        intrinsics: The intrinsics fx, fy, cx, cy, px.
        T_color_depth: The transform (3, 4) of points from the depth camera to the color camera.
        color: The color image (H, W, 3).
        registered: The output (H, W, 3). Outside the color image, the color of its border is used.
        pixels: The output (H, W), the flat index of the color pixel, -1 = no reading or outside the color image.
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_color_depth[:, :3], T_color_depth[:, 3]
    R00, R01, R02, R10, R11, R12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    R20, R21, R22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    height, width = depth.shape
    one, zero, half, stride = np.float32(1.0), np.float32(0.0), np.float32(0.5), np.int32(width)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    inv_fx = one / fx
    colors = color.reshape(height * width, 3)
    for v in range(height):
        y = (np.float32(v) - cy) / fy
        row_x, row_y, row_z = R01 * y + R02, R11 * y + R12, R21 * y + R22
        for u in range(width):
            z = depth[v, u]
            measured = z > zero
            z = z if measured else otherwise
            x = (np.float32(np.int32(u)) - cx) * inv_fx
            inv_z = one / max((R20 * x + row_z) * z + t2, np.float32(MIN_DEPTH))
            column = fx * ((R00 * x + row_x) * z + t0) * inv_z + cx
            row = fy * ((R10 * x + row_y) * z + t1) * inv_z + cy
            inside = (column > -half) & (row > -half) & (column < right + half) & (row < bottom + half)
            column, row = min(max(column, zero), right), min(max(row, zero), bottom)
            index = np.int32(row + half) * stride + np.int32(column + half)
            pixels[v, u] = index if inside & measured else ~index  # the color needs the index, too
        for u in range(width):
            index = pixels[v, u]
            if index < 0:
                index = ~index
                pixels[v, u] = -1
            for channel in range(3):
                registered[v, u, channel] = colors[np.uint32(index), channel]
