"""Calibration of a recording in the layout of a published dataset, from a file next to its images.

camera.json                             as in RGB-D folders; takes precedence
camera-intrinsics.txt, intrinsics.txt, calibration.txt, cam_K.txt, camera_info.yaml, intrinsic/intrinsic_color.txt ...
                                        a format of `calibration_text.py`
info.txt, _info.txt                     m_calibrationColorIntrinsic, m_calibrationDepthIntrinsic and so on, from
                                        ScanNet's SensReader (BundleFusion, 12-Scenes)
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.datasets.calibration.calibration_text import intrinsics_of, read_calibration
from framework.datasets.calibration.camera_json import StoredCamera, pinhole, read_camera
from framework.datasets.calibration.color_registration import ColorRegistration, registered_images
from framework.datasets.frames.numbered_images import first_size
from framework.datasets.frames.sequence_reader import StoredImages
from framework.errors import DataError, errors_of
from framework.files.image_files import read_color
from framework.files.number_lines import numbers, read_lines

CAMERA_JSON = "camera.json"
FOLDERS = (".", "intrinsic")  # relative to the folder of a recording
SUFFIXES = (".txt", ".json", ".yaml", ".yml", ".ini", ".cfg", ".conf", ".xml")
SENSOR_INFO = ("info.txt", "_info.txt")
IDENTITY_WITHIN = 1e-3  # maximum difference of extrinsics from the identity

_NAME = re.compile(
    r".*calib.*|.*intrinsic.*|cam(era)?[-_]?(s|params?|parameters|info|k|[0-9]+)?|k|_?info", re.IGNORECASE
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OwnCamera:
    """Calibration of a recording."""

    stored: StoredCamera  # of the depth images
    source: Path | str  # file or parameter with the camera, for messages
    registration: ColorRegistration | None = None  # None = color and depth images have the same camera

    def images(self, files: StoredImages) -> StoredImages:
        """Return the images of a frame, with color registered to depth."""
        return files if self.registration is None else registered_images(files, self.registration)


def own_camera(name: str, folder: Path, color: Sequence[Path], depth_scale: float) -> OwnCamera | None:
    """Return and log the calibration in a folder, or None without such a file.

    Args:
        name: The name of the recording, for messages.
        folder: The folder.
        color: The color images. They define the image size if the file has none.
        depth_scale: The depth scale of the layout, units per meter, for files without one.

    Raises:
        DataError: The file is invalid or has an unknown format.
    """
    path = _calibration_file(folder)
    if path is None:
        return None
    if path.name == CAMERA_JSON:
        own = OwnCamera(read_camera(path), path)
    elif path.name in SENSOR_INFO:
        own = _sensor_info(path)
    else:
        found = read_calibration(path)
        camera = found.camera(*first_size(color, read_color))
        own = OwnCamera(StoredCamera(camera, found.depth_scale or depth_scale, found.distortion), path)
    log.info("%s: camera from %s, with %g depth units per m", name, path, own.stored.depth_scale)
    return own


def _calibration_file(folder: Path) -> Path | None:
    """Return the file with the calibration of color, or None. Files of other cameras come last."""
    files = [path for name in FOLDERS for path in sorted((folder / name).glob("*")) if _is_calibration(path)]
    return min(files, key=lambda path: (path.name != CAMERA_JSON, bool(re.search("depth|ir", path.stem))), default=None)


def _is_calibration(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and _NAME.fullmatch(path.stem) is not None and path.is_file()


def _sensor_info(path: Path) -> OwnCamera:
    words = {key.strip(): value.split() for key, _, value in (line.partition("=") for line in read_lines(path))}

    def values(name: str, count: int) -> list[float]:
        return numbers(f"{path}: {name}", words.get(name, []), count)

    cameras = []
    for name in ("color", "depth"):
        size = values(f"m_{name}Width", 1) + values(f"m_{name}Height", 1)
        K = np.reshape(values(f"m_calibration{name.title()}Intrinsic", 16), (4, 4))
        cameras.append(pinhole(path, *size, *intrinsics_of(path, K)))
        extrinsics = f"m_calibration{name.title()}Extrinsic"
        if extrinsics in words and not np.allclose(values(extrinsics, 16), np.eye(4).ravel(), atol=IDENTITY_WITHIN):
            raise DataError(f"{path}: {extrinsics}: expected the identity, got another transform; register the images")
    color, depth = cameras
    with errors_of(path):
        registration = None if color == depth else ColorRegistration(color, depth)
    return OwnCamera(StoredCamera(depth, values("m_depthShift", 1)[0], None), path, registration)
