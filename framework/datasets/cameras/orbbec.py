"""An Orbbec camera, by pyorbbecsdk2 (2.x): https://github.com/orbbec/pyorbbecsdk (Apache-2.0).

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

MILLIMETRES = 1000.0  # a metre: the unit of the library's depth scale

log = logging.getLogger(__name__)


@dataclass
class Orbbec(LiveVideo):
    """An Orbbec camera: depth registered to colour, with the intrinsics that the device says."""

    serial: str = ""  # of the device, quoted; "" = the first one found
    width: int = 640  # px, in [64, 4096], of the colour; depth has a size of its own until it is registered
    height: int = 480  # px, in [64, 4096]
    fps: int = 30  # Hz, in [1, 300]; size and rate must be of the device's modes, which OrbbecViewer lists
    max_depth: float = 10.0  # m; farther readings become "no reading"; 0 = keep all

    def __post_init__(self) -> None:
        check_bounds(self, width=(64, 4096), height=(64, 4096), fps=(1, 300))
        check_max_depth(self.max_depth)
        self.name = f"orbbec_{self.serial}" if self.serial else "orbbec"

    def frames(self) -> Generator[FrameReader | None]:
        ob = _library()
        try:
            pipeline = ob.Pipeline(self._device(ob))
            color = self._profile(ob, pipeline, ob.OBSensorType.COLOR_SENSOR, ob.OBFormat.RGB, self.width, self.height)
            depth = self._profile(ob, pipeline, ob.OBSensorType.DEPTH_SENSOR, ob.OBFormat.Y16, 0, 0)
            config = ob.Config()
            config.enable_stream(color)
            config.enable_stream(depth)
            config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
            pipeline.start(config)
        except (ob.OBError, RuntimeError) as error:
            asked = f"{self.width}x{self.height} at {self.fps} Hz"
            device = f"the device {self.serial}" if self.serial else "a device"
            raise DataError(f"Orbbec: {device} with {asked} could not be started: {in_one_line(error)}") from error
        try:
            yield from self._sent(ob, pipeline, color)
        finally:
            pipeline.stop()

    def _device(self, ob: Any) -> Any:
        found = ob.Context().query_devices()
        if found.get_count() == 0:
            raise RuntimeError("no device is connected")
        return found.get_device_by_serial_number(self.serial) if self.serial else found.get_device_by_index(0)

    def _profile(self, ob: Any, pipeline: Any, sensor: Any, pixels: Any, width: int, height: int) -> Any:
        """A mode of a sensor; a size of 0 is any."""
        return pipeline.get_stream_profile_list(sensor).get_video_stream_profile(width, height, pixels, self.fps)

    def _sent(self, ob: Any, pipeline: Any, color: Any) -> Generator[FrameReader | None]:
        found = color.get_intrinsic()
        camera = Camera(found.width, found.height, found.fx, found.fy, found.cx, found.cy)
        distortion = self._distortion(ob, color)
        align, number = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM), count()
        calibration: Calibration | None = None
        for images in images_of("Orbbec", partial(_wait, ob, pipeline)):
            if images is None:
                yield None
                continue
            if calibration is None:
                depth = images.get_depth_frame()
                if depth is None:  # frames of depth alone say what its units are
                    yield None
                    continue
                units = MILLIMETRES / depth.get_depth_scale()
                calibration = Calibration(camera, self.name, units, self.max_depth, distortion)
            yield partial(_read, ob, align, images, next(number), time.time(), calibration)

    def _distortion(self, ob: Any, color: Any) -> Distortion | None:
        found = color.get_distortion()
        ours = Distortion(found.k1, found.k2, found.p1, found.p2, found.k3)
        higher = (found.k4, found.k5, found.k6)
        if ours == Distortion() and not any(higher):
            return None
        if found.model != ob.OBCameraDistortionModel.BROWN_CONRADY or any(higher):
            log.warning(
                "%s: its lens distortion, %s, is of another model than ours and is not undone", self.name, found.model
            )
            return None
        return ours


def _wait(ob: Any, pipeline: Any) -> Any:
    """Both images, not registered yet; None = they have not come."""
    try:
        return pipeline.wait_for_frames(WAIT_MS)
    except (ob.OBError, RuntimeError) as error:
        raise DataError(f"Orbbec: {in_one_line(error)}") from error


def _read(ob: Any, align: Any, images: Any, number: int, timestamp: float, calibration: Calibration) -> Frame:
    """Raises FrameError where one of the two images is missing, or they cannot be registered."""
    try:
        registered = align.process(images)
    except (ob.OBError, RuntimeError) as error:
        raise FrameError(f"frame {number}: {in_one_line(error)}") from error
    both = registered.as_frame_set() if registered is not None else None
    color, depth = (both.get_color_frame(), both.get_depth_frame()) if both is not None else (None, None)
    if color is None or depth is None:
        raise FrameError(f"frame {number}: the camera has sent no {'colour' if color is None else 'depth'}")
    # copies: what the library gives is its own memory, which it uses again
    raw_color = np.array(color.get_data(), np.uint8).reshape(color.get_height(), color.get_width(), 3)
    raw_depth = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width()).copy()
    return Frame(
        number,
        timestamp,
        calibration.color(raw_color, f"frame {number}: colour"),
        calibration.depth(raw_depth, f"frame {number}: depth"),
        calibration.camera,
    )


def _library() -> Any:
    try:
        import pyorbbecsdk
    except ImportError as error:
        raise ConfigError(
            "pyorbbecsdk, which reads Orbbec cameras, is not there: pip install instancemap[orbbec]"
        ) from error
    return pyorbbecsdk
