"""Kernels of seven_scenes.py."""

from __future__ import annotations

from framework.compilation.kernel_cache import njit
from framework.data import UInt16
from framework.datasets.calibration.raw_images import NO_READING


@njit(cache=True, nogil=True)
def register_depth(raw: UInt16, ratio: float, u_0: float, v_0: float, disparity_1: float, registered: UInt16) -> None:
    """Copy depth readings to the pixels of another camera.

    The pixel (u, v) with depth z is copied to (ratio u + u_0 - disparity_1 / z, ratio v + v_0). If several readings map
    to the same pixel, the nearest reading is kept.

    Args:
        raw: The depth (h, w), mm.
        ratio: The focal length of the other camera divided by that of the depth camera.
        u_0: The horizontal offset, px.
        v_0: The vertical offset, px.
        disparity_1: The disparity at a depth of 1 mm, px.
        registered: The output depth (H, W), mm, initially 0.
    """
    height, width = registered.shape
    for v in range(raw.shape[0]):
        v_color = round(ratio * v + v_0)
        if not 0 <= v_color < height:
            continue
        for u in range(raw.shape[1]):
            z = raw[v, u]
            if z == 0 or z == NO_READING:
                continue
            u_color = round(ratio * u + u_0 - disparity_1 / z)
            if 0 <= u_color < width and (registered[v_color, u_color] == 0 or z < registered[v_color, u_color]):
                registered[v_color, u_color] = z
