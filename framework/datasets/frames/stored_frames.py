"""One frame of a recording as it lies on the disk: which images, which pose, and why it may be of no use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from framework.data import Float64, UInt8, UInt16
from framework.errors import DataError
from framework.files.image_files import read_color, read_uint16


@dataclass(frozen=True)
class StoredImages:
    """The two images of a frame, registered to each other and not read yet. Reading raises FrameError."""

    color_name: Path | str  # the file, and the place in it, for messages
    depth_name: Path | str
    color: Callable[[], UInt8]  # (H, W, 3) RGB
    depth: Callable[[], UInt16]  # (H, W) in units of the recording; 0 or 65535 = no reading

    @classmethod
    def of_files(cls, color: Path, depth: Path) -> StoredImages:
        """Images in files of their own, JPEG or PNG."""
        return cls(color, depth, partial(read_color, color), partial(read_uint16, depth))


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
