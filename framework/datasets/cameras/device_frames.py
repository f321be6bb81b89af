"""Live depth cameras, read with the vendors' libraries."""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, ClassVar, TypeVar

from framework.config.validation import check_bounds
from framework.data import Frame, UInt8, UInt16
from framework.datasets.calibration.raw_images import Calibration, check_max_depth
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import AUTO, color_delay_of
from framework.errors import DataError, FrameError, in_one_line
from framework.interfaces import FrameReader, LiveVideo
from framework.runtime.frame_stream import steady_time
from framework.sensors.noise_models import SensorChoice, SensorKind, kind_of_device

WAIT_MS = 100  # ms, maximum wait for a frame
LONGEST_SILENCE = 5.0  # s, maximum time without a frame; the camera then counts as disconnected

Images = TypeVar("Images")
log = logging.getLogger(__name__)


@dataclass
class DepthCamera(LiveVideo):
    """A depth camera with factory calibration.

    The vendor's library registers depth to color.
    """

    brand: ClassVar[str]
    default_sensor: ClassVar[SensorKind]  # kind of the depth sensor in devices with unknown names
    serial: str = ""  # serial number of the device; "" = the first device found
    width: int = 640  # width of the color image and of the registered depth image, px, in [64, 4096]
    height: int = 480  # height of the color image and of the registered depth image, px, in [64, 4096]
    # frame rate, Hz, in [1, 300]; width, height and fps must match a mode of the device
    fps: int = 30
    max_depth: float = 10.0  # maximum depth, m, >= 0; farther readings are dropped; 0 = unlimited
    # delay of color relative to depth at equal timestamps, s, in [-0.2, 0.2]; positive = color captured later; AUTO =
    # estimated during the run, 0 until then
    color_delay: str = AUTO
    # depth sensor, which selects the noise model: AUTO (from the device), EXACT (rendered depth), KINECT_V1,
    # REALSENSE_D435, TIME_OF_FLIGHT or PHONE_LIDAR
    sensor: SensorChoice = SensorChoice.AUTO

    def __post_init__(self) -> None:
        check_bounds(self, width=(64, 4096), height=(64, 4096), fps=(1, 300))
        check_max_depth(self.max_depth)
        color_delay_of(self.color_delay)
        self.name = "_".join(filter(None, (self.brand.lower(), self.serial)))
        self.errors: tuple[type[Exception], ...] = (RuntimeError,)  # errors of the library

    def constant_color_delay(self) -> float | None:
        return color_delay_of(self.color_delay)

    @abstractmethod
    def start(self) -> None:
        """Start streaming.

        Raises:
            ConfigError: The library is not installed.
            Exception: The device cannot stream. The type is one of `self.errors`.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop streaming."""

    @abstractmethod
    def wait(self) -> Any:
        """Return the next pair of images, or None if none arrives within WAIT_MS.

        The images are not registered yet and have the type of the vendor's library.
        """

    @abstractmethod
    def calibrate(self, images: Any) -> Calibration | None:
        """Return the calibration of the color camera, or None if the images do not contain the calibration."""

    @abstractmethod
    def read(self, images: Any) -> tuple[UInt8 | None, UInt16 | None]:
        """Return copies of the color image (H, W, 3), RGB, and of the registered depth (H, W).

        Depth is in device units. A missing image is None.
        """

    @abstractmethod
    def device_name(self) -> str:
        """Return the model name of the streaming device, such as "Intel RealSense D435"."""

    def depth_after_color(self, images: Any) -> float | None:
        """Return the delay of the depth image after the color image in s, or None if unknown."""
        return None

    def distortion(self, coefficients: Sequence[float], model: object, brown_conrady: object) -> Distortion | None:
        """Return the lens distortion, or None for a pinhole camera.

        An unsupported lens model is logged and ignored.

        Args:
            coefficients: The coefficients k1, k2, p1, p2, k3, and possibly others that must be 0.
            model: The lens model of the device.
            brown_conrady: The supported lens model, as defined by the vendor's library.
        """
        if not any(coefficients):
            return None
        if model != brown_conrady or any(coefficients[5:]):
            message = (
                "%s: expected Brown-Conrady lens distortion (k1, k2, p1, p2, k3), got %s with the coefficients %s; "
                "images are not undistorted"
            )
            log.warning(message, self.name, model, list(coefficients))
            return None
        return Distortion(*coefficients[:5])

    def frames(self) -> Generator[FrameReader | None]:
        try:
            self.start()
        except self.errors as error:
            which = f"device {self.serial}" if self.serial else "a device"
            mode = f"{self.width}x{self.height} at {self.fps} Hz"
            raise DataError(
                f"{self.brand}: expected {which} with {mode}, got an error ({in_one_line(error)}); check the "
                "connection and dataset.serial, or set dataset.width, dataset.height and dataset.fps to a supported "
                "mode"
            ) from error
        number = count()
        calibration: Calibration | None = None
        try:
            sensor = self.sensor.kind(kind_of_device(self.device_name()) or self.default_sensor)
            for images in images_of(self.brand, self.wait):
                if images is not None and calibration is None:
                    calibration = self.calibrate(images)
                if images is None or calibration is None:
                    yield None
                else:
                    yield partial(self._frame, images, next(number), steady_time(), calibration, sensor)
        except self.errors as error:
            raise DataError(
                f"{self.brand}: expected a running camera, got an error ({in_one_line(error)}); check its connection"
            ) from error
        finally:
            self.stop()

    def _frame(self, images: Any, number: int, timestamp: float, calibration: Calibration, sensor: SensorKind) -> Frame:
        """Return the registered frame.

        Raises:
            FrameError: An image is missing, or registration fails.
        """
        try:
            color, depth = self.read(images)
        except self.errors as error:
            raise FrameError(
                f"frame {number}: expected color and depth, got an error ({in_one_line(error)})"
            ) from error
        if color is None or depth is None:
            raise FrameError(
                f"frame {number}: expected color and depth, got no {'color' if color is None else 'depth'}"
            )
        color = calibration.color(color, f"frame {number}: color")
        metric = calibration.depth(depth, f"frame {number}: depth")
        depth_after = self.depth_after_color(images)
        depth_timestamp = None if depth_after is None else timestamp + depth_after
        return Frame(
            number, timestamp, color, metric, calibration.camera, depth_timestamp=depth_timestamp, sensor=sensor
        )


def images_of(name: str, wait: Callable[[], Images | None]) -> Generator[Images | None]:
    """Yield the images returned by `wait`, including None.

    Raises:
        DataError: No images arrive for LONGEST_SILENCE seconds.
    """
    last_time = time.monotonic()
    while True:
        images = wait()
        if images is not None:
            last_time = time.monotonic()
        elif time.monotonic() - last_time > LONGEST_SILENCE:
            raise DataError(
                f"{name}: expected a frame within {LONGEST_SILENCE:g} s, got none; check the camera's connection"
            )
        yield images
