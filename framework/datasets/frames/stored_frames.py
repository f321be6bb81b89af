"""One frame of a recording as it lies on the disk: which images, which pose, and why it may be of no use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from framework.data import Float64, UInt8, UInt16
from framework.errors import DataError
from framework.files.image_files import read_color, read_uint16


class StoredImages(Protocol):
    """The two images of a frame, registered to each other and not read yet. Reading raises FrameError."""

    @property
    def color_name(self) -> Path | str:
        """For messages: the file, and where in it."""

    @property
    def depth_name(self) -> Path | str:
        """Likewise."""

    def color(self) -> UInt8:
        """(H, W, 3) RGB."""

    def depth(self) -> UInt16:
        """(H, W) in the recording's units; 0 or 65535 = no reading."""


@dataclass(frozen=True)
class ImageFiles:
    """Images in files of their own, JPEG or PNG."""

    color_name: Path
    depth_name: Path

    def color(self) -> UInt8:
        return read_color(self.color_name)

    def depth(self) -> UInt16:
        return read_uint16(self.depth_name)


@dataclass(frozen=True)
class RecordedFrame:
    """One frame of a recording, images not read yet."""

    images: StoredImages
    timestamp: float  # s
    T_world_camera: Float64 | None = None  # (4, 4), None = not known
    fault: str = ""  # why the frame cannot be used, as where its pose is no pose; "" = it can
    up: Float64 | None = None  # (3,) unit vector against gravity in the camera, by a sensor; None = none tells

    @classmethod
    def posed(cls, images: StoredImages, timestamp: float, pose: Callable[[], Float64 | None]) -> RecordedFrame:
        """The frame with what `pose` returns; the DataError that it raises where there is no pose is its fault."""
        try:
            return cls(images, timestamp, pose())
        except DataError as error:
            return cls(images, timestamp, fault=str(error))
