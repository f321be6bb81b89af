"""Conversion of raw sensor images to metric depth and undistorted images."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float32, UInt8, UInt16
from framework.datasets.calibration.undistortion import Distortion, Undistortion
from framework.errors import FrameError
from framework.files.image_files import UPRIGHT, exif_orientation, rotation_command

NO_READING = 65535  # uint16, written by some sensors instead of 0


def check_max_depth(max_depth: float) -> None:
    """Raise ConfigError if the maximum depth is negative or not finite."""
    require(
        math.isfinite(max_depth) and max_depth >= 0,
        "dataset.max_depth",
        max_depth,
        "0 (keep all) or a positive value in m",
    )


@dataclass(frozen=True)
class Calibration:
    """A camera with its depth scale and lens distortion.

    Raises:
        DataError: The lens distortion does not fit the camera.
    """

    camera: Camera
    source: Path | str  # file or parameter with the camera, for messages
    depth_scale: float  # units per meter
    max_depth: float  # m; farther depth readings are dropped; 0 = keep all
    distortion: Distortion | None = None  # lens distortion of color and depth; None = pinhole camera
    lens: Undistortion | None = field(init=False, repr=False)  # None = pinhole camera

    def __post_init__(self) -> None:
        object.__setattr__(self, "lens", Undistortion(self.camera, self.distortion) if self.distortion else None)

    def color(self, raw: UInt8, name: Path | str) -> UInt8:
        """Return the undistorted color image (H, W, 3), RGB.

        Raises:
            FrameError: The image has the wrong size.
        """
        self.check_size(name, raw.shape)
        return self.lens.smooth(raw) if self.lens else raw

    def depth(self, raw: UInt16 | Float32, name: Path | str) -> Float32:
        """Return the undistorted depth (H, W), m, 0 = no reading.

        Args:
            raw: The stored depth (H, W) in depth units; floats that are not finite or negative are no readings.
            name: The file, for error messages.

        Raises:
            FrameError: The image has the wrong size.
        """
        self.check_size(name, raw.shape)
        depth = raw.astype(np.float32)
        depth /= np.float32(self.depth_scale)
        depth[raw == NO_READING if raw.dtype == np.uint16 else ~(np.isfinite(raw) & (raw > 0))] = 0
        if self.max_depth:
            depth[depth > self.max_depth] = 0
        return self.lens.exact(depth) if self.lens else depth

    def labels(self, raw: UInt16, name: Path | str) -> UInt16:
        """Return the undistorted instance ids (H, W).

        Raises:
            FrameError: The image has the wrong size.
        """
        self.check_size(name, raw.shape)
        return self.lens.exact(raw) if self.lens else raw

    def check_size(self, name: Path | str, shape: tuple[int, ...]) -> None:
        """Raise FrameError if an image does not have the size of the camera."""
        if shape[:2] != self.camera.shape:
            expected = f"expected {self.camera.width}x{self.camera.height} px as in {self.source}"
            raise FrameError(f"{name}: {expected}, got {shape[1]}x{shape[0]} px{_orientation_hint(name)}")


def _orientation_hint(name: Path | str) -> str:
    """Return the end of an error message that reports the EXIF orientation of an image, which is not applied."""
    orientation = exif_orientation(name) if isinstance(name, Path) else UPRIGHT
    if orientation == UPRIGHT or not isinstance(name, Path):
        return ""
    return (
        f" with the EXIF orientation {orientation}, which is not applied; rotate the pixels: {rotation_command(name)}"
    )
