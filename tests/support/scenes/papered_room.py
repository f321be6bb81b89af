"""Box-shaped room with random wallpaper, for image features."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from framework.data import Camera, Frame

CAMERA = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)
HALF = np.array([2.0, 1.2, 2.5])  # half the size of the room, m
RESOLUTION = 160  # px per meter


@cache
def wallpaper(paper: int, wall: int) -> np.ndarray:
    """Return an image (H, W, 3), uint8, of a random pattern with several spatial scales."""
    rng = np.random.default_rng([paper, wall])
    side = int(2 * HALF.max() * RESOLUTION) + 2
    pattern = np.zeros((side, side, 3), np.float32)
    for sigma in (2.5, 5, 12):
        noise = cv2.GaussianBlur(rng.normal(0, 1, pattern.shape).astype(np.float32), (0, 0), sigma)
        pattern += noise / noise.std()
    return np.clip(128 + 35 * pattern, 0, 255).astype(np.uint8)


def papered_frame(T_world_camera: np.ndarray, index: int = 0, paper: int = 0, camera: Camera = CAMERA) -> Frame:
    """Return the frame of a camera inside the room."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    directions = rays @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.sign(directions) * HALF - origin) / directions
    axis = reach.argmin(axis=-1)
    depth = reach.min(axis=-1)
    points = origin + depth[..., None] * directions
    color = np.zeros((*camera.shape, 3), np.uint8)
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        for side in (0, 1):
            on = (axis == k) & ((directions[..., k] > 0) == bool(side))
            x, y = ((points[on][:, [a, b]] + HALF[[a, b]]) * RESOLUTION).astype(np.float32).T
            if len(x):
                color[on] = _sampled(wallpaper(paper, 2 * k + side), x, y)
    return Frame(index, index / 30, color, depth.astype(np.float32), camera, T_world_camera)


def _sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return bilinear samples (P, 3). The samples are in rows of 256, because OpenCV accepts at most 32767 per row."""
    pad = -len(x) % 256
    grid_x, grid_y = (np.pad(c, (0, pad)).reshape(-1, 256) for c in (x, y))
    return cv2.remap(image, grid_x, grid_y, cv2.INTER_LINEAR).reshape(-1, 3)[: len(x)]
