"""Lens undistortion with the Brown-Conrady model.

The convention is that of OpenCV. A point (x, y, 1) in the camera frame projects to the pixel (fx x' + cx, fy y' + cy)
of the recorded image. With r^2 = x^2 + y^2:

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from framework.data import Camera, Float64, UInt8
from framework.errors import DataError

Value = TypeVar("Value", bound=np.generic)
FARTHEST_SHIFT = 0.5  # maximum shift of a pixel, as a fraction of the image width; rejects other lens models


@dataclass(frozen=True)
class Distortion:
    """Distortion coefficients of a lens.

    All coefficients are 0 for a pinhole camera.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(astuple(self)).all():
            raise DataError(f"distortion (k1, k2, p1, p2, k3): expected finite coefficients, got {astuple(self)}")

    def distorted(self, camera: Camera, pixels: Float64) -> Float64:
        """Map pixels of the pinhole camera to positions (N, 2), px, in the recorded image.

        Args:
            camera: The pinhole camera.
            pixels: The pixels (N, 2), px.
        """
        x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        moved_x = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        moved_y = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([camera.fx * moved_x + camera.cx, camera.fy * moved_y + camera.cy], axis=1)


class Undistortion:
    """Conversion of recorded images to a pinhole camera with the same intrinsics.

    Pixels outside the recorded image become 0.

    Raises:
        DataError: The coefficients do not fit the camera.
    """

    def __init__(self, camera: Camera, distortion: Distortion) -> None:
        v, u = np.indices(camera.shape, np.float64)
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
        source = distortion.distorted(camera, pixels)
        shift = float(np.abs(source - pixels).max())
        if shift > FARTHEST_SHIFT * camera.width:
            raise DataError(
                f"distortion (k1, k2, p1, p2, k3): expected a shift of at most {FARTHEST_SHIFT * camera.width:.0f} px "
                f"in the {camera.width}x{camera.height} image, got {shift:.0f} px for {astuple(distortion)}; check "
                "the lens model"
            )
        self._u, self._v = source.T.reshape(2, *camera.shape).astype(np.float32)

    def smooth(self, image: UInt8) -> UInt8:
        """Undistort a color image (H, W, 3) with bilinear interpolation."""
        return np.asarray(cv2.remap(image, self._u, self._v, cv2.INTER_LINEAR), np.uint8)

    def exact(self, image: NDArray[Value]) -> NDArray[Value]:
        """Undistort a depth or label image (H, W) with nearest-neighbor sampling."""
        return np.asarray(cv2.remap(image, self._u, self._v, cv2.INTER_NEAREST), image.dtype)
