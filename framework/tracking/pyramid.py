"""Depth and intensity at halved resolutions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit, prange

from framework.data import Camera, Float32, UInt8, View

DEPTH_GAP = 0.05  # of the depth: readings farther apart than this do not belong to one surface and are not averaged


@dataclass(frozen=True)
class PyramidLevel:
    """One resolution of an RGB-D image."""

    camera: Camera
    depth: Float32  # (H, W) m, 0 = no reading
    intensity: Float32  # (H, W) in [0, 1]


def build_pyramid(camera: Camera, depth: Float32, color: UInt8, finest: float, levels: int) -> list[PyramidLevel]:
    """The image at `finest` times its size and at levels - 1 halvings of that, finest first.

    `finest` is 1 or a power of 1/2. Intensities average all pixels, depths those of one surface.
    """
    intensity = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    level = PyramidLevel(camera, depth, intensity)
    while level.camera.width > camera.width * finest:
        level = _halved(level)
    pyramid = [level]
    for _ in range(levels - 1):
        pyramid.append(_halved(pyramid[-1]))
    return pyramid


def _halved(level: PyramidLevel) -> PyramidLevel:
    height, width = level.depth.shape
    half = Camera(
        width // 2,
        height // 2,
        level.camera.fx / 2,
        level.camera.fy / 2,
        (level.camera.cx + 0.5) / 2 - 0.5,
        (level.camera.cy + 0.5) / 2 - 0.5,
    )
    depth = np.empty(half.shape, np.float32)
    intensity = np.empty(half.shape, np.float32)
    _halve(level.depth, level.intensity, depth, intensity)
    return PyramidLevel(half, depth, intensity)


@njit(cache=True, nogil=True, parallel=True)
def _halve(depth, intensity, half_depth, half_intensity):
    for v in prange(half_depth.shape[0]):
        for u in range(half_depth.shape[1]):
            total = np.float32(0.0)
            nearest = np.float32(np.inf)
            for b in range(2):
                for a in range(2):
                    total += intensity[2 * v + b, 2 * u + a]
                    d = depth[2 * v + b, 2 * u + a]
                    if np.float32(0.0) < d < nearest:
                        nearest = d
            half_intensity[v, u] = total * np.float32(0.25)
            # the mean of the readings on the nearest surface
            farthest = nearest * np.float32(1.0 + DEPTH_GAP)
            total = np.float32(0.0)
            count = np.float32(0.0)
            for b in range(2):
                for a in range(2):
                    d = depth[2 * v + b, 2 * u + a]
                    if np.float32(0.0) < d < farthest:
                        total += d
                        count += np.float32(1.0)
            half_depth[v, u] = total / count if count > np.float32(0.0) else np.float32(0.0)


def model_intensities(view: View, levels: int) -> list[Float32]:
    """The view's intensity in [0, 1] at its own resolution and halvings of it, -1 where nothing is mapped."""
    intensity = cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    intensity[view.depth == 0] = -1
    pyramid = [intensity]
    for _ in range(levels - 1):
        height, width = pyramid[-1].shape
        half = np.empty((height // 2, width // 2), np.float32)
        _halve_mapped(pyramid[-1], half)
        pyramid.append(half)
    return pyramid


@njit(cache=True, nogil=True, parallel=True)
def _halve_mapped(intensity, half):
    for v in prange(half.shape[0]):
        for u in range(half.shape[1]):
            a, b = intensity[2 * v, 2 * u], intensity[2 * v, 2 * u + 1]
            c, d = intensity[2 * v + 1, 2 * u], intensity[2 * v + 1, 2 * u + 1]
            if min(min(a, b), min(c, d)) >= np.float32(0.0):
                half[v, u] = (a + b + c + d) * np.float32(0.25)
            else:
                half[v, u] = np.float32(-1.0)
