"""7-Scenes dataset (Shotton et al., CVPR 2013).

Handheld Kinect videos with KinectFusion poses:

    chess/seq-01/frame-000000.color.png     8-bit color
    chess/seq-01/frame-000000.depth.png     uint16, mm along z; 0 or 65535 = no reading
    chess/seq-01/frame-000000.pose.txt      T_world_depthcamera, four lines of four numbers, m

Color and depth are not registered in the published files. The offset is 30 px or more. Only the intrinsics of the depth
camera are published.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64, UInt16
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, Recording, StoredImages
from framework.datasets.seven_scenes_kernels import register_depth
from framework.errors import DataError
from framework.files.number_lines import read_matrix

DEPTH_SCALE = 1000.0  # units per meter
DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)  # as published
# Not published: fitted by aligning depth edges to color edges in 50 frames of redkitchen. The cameras are assumed to be
# parallel and 25 mm apart, as in a Kinect. Fitting this offset as well does not improve the alignment.
COLOR_CAMERA = Camera(640, 480, 529.0, 529.0, 320.0, 239.0)
BASELINE = 0.025  # m, from the depth camera to the color camera along the x axis of the depth camera
_IMAGE_NAME = re.compile(r"frame-([0-9]{6})\.(color|depth)\.png")


@dataclass
class SevenScenes(Recording):
    """A sequence of 7-Scenes, with depth and poses registered to the color camera.

    Lens distortion and the time offset between color and depth are ignored.
    """

    def open(self) -> Contents:
        self.name = f"{self.folder.resolve().parent.name}-{self.name}"
        names = (_IMAGE_NAME.fullmatch(path.name) for path in self.folder.iterdir())
        numbers = sorted({int(match[1]) for match in names if match})
        if not numbers:
            expected = "expected images such as frame-000000.color.png, got none"
            raise DataError(f"{self.folder}: {expected}; set dataset.scene to a sequence such as chess/seq-01")
        frames = [_recorded(self.folder, number) for number in numbers]
        return Contents(COLOR_CAMERA, "the camera of 7-Scenes", DEPTH_SCALE, frames)


def _recorded(folder: Path, number: int) -> RecordedFrame:
    stem = f"frame-{number:06d}"
    files = StoredImages.of_files(folder / f"{stem}.color.png", folder / f"{stem}.depth.png")
    images = replace(files, depth=lambda: register(np.asarray(files.depth(), np.uint16)))
    return RecordedFrame.posed(images, number / FRAME_RATE, lambda: _color_pose(folder / f"{stem}.pose.txt"))


def _color_pose(path: Path) -> Float64:
    """Return the pose T_world_camera (4, 4) of the color camera."""
    T_depthcamera_camera = np.eye(4)
    T_depthcamera_camera[0, 3] = BASELINE
    return read_matrix(path).pose() @ T_depthcamera_camera


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
