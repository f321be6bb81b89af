"""Screen-space ambient occlusion.

Rays from each surface point are traced in the depth image, as in Ritschel et al., "Approximating Dynamic Global
Illumination in Image Space", I3D 2009.
"""

from __future__ import annotations

import cv2
import numpy as np

from framework.data import Camera, Float32
from framework.rendering.ambient_occlusion_kernels import RAYS, STEPS, TILE, trace_occlusion

RANGE_M = 0.35  # maximum distance of occluders, m
DEPTH = 0.75  # relative darkening of a point whose rays are all occluded


def openness(camera: Camera, depth: Float32, normals_camera: Float32) -> Float32:
    """Return the fraction (H, W) of ambient light that reaches the surface at each pixel.

    Args:
        camera: The camera of the depth image.
        depth: The depth image (H, W), m, 0 = no surface.
        normals_camera: The unit normals (H, W, 3) in the camera frame.
    """
    occluded = np.zeros(depth.shape, np.float32)
    trace_occlusion(depth, normals_camera, camera.K.astype(np.float32), _directions(), _reaches(), occluded)
    # mean over the valid pixels of a tile
    mean = cv2.blur(occluded, (TILE, TILE))
    fraction = cv2.blur((depth > 0).astype(np.float32), (TILE, TILE))
    return np.asarray(1 - DEPTH * mean / np.maximum(fraction, 1e-6), np.float32)


def _directions() -> Float32:
    """Return the ray directions (TILE^2, RAYS, 3) for each pixel of a tile.

    The directions are cosine-weighted unit vectors. Their components are along two tangents and the normal.
    """
    pixel, ray = np.arange(TILE**2)[:, None], np.arange(RAYS)
    angle = 2 * np.pi / RAYS * (ray + (pixel * 7 % TILE**2) / TILE**2)
    sine = np.sqrt(((ray + pixel) % RAYS + 0.5) / RAYS)  # each ray has every elevation in some pixel of a tile
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), np.sqrt(1 - sine**2)], axis=-1).astype(np.float32)


def _reaches() -> Float32:
    """Return the distances (TILE^2, STEPS) of the samples along a ray for each pixel of a tile, m.

    The distances are jittered, except for the last one.
    """
    pixel = np.arange(TILE**2)
    shift = (pixel * 5 % TILE**2 + 0.5) / TILE**2
    fraction = (np.arange(STEPS) + shift[:, None]) / (STEPS - 1)
    return np.asarray(RANGE_M * np.minimum(fraction, 1), np.float32)
