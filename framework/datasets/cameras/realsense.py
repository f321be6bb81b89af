"""An Intel RealSense camera, by pyrealsense2 (2.5x): https://github.com/realsenseai/librealsense (Apache-2.0)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Camera, UInt8, UInt16
from framework.datasets.calibration.raw_images import Calibration
from framework.datasets.cameras.device_frames import WAIT_MS, CameraDevice, DepthCamera
from framework.errors import import_optional


@dataclass
class RealSense(DepthCamera):
    """A RealSense camera."""

    brand = "RealSense"

    def device(self) -> CameraDevice:
        return RealSenseDevice(import_optional("pyrealsense2", "reads RealSense cameras", "realsense"), self)


class RealSenseDevice:
    """A RealSense camera, by its library."""

    errors: tuple[type[Exception], ...] = (RuntimeError,)

    def __init__(self, library: Any, video: RealSense) -> None:
        self._rs, self._video = library, video
        self._pipeline = library.pipeline()
        self._align = library.align(library.stream.color)
        self._profile: Any = None  # of the started pipeline

    def start(self) -> None:
        rs, video, config = self._rs, self._video, self._rs.config()
        if video.serial:
            config.enable_device(video.serial)
        config.enable_stream(rs.stream.depth, video.width, video.height, rs.format.z16, video.fps)
        config.enable_stream(rs.stream.color, video.width, video.height, rs.format.rgb8, video.fps)
        self._profile = self._pipeline.start(config)

    def stop(self) -> None:
        self._pipeline.stop()

    def wait(self) -> Any:
        there, images = self._pipeline.try_wait_for_frames(WAIT_MS)
        return images if there else None

    def calibration(self, images: Any) -> Calibration:
        found = self._profile.get_stream(self._rs.stream.color).as_video_stream_profile().get_intrinsics()
        camera = Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
        unit = self._profile.get_device().first_depth_sensor().get_depth_scale()
        distortion = self._video.distortion(found.coeffs, found.model, self._rs.distortion.brown_conrady)
        return Calibration(camera, self._video.name, 1 / unit, self._video.max_depth, distortion)

    def read(self, images: Any) -> tuple[UInt8 | None, UInt16 | None]:
        registered = self._align.process(images)
        color, depth = registered.get_color_frame(), registered.get_depth_frame()
        return (
            np.array(color.get_data(), np.uint8) if color else None,
            np.array(depth.get_data(), np.uint16) if depth else None,
        )
