"""How much of the light from around reaches what a picture shows: corners and contacts are darker.

In screen space (Ritschel, Grosch and Seidel, "Approximating Dynamic Global Illumination in Image Space", I3D 2009): the
rays that ask what is near to a point are followed in the picture, where its depth says what they would meet.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from framework.data import Camera, Float32

RANGE_M = 0.35  # what is nearer than this to a point takes light from it
RAYS = 8  # per pixel; neighbours in tiles of 4x4 pixels look elsewhere, and the tile is averaged
STEPS = 4  # along a ray, at which it is asked whether it lies behind what the picture shows
TILE = 4  # px
DEPTH = 0.75  # how dark a point gets that is closed in on all sides
SLACK_M = np.float32(2e-3)  # a ray that is not farther behind the surface than this has not met it
THICKNESS_M = np.float32(0.15)  # what is seen is taken to reach this far back; a ray that is farther behind passes
HALF = np.float32(0.5)  # px, from a pixel's border to its middle


def openness(camera: Camera, depth: Float32, normals_camera: Float32) -> Float32:
    """(H, W) in (0, 1]: the share of the light that gets there.

    Args:
        depth: (H, W) m along z, 0 = nothing is seen.
        normals_camera: (H, W, 3) unit length, in the camera's coordinates.
    """
    blocked = np.zeros(depth.shape, np.float32)
    _block(depth, normals_camera, camera.K.astype(np.float32), _directions(), _reaches(), blocked)
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


@njit(cache=True, nogil=True)
def _block(
    depth: Float32, normals: Float32, K: Float32, directions: Float32, reaches: Float32, blocked: Float32
) -> None:
    """Writes the share (H, W) of each pixel's rays that meet something."""
    height, width = depth.shape
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if z <= 0:
                continue
            x, y = (np.float32(u) - cx) / fx * z, (np.float32(v) - cy) / fy * z
            n = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            s, t = _tangents(n)
            place = v % TILE * TILE + u % TILE
            met = 0
            for ray in range(RAYS):
                a, b, c = directions[place, ray, 0], directions[place, ray, 1], directions[place, ray, 2]
                dx = a * s[0] + b * t[0] + c * n[0]
                dy = a * s[1] + b * t[1] + c * n[1]
                dz = a * s[2] + b * t[2] + c * n[2]
                for step in range(STEPS):
                    reach = reaches[place, step]
                    far = z + reach * dz
                    if far <= 0:
                        break
                    scale = np.float32(1) / far
                    column = int(np.floor(fx * (x + reach * dx) * scale + cx + HALF))
                    row = int(np.floor(fy * (y + reach * dy) * scale + cy + HALF))
                    if not (0 <= column < width and 0 <= row < height):
                        break
                    there = depth[row, column]
                    if there > 0 and SLACK_M < far - there < THICKNESS_M:
                        met += 1
                        break
            blocked[v, u] = met / RAYS


@njit(cache=True, nogil=True, inline="always")
def _tangents(n):  # type: ignore[no-untyped-def]
    """Two unit vectors at right angles to the unit vector n and to each other (Duff et al., JCGT 6(1), 2017)."""
    sign = np.float32(1) if n[2] >= 0 else np.float32(-1)
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])
