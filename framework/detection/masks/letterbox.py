"""Resizing and padding of images to the fixed input size of a network."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from enum import Enum
from typing import Any

import cv2
import numpy as np

from framework.data import Float32, UInt8

log = logging.getLogger(__name__)


class Placement(Enum):
    """Position of the resized image in the input."""

    top_left = "top_left"
    center = "center"
    stretch = "stretch"  # the image fills the input with a changed aspect ratio


class ImageFormatChoice(Enum):
    """Source of the image format that a network expects."""

    AUTO = "format of the recognized network, otherwise CUSTOM"
    CUSTOM = "placement, padding, bgr, black_level and white_level"


@dataclass(frozen=True)
class Letterbox:
    """Scale and offset between an image and the input of a network.

    In the input, the left border of the first pixel is at 0. In the image, pixel centers are at integers. Therefore,
    x_input = scale_x (u + 0.5) + left.
    """

    input_shape: tuple[int, int]  # (height, width) px of the network's input
    resized: tuple[int, int]  # (height, width) px of the resized image
    top: int  # px, offset of the resized image from the top of the input
    left: int  # px, offset of the resized image from the left side of the input
    scale_x: float  # px of the input per px of the image
    scale_y: float  # px of the input per px of the image

    @classmethod
    def fit(cls, image_shape: tuple[int, int], input_shape: tuple[int, int], placement: Placement) -> Letterbox:
        """Return the letterbox that fits an image into the input at maximum size.

        Sizes are (height, width) in px.
        """
        height, width = image_shape
        resized = input_shape
        if placement is not Placement.stretch:
            scale = min(input_shape[0] / height, input_shape[1] / width)
            resized = max(1, round(height * scale)), max(1, round(width * scale))
        centered = placement is Placement.center
        top, left = ((input_shape[k] - resized[k]) // 2 if centered else 0 for k in (0, 1))
        # rounding to whole pixels changes the scale
        return cls(input_shape, resized, top, left, resized[1] / width, resized[0] / height)

    def fill(self, color: UInt8, padding: int) -> UInt8:
        """Resize an image (h, w, 3) and pad it with a gray value to the input size."""
        height, width = self.resized
        canvas = np.full((*self.input_shape, 3), padding, np.uint8)
        canvas[self.top : self.top + height, self.left : self.left + width] = cv2.resize(
            color, (width, height), interpolation=cv2.INTER_LINEAR
        )
        return canvas

    def to_image(self, boxes: Float32) -> Float32:
        """Convert boxes (N, 4) x1 y1 x2 y2 from px of the input to px of the image."""
        shift = np.array([self.left, self.top] * 2)
        scale = np.array([self.scale_x, self.scale_y] * 2)
        return np.asarray((boxes - shift) / scale - 0.5, np.float32)


Level = float | tuple[float, float, float]
"""Network input for one channel value, for all channels or for each channel in the order of the input."""


@dataclass(frozen=True)
class ImageFormat:
    """Image format that a network expects."""

    placement: Placement
    bgr: bool  # channel order: True = BGR, False = RGB
    black: Level  # network input for a channel value of 0
    white: Level  # network input for a channel value of 255
    padding: int = 114  # gray value of the padding


def choose_format(
    network: str, known: ImageFormat | None, choice: ImageFormatChoice, custom: ImageFormat
) -> ImageFormat:
    """Return the image format of a network, and log it if it is not the custom format.

    Args:
        network: The name of the network, for the log.
        known: The format of published networks of this kind; None = unknown.
        choice: The source of the format.
        custom: The format by the parameters of the detector.
    """
    if known is None or choice is ImageFormatChoice.CUSTOM:
        return custom
    log.info(
        "detector.preprocessing: image format of %s (%s, %s, black = %s, white = %s); set "
        "detector.preprocessing=CUSTOM to use placement, bgr, black_level and white_level",
        network, known.placement.value, "BGR" if known.bgr else "RGB", _level(known.black), _level(known.white),
    )  # fmt: skip
    return known


def warn_of_format(network: str, choice: ImageFormatChoice) -> None:
    """Log a warning that the image format of a network is unknown, unless the custom format is chosen."""
    if choice is ImageFormatChoice.AUTO:
        log.warning(
            "detector.preprocessing: expected a network with a known image format, got %s; set detector.placement, "
            "detector.bgr, detector.black_level and detector.white_level to the format of its training, and "
            "detector.preprocessing=CUSTOM to confirm",
            network,
        )


def _level(level: Level) -> str:
    return f"{level:g}" if isinstance(level, float) else " ".join(f"{one:.3f}" for one in level)


def network_input(canvas: UInt8, dtype: str, bgr: bool, black: Level, white: Level) -> np.ndarray[Any, Any]:
    """Convert an RGB image to the data type, channel order and value range of a network.

    Args:
        canvas: The image (H, W, 3), RGB.
        dtype: The data type. The values are unchanged for uint8.
        bgr: True = reverse the channels to BGR.
        black: The value for 0.
        white: The value for 255.
    """
    image = canvas[..., ::-1] if bgr else canvas
    if dtype == "uint8":
        return image
    values = image * np.asarray(np.subtract(white, black) / 255, np.float32)
    values += np.asarray(black, np.float32)
    return values.astype(dtype, copy=False)
