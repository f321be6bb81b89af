"""Conversion of raw sensor images: depth unit, depth range and lens undistortion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float32, UInt8, UInt16
from framework.datasets.calibration.undistortion import Distortion, Undistortion
from framework.errors import FrameError

NO_READING = 65535  # uint16, written by some sensors instead of 0


def check_max_depth(max_depth: float) -> None:
    """Raise ConfigError for a maximum depth (m) that is negative or not finite."""
    require(
        math.isfinite(max_depth) and max_depth >= 0,
        "dataset.max_depth",
        max_depth,
        "0 (keep all) or a positive value in m",
    )


@dataclass(frozen=True)
class Calibration:
    """A camera and the properties of its images. Raises DataError for an invalid lens distortion."""

    camera: Camera
    source: Path | str  # file or parameter with the camera, for messages
    depth_scale: float  # units per meter
    max_depth: float  # m; farther depth readings are dropped; 0 = keep all
    distortion: Distortion | None = None  # lens distortion of color and depth; None = pinhole camera
    lens: Undistortion | None = field(init=False, repr=False)  # None = pinhole camera

    def __post_init__(self) -> None:
        object.__setattr__(self, "lens", Undistortion(self.camera, self.distortion) if self.distortion else None)

    def color(self, raw: UInt8, name: Path | str) -> UInt8:
        """Return the undistorted color (H, W, 3), RGB. Raises a FrameError that names an image of the wrong size."""
        self.check_size(name, raw.shape)
        return self.lens.smooth(raw) if self.lens else raw

    def depth(self, raw: UInt16, name: Path | str) -> Float32:
        """Return the depth (H, W) in m, 0 = no reading. Raises a FrameError that names an image of the wrong size."""
        self.check_size(name, raw.shape)
        depth = raw.astype(np.float32)
        depth /= np.float32(self.depth_scale)
        depth[raw == NO_READING] = 0
        if self.max_depth:
            depth[depth > self.max_depth] = 0
        return self.lens.exact(depth) if self.lens else depth

    def labels(self, raw: UInt16, name: Path | str) -> UInt16:
        """Return the undistorted instance ids (H, W). Raises a FrameError that names an image of the wrong size."""
        self.check_size(name, raw.shape)
        return self.lens.exact(raw) if self.lens else raw

    def check_size(self, name: Path | str, shape: tuple[int, ...]) -> None:
        """Raise FrameError that names the image if its size differs from the size of the camera's images."""
        if shape[:2] != self.camera.shape:
            expected = f"expected {self.camera.width}x{self.camera.height} px as in {self.source}"
            raise FrameError(f"{name}: {expected}, got {shape[1]}x{shape[0]} px")
