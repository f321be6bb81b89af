"""Depth and intensity at halved resolutions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from framework.data import Camera, Float32, SurfaceView, UInt8
from framework.sensors.noise_models import GROWTH, LEAST, NEAR
from framework.tracking.pyramid_kernels import compute_normals, find_distinct, halve, halve_mapped

SAMPLED = 4  # px: every so manieth reading tells in what steps depth comes
FEWEST_VALUES = 16  # of depth, from which its steps are told
COARSE = 2.5  # standard deviations of a structured-light camera's depth, between neighboring values


@dataclass(frozen=True)
class PyramidLevel:
    """One resolution of an RGB-D image."""

    camera: Camera
    depth: Float32  # (H, W) m, 0 = no reading
    intensity: Float32  # (H, W) in [0, 1]
    normals: Float32  # (3, H, W) of the surface, towards the camera, in its frame; 0 where neighbors are apart


def build_pyramid(camera: Camera, depth: Float32, color: UInt8, finest: float, levels: int) -> list[PyramidLevel]:
    """The image at `finest` times its size and at levels - 1 halvings of that, finest first.

    `finest` is 1 or a power of 1/2. Intensities average all pixels, depths those of one surface.
    """
    intensity = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    pyramid: list[PyramidLevel] = []
    least = camera.width * finest
    while True:
        if camera.width <= least:
            normals = np.empty((3, *camera.shape), np.float32)
            compute_normals(depth, *(np.float32(k) for k in (camera.fx, camera.fy, camera.cx, camera.cy)), normals)
            pyramid.append(PyramidLevel(camera, depth, intensity, normals))
            if len(pyramid) == levels:
                return pyramid
        camera = _halved(camera)
        half_depth, half_intensity = np.empty(camera.shape, np.float32), np.empty(camera.shape, np.float32)
        halve(depth, intensity, half_depth, half_intensity)
        depth, intensity = half_depth, half_intensity


def is_coarse(depth: Float32, otherwise: bool) -> bool:
    """Whether depth (H, W) m comes in steps too coarse for normals from a pixel and its neighbors.

    Such is depth that was stored in 8 bits. Steps are gaps between the values that occur, of the nearer half, beside
    the noise of a structured-light camera: a Kinect's are 1.5 to 1.9 standard deviations at any distance, millimetres
    0.8 or less; those of 39 mm are 20 at 1 m and 3 at 3 m. `otherwise` is the answer where too few values occur.
    """
    values = _distinct(depth[::SAMPLED, ::SAMPLED])
    if len(values) < FEWEST_VALUES:
        return otherwise
    steps = np.diff(values) / (LEAST + GROWTH * (values[:-1] - NEAR) ** 2)
    return bool(np.percentile(steps[: len(steps) // 2], 25) > COARSE)  # a gap may be two steps, no step is missed


def _distinct(depth: Float32) -> Float32:
    """The different readings in depth (H, W) m, ascending: few, as a rule, and they are found faster than sorted."""
    bits = np.ascontiguousarray(depth).view(np.int32)
    table = np.zeros(1 << (2 * bits.size).bit_length(), np.int32)
    found = np.empty(bits.size, np.int32)
    return np.sort(found[: find_distinct(bits.ravel(), table, found)].view(np.float32))


def _halved(camera: Camera) -> Camera:
    return Camera(
        camera.width // 2,
        camera.height // 2,
        camera.fx / 2,
        camera.fy / 2,
        (camera.cx + 0.5) / 2 - 0.5,
        (camera.cy + 0.5) / 2 - 0.5,
    )


def model_intensities(view: SurfaceView, levels: int) -> list[Float32]:
    """The view's intensity in [0, 1] at its own resolution and halvings of it, -1 where nothing is mapped."""
    intensity = cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    intensity[view.depth == 0] = -1
    pyramid = [intensity]
    for _ in range(levels - 1):
        height, width = pyramid[-1].shape
        half = np.empty((height // 2, width // 2), np.float32)
        halve_mapped(pyramid[-1], half)
        pyramid.append(half)
    return pyramid
