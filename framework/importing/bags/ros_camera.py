"""Cameras of sensor_msgs/CameraInfo.

Raw images belong to the intrinsics K and the lens distortion D. Rectified images, whose topics are named `image_rect`
or similar, belong to the projection matrix P and have no distortion. R rotates from the raw to the rectified camera.
The matrices are of the full resolution. Images may be binned, or a region of interest.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from framework.data import Camera, Float64, UInt8
from framework.datasets.calibration.camera_json import pinhole
from framework.datasets.calibration.undistortion import Distortion, Value
from framework.errors import DataError

BROWN = ("plumb_bob", "rational_polynomial", "Brown Conrady", "")  # lens models of cv2.undistort
INVERSE = ("Inverse Brown Conrady",)  # RealSense: the polynomial maps the recorded image to the pinhole image
FISHEYE = ("equidistant", "fisheye", "Kannala Brandt4")  # lens models of cv2.fisheye
COEFFICIENTS = (4, 5, 8, 12, 14)  # numbers of coefficients that OpenCV supports
_RECTIFIED = re.compile("(?<!un)rect", re.IGNORECASE)
_RECTIFIED_FOLDER = re.compile("(^|_)rect(ified)?(_|$)", re.IGNORECASE)
TRANSPORTS = ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")  # ends of topics of image_transport


def is_rectified(topic: str) -> bool:
    """Return True if the name of an image topic indicates rectified images, such as `image_rect` or `rect/image`."""
    *folders, name = [part for part in topic.split("/") if part not in TRANSPORTS]
    if _RECTIFIED.search(name):
        return True
    return "raw" not in name and any(map(_RECTIFIED_FOLDER.search, folders))


@dataclass(frozen=True)
class RosLens:
    """A lens with distortion.

    `smooth(color)` and `exact(depth)` convert images to the pinhole camera with the same intrinsics.
    """

    camera: Camera
    model: str
    coefficients: tuple[float, ...]

    def smooth(self, image: UInt8) -> UInt8:
        """Undistort a color image (H, W, 3) with bilinear interpolation."""
        return np.asarray(cv2.remap(image, *_maps(self, image.shape[1], image.shape[0]), cv2.INTER_LINEAR), np.uint8)

    def exact(self, image: NDArray[Value]) -> NDArray[Value]:
        """Undistort a depth image (H, W) of any size with nearest-neighbor sampling."""
        maps = _maps(self, image.shape[1], image.shape[0])
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_NEAREST), image.dtype)

    @property
    def distortion(self) -> Distortion | None:
        """The coefficients of camera.json, or None if it does not support this lens."""
        if self.model not in BROWN or any(self.coefficients[5:]):
            return None
        return Distortion(*self.coefficients[:5])


@lru_cache(maxsize=4)
def _maps(lens: RosLens, width: int, height: int) -> tuple[Float64, Float64]:
    """Return the positions (H, W), px, in the recorded image for each pixel of the pinhole image."""
    camera, size = lens.camera, (width, height)
    if camera.shape != (height, width):
        camera = camera.scaled(width / camera.width)
    d = np.array(lens.coefficients)
    if lens.model in FISHEYE:
        u, v = cv2.fisheye.initUndistortRectifyMap(camera.K, d, np.eye(3), camera.K, size, cv2.CV_32FC1)
    elif lens.model in INVERSE:
        pixels = np.indices((height, width), np.float64)[::-1].reshape(2, -1).T
        recorded = cv2.undistortPoints(pixels, camera.K, d, P=camera.K)
        u, v = recorded.reshape(height, width, 2).astype(np.float32).transpose(2, 0, 1)
    else:
        u, v = cv2.initUndistortRectifyMap(camera.K, d, np.eye(3), camera.K, size, cv2.CV_32FC1)
    return u, v


def ros_camera(where: str, info: Any, rectified: bool) -> tuple[Camera, RosLens | None]:
    """Return the camera of the images that belong to a CameraInfo, and its lens; None = pinhole camera.

    Args:
        where: The location of the message, for error messages.
        info: The CameraInfo message.
        rectified: True if the images are rectified.

    Raises:
        DataError: The intrinsics are invalid, or the lens model is not supported.
    """
    if rectified:
        return _rectified(where, info), None
    camera = _pinhole(where, info, _numbers(info, "k"), columns=3)
    values = _numbers(info, "d")
    if not any(values):
        return camera, None
    if not np.isfinite(values).all():
        raise DataError(f"{where}: expected finite coefficients of the lens, got {values}")
    if info.distortion_model in FISHEYE and len(values) >= 4:
        return camera, RosLens(camera, info.distortion_model, tuple(values[:4]))
    if info.distortion_model in (*BROWN, *INVERSE) and len(values) in COEFFICIENTS:
        return camera, RosLens(camera, info.distortion_model, tuple(values))
    raise DataError(
        f"{where}: expected one of the lens models {', '.join(filter(None, (*BROWN, *INVERSE, *FISHEYE)))}, got "
        f"{info.distortion_model!r} with {len(values)} coefficients; use rectified images, such as image_rect_color"
    )


def _rectified(where: str, info: Any) -> Camera:
    projection = _numbers(info, "p")
    if projection[0] and projection[5]:
        return _pinhole(where, info, projection, columns=4)
    if any(_numbers(info, "d")):
        raise DataError(
            f"{where}: expected a projection matrix P of the rectified images, got zeros; calibrate the camera"
        )
    return _pinhole(where, info, _numbers(info, "k"), columns=3)  # drivers without rectification leave P empty


def _pinhole(where: str, info: Any, matrix: list[float], columns: int) -> Camera:
    """Return the camera of the recorded images, which may be binned and may be a region of the full resolution."""
    (fx, _, cx), (_, fy, cy) = np.reshape(matrix, (3, columns))[:2, :3].tolist()
    width, height, region = info.width, info.height, getattr(info, "roi", None)
    if region is not None and region.width and region.height:
        width, height = region.width, region.height
        cx, cy = cx - region.x_offset, cy - region.y_offset
    x, y = (max(int(getattr(info, name, 0)), 1) for name in ("binning_x", "binning_y"))  # 0 = none
    cx, cy = (cx + 0.5) / x - 0.5, (cy + 0.5) / y - 0.5
    return pinhole(where, width // x, height // y, fx / x, fy / y, cx, cy)


def rectification(info: Any) -> Float64:
    """Return the rotation (4, 4) from the raw to the rectified camera of a CameraInfo."""
    R = np.reshape(_numbers(info, "r"), (3, 3))
    T_rectified_raw = np.eye(4)
    if R.any():  # drivers without rectification leave R empty
        T_rectified_raw[:3, :3] = R
    return T_rectified_raw


def _numbers(info: Any, name: str) -> list[float]:
    """Return the values of a CameraInfo field, which has an upper-case name in ROS 1."""
    return [float(value) for value in getattr(info, name if hasattr(info, name) else name.upper())]
