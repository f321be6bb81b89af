"""Registration of color images to depth images.

The two cameras have the same pose, but can differ in image size and intrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from framework.data import MAX_PIXELS, Camera, UInt8
from framework.datasets.frames.sequence_reader import StoredImages
from framework.errors import DataError, FrameError

LONGEST_SIDE = 2**15 - 2  # px, limit of OpenCV's warp


@dataclass(frozen=True)
class ColorRegistration:
    """Resampling of color images to the pixels of the depth camera.

    Raises:
        DataError: The resolutions of the cameras differ too much.
    """

    color: Camera
    depth: Camera

    def __post_init__(self) -> None:
        width, height = self._fine * self.depth.width, self._fine * self.depth.height
        if width * height > MAX_PIXELS or max(width, height, *self.color.shape) > LONGEST_SIDE:
            raise DataError(
                f"expected color and depth cameras of similar resolution, got "
                f"{self.color.width}x{self.color.height} px and fx = {self.color.fx:g} px for color, "
                f"{self.depth.width}x{self.depth.height} px and fx = {self.depth.fx:g} px for depth"
            )

    @property
    def _fine(self) -> int:
        """Oversampling factor: the number of color pixels per depth pixel along an axis."""
        return max(1, round(min(self.color.fx / self.depth.fx, LONGEST_SIDE)))

    def apply(self, image: UInt8) -> UInt8:
        """Resample an image of the color camera to the pixels of the depth camera.

        The result has the shape (H, W, 3). Each pixel is the mean color of its area. Pixels outside the color image
        have the color of the nearest image border.
        """
        fine = self._fine
        # bilinear resampling at `fine` times the resolution of the depth camera, then the mean of fine x fine pixels;
        # pixel i of the fine image has its center at (i + 1/2) / fine - 1/2 in the depth image
        u, u_0 = _line(self.color.fx, self.color.cx, self.depth.fx, self.depth.cx, fine)
        v, v_0 = _line(self.color.fy, self.color.cy, self.depth.fy, self.depth.cy, fine)
        resampled = cv2.warpAffine(
            image,
            np.array([[u, 0, u_0], [0, v, v_0]]),
            (fine * self.depth.width, fine * self.depth.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        size = (self.depth.width, self.depth.height)
        return np.asarray(cv2.resize(resampled, size, interpolation=cv2.INTER_AREA), np.uint8)


def registered_images(images: StoredImages, registration: ColorRegistration) -> StoredImages:
    """Return the images of a frame, with color registered to depth on reading."""
    return replace(images, color=partial(_registered_color, images, registration))


def _registered_color(images: StoredImages, registration: ColorRegistration) -> UInt8:
    image, camera = images.color(), registration.color
    if image.shape[:2] != camera.shape:
        size = f"{image.shape[1]}x{image.shape[0]}"
        expected = f"{camera.width}x{camera.height}"
        raise FrameError(f"{images.color_name}: expected {expected} px as in the color camera, got {size} px")
    return registration.apply(image)


def _line(f_color: float, c_color: float, f_depth: float, c_depth: float, fine: int) -> tuple[float, float]:
    """Return (a, b) for the mapping of a coordinate i of the oversampled image to a * i + b in the color image."""
    slope = f_color / f_depth
    return slope / fine, slope * (0.5 / fine - 0.5 - c_depth) + c_color
