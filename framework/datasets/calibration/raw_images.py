"""How the raw images of a sensor become those of a frame: their size, the unit and range of depth, the lens."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.data import Camera, Float32, UInt8, UInt16
from framework.datasets.calibration.undistortion import Distortion, Undistortion
from framework.errors import ConfigError, FrameError

NO_READING = 65535  # uint16 that several sensors write instead of 0


def check_max_depth(max_depth: float) -> None:
    """Raises ConfigError for a range that is none."""
    if not (math.isfinite(max_depth) and max_depth >= 0):
        raise ConfigError(f"dataset.max_depth must be 0 (keep all) or positive metres, found {max_depth}")


@dataclass(frozen=True)
class Calibration:
    """A camera, and what is known of the images that it takes. Raises DataError for a lens that there cannot be."""

    camera: Camera
    source: Path | str  # what says so, for messages
    depth_scale: float  # units a metre
    max_depth: float  # m; farther readings become "no reading"; 0 = keep all
    distortion: Distortion | None = None  # of the lens, in colour and depth alike; None = a pinhole
    lens: Undistortion | None = field(init=False, repr=False)  # what undoes it

    def __post_init__(self) -> None:
        object.__setattr__(self, "lens", Undistortion(self.camera, self.distortion) if self.distortion else None)

    def color(self, raw: UInt8, name: Path | str) -> UInt8:
        """(H, W, 3) of the pinhole camera. Raises FrameError, which names the image, for one of another size."""
        self._check_size(name, raw.shape)
        return self.lens.smooth(raw) if self.lens else raw

    def depth(self, raw: UInt16, name: Path | str) -> Float32:
        """(H, W) m, 0 = no reading. Raises FrameError likewise."""
        self._check_size(name, raw.shape)
        depth = raw.astype(np.float32)
        depth /= np.float32(self.depth_scale)
        depth[raw == NO_READING] = 0
        if self.max_depth:
            depth[depth > self.max_depth] = 0
        return self.lens.exact(depth) if self.lens else depth

    def labels(self, raw: UInt16, name: Path | str) -> UInt16:
        """(H, W) numbers of something, none of them interpolated. Raises FrameError likewise."""
        self._check_size(name, raw.shape)
        return self.lens.exact(raw) if self.lens else raw

    def fault_of_size(self, name: Path | str, shape: tuple[int, ...]) -> str:
        """What is wrong with the size of an image; "" = it is the camera's."""
        if shape[:2] == self.camera.shape:
            return ""
        expected = f"{self.source} says {_size(self.camera.shape)}; colour, depth and camera must agree"
        return f"{name} is {_size(shape)}, but {expected}"

    def _check_size(self, name: Path | str, shape: tuple[int, ...]) -> None:
        if fault := self.fault_of_size(name, shape):
            raise FrameError(fault)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
