"""An Intel RealSense camera, by pyrealsense2 (2.5x): https://github.com/realsenseai/librealsense (Apache-2.0).

Depth is registered to colour by the library, with the factory's calibration.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Generator
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Camera, Frame
from framework.datasets.calibration.raw_images import Calibration, check_max_depth
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.cameras.device_frames import WAIT_MS, images_of
from framework.errors import ConfigError, DataError, FrameError, in_one_line
from framework.interfaces import FrameReader, LiveVideo

log = logging.getLogger(__name__)


@dataclass
class RealSense(LiveVideo):
    """A RealSense camera: depth registered to colour, with the intrinsics that the device says."""

    serial: str = ""  # of the device, quoted; "" = the first one found
    width: int = 640  # px, in [64, 4096]
    height: int = 480  # px, in [64, 4096]
    fps: int = 30  # Hz, in [1, 300]; size and rate must be of the device's modes, which realsense-viewer lists
    max_depth: float = 10.0  # m; farther readings become "no reading"; 0 = keep all

    def __post_init__(self) -> None:
        check_bounds(self, width=(64, 4096), height=(64, 4096), fps=(1, 300))
        check_max_depth(self.max_depth)
        self.name = f"realsense_{self.serial}" if self.serial else "realsense"

    def frames(self) -> Generator[FrameReader | None]:
        rs = _library()
        pipeline = rs.pipeline()
        try:
            profile = pipeline.start(self._config(rs))
        except RuntimeError as error:
            asked = f"{self.width}x{self.height} at {self.fps} Hz"
            device = f"the device {self.serial}" if self.serial else "a device"
            raise DataError(f"RealSense: {device} with {asked} could not be started: {in_one_line(error)}") from error
        try:
            yield from self._sent(rs, pipeline, profile)
        finally:
            pipeline.stop()

    def _config(self, rs: Any) -> Any:
        config = rs.config()
        if self.serial:
            config.enable_device(self.serial)
        config.enable_stream(rs.stream.depth, self.width, self.height, rs.format.z16, self.fps)
        config.enable_stream(rs.stream.color, self.width, self.height, rs.format.rgb8, self.fps)
        return config

    def _sent(self, rs: Any, pipeline: Any, profile: Any) -> Generator[FrameReader | None]:
        calibration = self._calibration(rs, profile)
        align, number = rs.align(rs.stream.color), count()
        for images in images_of("RealSense", partial(_wait, pipeline)):
            if images is None:
                yield None
            else:
                yield partial(_read, align, images, next(number), time.time(), calibration)

    def _calibration(self, rs: Any, profile: Any) -> Calibration:
        found = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        camera = Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
        metres = profile.get_device().first_depth_sensor().get_depth_scale()
        distortion = Distortion(*found.coeffs[:5]) if any(found.coeffs) else None
        if distortion is not None and found.model != rs.distortion.brown_conrady:
            log.warning(
                "%s: its lens distortion, %s, is of another model than ours and is not undone", self.name, found.model
            )
            distortion = None
        return Calibration(camera, self.name, 1 / metres, self.max_depth, distortion)


def _wait(pipeline: Any) -> Any:
    """Both images, not registered yet; None = they have not come."""
    try:
        there, images = pipeline.try_wait_for_frames(WAIT_MS)
    except RuntimeError as error:
        raise DataError(f"RealSense: {in_one_line(error)}") from error
    return images if there else None


def _read(align: Any, images: Any, number: int, timestamp: float, calibration: Calibration) -> Frame:
    """Raises FrameError where one of the two images is missing, or they cannot be registered."""
    try:
        registered = align.process(images)
    except RuntimeError as error:
        raise FrameError(f"frame {number}: {in_one_line(error)}") from error
    color, depth = registered.get_color_frame(), registered.get_depth_frame()
    if not color or not depth:
        raise FrameError(f"frame {number}: the camera has sent no {'depth' if color else 'colour'}")
    return Frame(
        number,
        timestamp,
        # copies: what the library gives is its own memory, which it uses again
        calibration.color(np.array(color.get_data(), np.uint8), f"frame {number}: colour"),
        calibration.depth(np.array(depth.get_data(), np.uint16), f"frame {number}: depth"),
        calibration.camera,
    )


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise ConfigError(
            "pyrealsense2, which reads RealSense cameras, is not there: pip install instancemap[realsense]"
        ) from error
    return pyrealsense2
