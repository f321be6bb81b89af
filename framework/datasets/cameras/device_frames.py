"""Depth cameras that are read through the library of their vendor."""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, ClassVar, Protocol, TypeVar

from framework.config.validation import check_bounds
from framework.data import Frame, UInt8, UInt16
from framework.datasets.calibration.raw_images import Calibration, check_max_depth
from framework.datasets.calibration.undistortion import Distortion
from framework.errors import DataError, FrameError, in_one_line
from framework.interfaces import FrameReader, LiveVideo

WAIT_MS = 100  # for a frame, before the reader reports that none has come
LONGEST_SILENCE = 5.0  # s; a camera that runs and sends nothing for so long is broken, or its cable is

Images = TypeVar("Images")
log = logging.getLogger(__name__)


class CameraDevice(Protocol):
    """A camera of one vendor. The methods raise one of `errors` where the library does."""

    errors: tuple[type[Exception], ...]

    def start(self) -> None:
        """Start to send frames."""

    def stop(self) -> None:
        """Stop after a successful start."""

    def wait(self) -> Any:
        """Return both images, not registered yet; None = none came within WAIT_MS."""

    def calibration(self, images: Any) -> Calibration | None:
        """Return the calibration of the color camera; None = these images do not contain it."""

    def read(self, images: Any) -> tuple[UInt8 | None, UInt16 | None]:
        """Return copies of color (H, W, 3), RGB, and the depth (H, W) registered to it; None = not sent."""


@dataclass
class DepthCamera(LiveVideo):
    """Depth registered to color by the library, with the factory's calibration."""

    brand: ClassVar[str]
    serial: str = ""  # of the device, quoted; "" = the first one found
    width: int = 640  # px, in [64, 4096], of the color image
    height: int = 480  # px, in [64, 4096]
    fps: int = 30  # Hz, in [1, 300]; size and rate must be a mode of the device, which the vendor's viewer lists
    max_depth: float = 10.0  # m; farther readings become "no reading"; 0 = keep all

    def __post_init__(self) -> None:
        check_bounds(self, width=(64, 4096), height=(64, 4096), fps=(1, 300))
        check_max_depth(self.max_depth)
        self.name = "_".join(filter(None, (self.brand.lower(), self.serial)))

    @abstractmethod
    def device(self) -> CameraDevice:
        """Return the camera, not started yet. Raises ConfigError without the library."""

    def distortion(self, coefficients: Sequence[float], model: object, brown_conrady: object) -> Distortion | None:
        """Return the lens distortion; None = there is none, or it is of an unsupported model, which is logged."""
        if not any(coefficients):
            return None
        if model != brown_conrady or any(coefficients[5:]):
            message = "%s: its lens distortion, %s, is of another model than ours and is not undone"
            log.warning(message, self.name, model)
            return None
        return Distortion(*coefficients[:5])

    def frames(self) -> Generator[FrameReader | None]:
        device = self.device()
        try:
            device.start()
        except device.errors as error:
            which = f"the device {self.serial}" if self.serial else "a device"
            asked = f"{which} with {self.width}x{self.height} at {self.fps} Hz"
            raise DataError(f"{self.brand}: {asked} could not be started: {in_one_line(error)}") from error
        number = count()
        calibration: Calibration | None = None
        try:
            for images in images_of(self.brand, partial(_wait, self.brand, device)):
                if images is not None and calibration is None:
                    calibration = device.calibration(images)
                if images is None or calibration is None:
                    yield None
                else:
                    yield partial(_read, device, images, next(number), time.time(), calibration)
        finally:
            device.stop()


def images_of(name: str, wait: Callable[[], Images | None]) -> Generator[Images | None]:
    """Yield what `wait` returns, None = nothing came for WAIT_MS. Raises DataError after a long silence."""
    last_time = time.monotonic()
    while True:
        images = wait()
        if images is not None:
            last_time = time.monotonic()
        elif time.monotonic() - last_time > LONGEST_SILENCE:
            raise DataError(f"{name}: no frame has come for {LONGEST_SILENCE:g} s; is the camera still connected?")
        yield images


def _wait(brand: str, device: CameraDevice) -> Any:
    try:
        return device.wait()
    except device.errors as error:
        raise DataError(f"{brand}: {in_one_line(error)}") from error


def _read(device: CameraDevice, images: Any, number: int, timestamp: float, calibration: Calibration) -> Frame:
    """Raises FrameError if one of the two images is missing, or they cannot be registered."""
    try:
        color, depth = device.read(images)
    except device.errors as error:
        raise FrameError(f"frame {number}: {in_one_line(error)}") from error
    if color is None or depth is None:
        raise FrameError(f"frame {number}: the camera has sent no {'color' if color is None else 'depth'}")
    color = calibration.color(color, f"frame {number}: color")
    return Frame(number, timestamp, color, calibration.depth(depth, f"frame {number}: depth"), calibration.camera)
