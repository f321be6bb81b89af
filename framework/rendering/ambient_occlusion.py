"""How much of the light from around reaches what a picture shows: corners and contacts are darker.

In screen space (Ritschel, Grosch and Seidel, "Approximating Dynamic Global Illumination in Image Space", I3D 2009): the
rays that ask what is near to a point are followed in the picture, where its depth says what they would meet.
"""

from __future__ import annotations

import cv2
import numpy as np

from framework.data import Camera, Float32
from framework.rendering.ambient_occlusion_kernels import RAYS, STEPS, TILE, block_light

RANGE_M = 0.35  # what is nearer than this to a point takes light from it
DEPTH = 0.75  # how dark a point gets that is closed in on all sides


def openness(camera: Camera, depth: Float32, normals_camera: Float32) -> Float32:
    """(H, W) in (0, 1]: the share of the light that gets there.

    Args:
        depth: (H, W) m along z, 0 = nothing is seen.
        normals_camera: (H, W, 3) unit length, in the camera's coordinates.
    """
    blocked = np.zeros(depth.shape, np.float32)
    block_light(depth, normals_camera, camera.K.astype(np.float32), _directions(), _reaches(), blocked)
    # the mean over a tile, of the pixels that see something
    mean = cv2.blur(blocked, (TILE, TILE))
    share = cv2.blur((depth > 0).astype(np.float32), (TILE, TILE))
    return np.asarray(1 - DEPTH * mean / np.maximum(share, 1e-6), np.float32)


def _directions() -> Float32:
    """(TILE^2, RAYS, 3) along two tangents and the normal: dense around the normal, as light counts."""
    pixel, ray = np.arange(TILE**2)[:, None], np.arange(RAYS)
    angle = 2 * np.pi / RAYS * (ray + (pixel * 7 % TILE**2) / TILE**2)
    sine = np.sqrt(((ray + pixel) % RAYS + 0.5) / RAYS)  # over the tile, each height in each direction
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), np.sqrt(1 - sine**2)], axis=-1).astype(np.float32)


def _reaches() -> Float32:
    """(TILE^2, STEPS) m, how far along a ray is looked: at its end, and before at other places in each pixel."""
    pixel = np.arange(TILE**2)
    shift = (pixel * 5 % TILE**2 + 0.5) / TILE**2
    share = (np.arange(STEPS) + shift[:, None]) / (STEPS - 1)
    return np.asarray(RANGE_M * np.minimum(share, 1), np.float32)
