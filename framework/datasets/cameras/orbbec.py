"""An Orbbec camera, by pyorbbecsdk2 (2.x): https://github.com/orbbec/pyorbbecsdk (Apache-2.0)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Camera, UInt8, UInt16
from framework.datasets.calibration.raw_images import Calibration
from framework.datasets.cameras.device_frames import WAIT_MS, CameraDevice, DepthCamera
from framework.errors import import_optional

MILLIMETERS = 1000.0  # per meter: the unit of the library's depth scale


@dataclass
class Orbbec(DepthCamera):
    """An Orbbec camera."""

    brand = "Orbbec"

    def device(self) -> CameraDevice:
        return OrbbecDevice(import_optional("pyorbbecsdk", "reads Orbbec cameras", "orbbec"), self)


class OrbbecDevice:
    """An Orbbec camera, by its library."""

    def __init__(self, library: Any, video: Orbbec) -> None:
        self._ob, self._video = library, video
        self.errors: tuple[type[Exception], ...] = (library.OBError, RuntimeError)
        self._pipeline: Any = None
        self._color: Any = None  # the mode of the color stream
        self._align = library.AlignFilter(align_to_stream=library.OBStreamType.COLOR_STREAM)

    def start(self) -> None:
        ob, video = self._ob, self._video
        devices = ob.Context().query_devices()
        if devices.get_count() == 0:
            raise RuntimeError("no device is connected")
        serial = video.serial
        device = devices.get_device_by_serial_number(serial) if serial else devices.get_device_by_index(0)
        self._pipeline = ob.Pipeline(device)
        self._color = self._mode(ob.OBSensorType.COLOR_SENSOR, ob.OBFormat.RGB, video.width, video.height)
        config = ob.Config()
        config.enable_stream(self._color)
        config.enable_stream(self._mode(ob.OBSensorType.DEPTH_SENSOR, ob.OBFormat.Y16, 0, 0))
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        self._pipeline.start(config)

    def _mode(self, sensor: Any, pixels: Any, width: int, height: int) -> Any:
        """A mode of a sensor; size 0 = any."""
        modes = self._pipeline.get_stream_profile_list(sensor)
        return modes.get_video_stream_profile(width, height, pixels, self._video.fps)

    def stop(self) -> None:
        self._pipeline.stop()

    def wait(self) -> Any:
        return self._pipeline.wait_for_frames(WAIT_MS)

    def calibration(self, images: Any) -> Calibration | None:
        depth = images.get_depth_frame()
        if depth is None:  # only depth frames contain their unit
            return None
        found = self._color.get_intrinsic()
        camera = Camera(found.width, found.height, found.fx, found.fy, found.cx, found.cy)
        lens = self._color.get_distortion()
        coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
        distortion = self._video.distortion(coefficients, lens.model, self._ob.OBCameraDistortionModel.BROWN_CONRADY)
        units = MILLIMETERS / depth.get_depth_scale()
        return Calibration(camera, self._video.name, units, self._video.max_depth, distortion)

    def read(self, images: Any) -> tuple[UInt8 | None, UInt16 | None]:
        registered = self._align.process(images)
        both = registered.as_frame_set() if registered is not None else None
        color, depth = (both.get_color_frame(), both.get_depth_frame()) if both is not None else (None, None)
        return _pixels(color, np.dtype(np.uint8), (3,)), _pixels(depth, np.dtype(np.uint16), ())


def _pixels(image: Any, dtype: np.dtype[Any], channels: tuple[int, ...]) -> Any:
    """A copy (H, W, ...) of an image, None = there is none."""
    if image is None:
        return None
    raw = np.frombuffer(image.get_data(), dtype)
    return raw.reshape(image.get_height(), image.get_width(), *channels).copy()
