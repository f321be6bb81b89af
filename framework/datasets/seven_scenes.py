"""7-Scenes dataset (Shotton et al., CVPR 2013).

Handheld Kinect videos with KinectFusion poses:

    chess/seq-01/frame-000000.color.png     8-bit color
    chess/seq-01/frame-000000.depth.png     uint16, mm along z; 0 or 65535 = no reading
    chess/seq-01/frame-000000.pose.txt      T_world_depthcamera, four lines of four numbers, m

Color and depth are not registered in the published files. The offset is 30 px or more. Only the intrinsics of the depth
camera are published.

Other recordings in this layout have a file with their calibration (`own_camera.py`), such as camera.json,
camera-intrinsics.txt or the info.txt of BundleFusion and 12-Scenes, in the folder of the sequence or of the scene.
Their depth is registered to color, and their poses are those of the color camera. Color images may be JPEG files, and
numbers may have any number of digits.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64, UInt16
from framework.datasets.calibration.camera_json import StoredCamera
from framework.datasets.calibration.own_camera import CAMERA_JSON, OwnCamera, own_camera
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, Recording, StoredImages
from framework.datasets.seven_scenes_kernels import register_depth
from framework.errors import DataError
from framework.files.atomic_write import path_exists
from framework.files.number_lines import read_matrix

DEPTH_SCALE = 1000.0  # units per meter
DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)  # as published
# Not published: fitted by aligning depth edges to color edges in 50 frames of redkitchen. The cameras are assumed to be
# parallel and 25 mm apart, as in a Kinect. Fitting this offset as well does not improve the alignment.
COLOR_CAMERA = Camera(640, 480, 529.0, 529.0, 320.0, 239.0)
BASELINE = 0.025  # m, from the depth camera to the color camera along the x axis of the depth camera
PUBLISHED = StoredCamera(COLOR_CAMERA, DEPTH_SCALE, None)
_IMAGE_NAME = re.compile(r"(frame-([0-9]+))\.(?:color\.(?:png|jpg|jpeg)|depth\.png)")

log = logging.getLogger(__name__)


@dataclass
class SevenScenes(Recording):
    """A sequence of 7-Scenes, or another recording in the same layout.

    Published sequences: depth and poses are registered to the color camera. Lens distortion and the time offset between
    color and depth are ignored.
    """

    def open(self) -> Contents:
        self.name = f"{self.folder.resolve().parent.name}-{self.name}"
        found = sorted({path.name for path in self.folder.iterdir() if _IMAGE_NAME.fullmatch(path.name)})
        stems: dict[int, str] = {}
        for name in found:
            match = _IMAGE_NAME.fullmatch(name)
            assert match is not None
            if stems.setdefault(int(match[2]), match[1]) != match[1]:
                expected = f"expected one name for frame {int(match[2])}"
                raise DataError(f"{self.folder}: {expected}, got {stems[int(match[2])]} and {match[1]}; remove one")
        if not stems:
            expected = "expected images such as frame-000000.color.png, got none"
            raise DataError(f"{self.folder}: {expected}; set dataset.scene to a sequence such as chess/seq-01")
        images = {number: StoredImages.of_files(*_paths(self.folder, stems[number])) for number in sorted(stems)}
        own = self._own_camera([Path(one.color_name) for one in images.values()])
        camera, source = (own.stored, own.source) if own else (PUBLISHED, "the camera of 7-Scenes")
        frames = []
        for number, files in images.items():
            stored = own.images(files) if own else replace(files, depth=partial(_registered, files))
            pose = partial(_pose if own else _color_pose, self.folder / f"{stems[number]}.pose.txt")
            frames.append(RecordedFrame.posed(stored, number / FRAME_RATE, pose))
        return Contents(camera.camera, source, camera.depth_scale, frames, camera.distortion, camera.sensor)

    def _own_camera(self, color: Sequence[Path]) -> OwnCamera | None:
        """Return the calibration in a file next to the images or in the folder of the scene, or None without a file."""
        for folder in dict.fromkeys((self.folder, self.folder.absolute().parent)):
            if (own := own_camera(self.name, folder, color, DEPTH_SCALE)) is not None:
                log.info("%s: depth and poses are taken as those of the color camera", self.name)
                return own
        log.info("%s: published camera of 7-Scenes, because the folder has no %s", self.name, CAMERA_JSON)
        return None


def _paths(folder: Path, stem: str) -> tuple[Path, Path]:
    """Return the paths of the color and depth images of a frame, which may not exist.

    Raises:
        DataError: The frame has several color images.
    """
    colors = [path for suffix in ("png", "jpg", "jpeg") if path_exists(path := folder / f"{stem}.color.{suffix}")]
    if len(colors) > 1:
        raise DataError(f"{colors[0]}: expected one color image of the frame, got also {colors[1].name}; remove one")
    return (colors or [folder / f"{stem}.color.png"])[0], folder / f"{stem}.depth.png"


def _registered(images: StoredImages) -> UInt16:
    return register(np.asarray(images.depth(), np.uint16))


def _pose(path: Path) -> Float64:
    """Return the pose T_world_camera (4, 4) in a file."""
    return read_matrix(path).stored_pose()


def _color_pose(path: Path) -> Float64:
    """Return the pose T_world_camera (4, 4) of the color camera."""
    T_depthcamera_camera = np.eye(4)
    T_depthcamera_camera[0, 3] = BASELINE
    return _pose(path) @ T_depthcamera_camera


def register(raw: UInt16) -> UInt16:
    """Register a depth image (H, W), mm, to the color camera.

    The color camera has a wider field of view, so the border of the result has no readings. An image of the wrong size
    is returned unchanged, and the reader then rejects it.
    """
    if raw.shape != DEPTH_CAMERA.shape:
        return raw
    registered = np.zeros(COLOR_CAMERA.shape, np.uint16)
    ratio = COLOR_CAMERA.fx / DEPTH_CAMERA.fx
    u_0, v_0 = COLOR_CAMERA.cx - ratio * DEPTH_CAMERA.cx, COLOR_CAMERA.cy - ratio * DEPTH_CAMERA.cy
    register_depth(raw, ratio, u_0, v_0, BASELINE * DEPTH_SCALE * COLOR_CAMERA.fx, registered)
    return registered
