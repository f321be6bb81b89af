"""Orbbec cameras, read with pyorbbecsdk2 (2.x): https://github.com/orbbec/pyorbbecsdk (Apache-2.0)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Camera, UInt8, UInt16
from framework.datasets.calibration.raw_images import Calibration
from framework.datasets.cameras.device_frames import WAIT_MS, DepthCamera
from framework.errors import import_optional
from framework.sensors.noise_models import SensorKind

MILLIMETERS = 1000.0  # per meter; the library's depth scale is in millimeters per unit


@dataclass
class Orbbec(DepthCamera):
    """An Orbbec camera."""

    brand = "Orbbec"
    default_sensor = SensorKind.KINECT_V1

    def start(self) -> None:
        ob = import_optional("pyorbbecsdk", "reads Orbbec cameras", "orbbec")
        self.errors = (ob.OBError, RuntimeError)
        self._align: Any = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)
        devices = ob.Context().query_devices()
        if devices.get_count() == 0:
            raise RuntimeError("no device is connected")
        device = devices.get_device_by_serial_number(self.serial) if self.serial else devices.get_device_by_index(0)
        self._device: Any = device
        self._pipeline: Any = ob.Pipeline(device)
        color_modes = self._pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
        depth_modes = self._pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
        self._color = color_modes.get_video_stream_profile(self.width, self.height, ob.OBFormat.RGB, self.fps)
        depth = depth_modes.get_video_stream_profile(0, 0, ob.OBFormat.Y16, self.fps)  # size 0 = any
        config = ob.Config()
        config.enable_stream(self._color)
        config.enable_stream(depth)
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        self._brown_conrady = ob.OBCameraDistortionModel.BROWN_CONRADY
        self._pipeline.start(config)

    def stop(self) -> None:
        self._pipeline.stop()

    def wait(self) -> Any:
        return self._pipeline.wait_for_frames(WAIT_MS)

    def calibrate(self, images: Any) -> Calibration | None:
        depth = images.get_depth_frame()
        if depth is None:  # the depth unit is only available from a depth frame
            return None
        found, lens = self._color.get_intrinsic(), self._color.get_distortion()
        camera = Camera(found.width, found.height, found.fx, found.fy, found.cx, found.cy)
        coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
        distortion = self.distortion(coefficients, lens.model, self._brown_conrady)
        return Calibration(camera, self.name, MILLIMETERS / depth.get_depth_scale(), self.max_depth, distortion)

    def depth_after_color(self, images: Any) -> float | None:
        color, depth = images.get_color_frame(), images.get_depth_frame()
        if color is None or depth is None:
            return None
        return float(depth.get_timestamp_us() - color.get_timestamp_us()) / 1e6

    def device_name(self) -> str:
        return str(self._device.get_device_info().get_name())

    def read(self, images: Any) -> tuple[UInt8 | None, UInt16 | None]:
        registered = self._align.process(images)
        both = registered.as_frame_set() if registered is not None else None
        color, depth = (both.get_color_frame(), both.get_depth_frame()) if both is not None else (None, None)
        return _pixels(color, np.dtype(np.uint8), (3,)), _pixels(depth, np.dtype(np.uint16), ())


def _pixels(image: Any, dtype: np.dtype[Any], channels: tuple[int, ...]) -> Any:
    """Return a copy of the pixels, or None without an image."""
    if image is None:
        return None
    raw = np.frombuffer(image.get_data(), dtype)
    return raw.reshape(image.get_height(), image.get_width(), *channels).copy()
