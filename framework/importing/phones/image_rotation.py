"""Rotation of images, cameras and poses by quarter turns.

Phones store images in sensor orientation. A clockwise quarter turn moves the pixel (u, v) of an image of height H to (H
- 1 - v, u). A point (x, y, z) in the camera frame becomes (-y, x, z).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from framework.data import Camera, Float64
from framework.datasets.calibration.undistortion import Distortion

Value = TypeVar("Value", bound=np.generic)
QUARTER = 90  # degrees
# minimum length of the mean up vector's projection onto the image plane; smaller if the camera faces up or down
SIDEWAYS = 0.5


@dataclass(frozen=True)
class Turn:
    """A clockwise rotation by quarter turns."""

    quarters: int = 0  # number of quarter turns, 0 to 3

    @property
    def R_turned_camera(self) -> Float64:
        """Rotation matrix (3, 3) from the original camera to the rotated camera."""
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return np.linalg.matrix_power(quarter, self.quarters)

    def image(self, image: NDArray[Value]) -> NDArray[Value]:
        """Rotate an image (H, W) or (H, W, 3)."""
        return np.ascontiguousarray(np.rot90(image, -self.quarters))

    def camera(self, camera: Camera) -> Camera:
        for _ in range(self.quarters):
            c = camera
            camera = Camera(c.height, c.width, c.fy, c.fx, c.height - 1 - c.cy, c.cx)
        return camera

    def pose(self, T_world_camera: Float64) -> Float64:
        """Return the pose (4, 4) of the rotated camera."""
        T = T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ self.R_turned_camera.T
        return T

    def lens(self, lens: Distortion) -> Distortion:
        for _ in range(self.quarters):
            lens = Distortion(lens.k1, lens.k2, lens.p2, -lens.p1, lens.k3)
        return lens


def upright(ups_camera: Sequence[Float64 | None]) -> Turn | None:
    """Return the rotation that makes the images upright, or None if unknown.

    Args:
        ups_camera: The up direction (3,) of each frame in the camera frame; None = unknown.
    """
    known = [up for up in ups_camera if up is not None]
    if not known:
        return None
    x, y, _ = np.mean(known, axis=0)
    if np.hypot(x, y) < SIDEWAYS:
        return None
    turned = [Turn(quarters).R_turned_camera @ (x, y, 0.0) for quarters in range(4)]
    return Turn(int(np.argmin([v[1] for v in turned])))
