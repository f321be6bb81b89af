"""Intel RealSense cameras, read with pyrealsense2 (2.5x): https://github.com/realsenseai/librealsense (Apache-2.0)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Camera, UInt8, UInt16
from framework.datasets.calibration.raw_images import Calibration
from framework.datasets.cameras.device_frames import WAIT_MS, DepthCamera
from framework.errors import import_optional
from framework.sensors.noise_models import SensorKind


@dataclass
class RealSense(DepthCamera):
    """An Intel RealSense camera."""

    brand = "RealSense"
    default_sensor = SensorKind.REALSENSE_D435

    def start(self) -> None:
        self._rs = rs = import_optional("pyrealsense2", "reads RealSense cameras", "realsense")
        self._pipeline: Any = rs.pipeline()
        self._align: Any = rs.align(rs.stream.color)
        config = rs.config()
        if self.serial:
            config.enable_device(self.serial)
        config.enable_stream(rs.stream.depth, self.width, self.height, rs.format.z16, self.fps)
        config.enable_stream(rs.stream.color, self.width, self.height, rs.format.rgb8, self.fps)
        self._profile: Any = self._pipeline.start(config)

    def stop(self) -> None:
        self._pipeline.stop()

    def wait(self) -> Any:
        received, images = self._pipeline.try_wait_for_frames(WAIT_MS)
        return images if received else None

    def calibrate(self, images: Any) -> Calibration:
        found = self._profile.get_stream(self._rs.stream.color).as_video_stream_profile().get_intrinsics()
        camera = Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
        unit = self._profile.get_device().first_depth_sensor().get_depth_scale()
        distortion = self.distortion(found.coeffs, found.model, self._rs.distortion.brown_conrady)
        return Calibration(camera, self.name, 1 / unit, self.max_depth, distortion)

    def depth_after_color(self, images: Any) -> float | None:
        color, depth = images.get_color_frame(), images.get_depth_frame()
        if not color or not depth or color.get_frame_timestamp_domain() != depth.get_frame_timestamp_domain():
            return None
        return float(depth.get_timestamp() - color.get_timestamp()) / 1000  # from ms

    def device_name(self) -> str:
        return str(self._profile.get_device().get_info(self._rs.camera_info.name))

    def read(self, images: Any) -> tuple[UInt8 | None, UInt16 | None]:
        registered = self._align.process(images)
        color, depth = registered.get_color_frame(), registered.get_depth_frame()
        return (
            np.array(color.get_data(), np.uint8) if color else None,
            np.array(depth.get_data(), np.uint16) if depth else None,
        )
