"""Replica as NICE-SLAM distributes it (Straub et al., 2019; Zhu et al., CVPR 2022): renders of eight scanned rooms.

    cam_params.json                     of all scenes: {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}
    room0/results/frame000000.jpg       8-bit colour, from 0
    room0/results/depth000000.png       uint16 along z, `scale` units a metre
    room0/traj.txt                      line k: T_world_camera of frame k, 16 numbers row by row, m

The camera's axes are x right, y down, z forward: NICE-SLAM turns them for its own use when it reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from framework.data import Camera
from framework.datasets.calibration.camera_json import camera_of, read_json_object
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, Recording, numbered_images, paired_images
from framework.datasets.frames.stored_frames import RecordedFrame, StoredImages
from framework.errors import DataError
from framework.files.matrix_file import PrintedMatrix, read_matrix_lines

CAMERA_KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


@dataclass
class ReplicaNiceSlam(Recording):
    """A scene of Replica in NICE-SLAM's layout: exact depth and poses, and no instances."""

    def open(self) -> Contents:
        path = self.folder.absolute().parent / "cam_params.json"  # not resolved: a scene may be a link
        camera, depth_scale = _read_camera(path)
        results, poses = self.folder / "results", read_matrix_lines(self.folder / "traj.txt")
        images = paired_images(
            numbered_images(results, (".jpg",)),
            numbered_images(results, (".png",)),
            lambda k: results / f"frame{k:06d}.jpg",
            lambda k: results / f"depth{k:06d}.png",
        )
        frames = [_recorded(pair, k, poses) for k, pair in images.items()]
        return Contents(camera, path, depth_scale, frames)


def _recorded(images: StoredImages, k: int, poses: Sequence[PrintedMatrix]) -> RecordedFrame:
    if k < len(poses):
        return RecordedFrame.posed(images, k / FRAME_RATE, poses[k].pose)
    why = f"{images.color_name}: traj.txt has {len(poses)} poses and none for it"
    return RecordedFrame(images, k / FRAME_RATE, fault=why)


def _read_camera(path: Path) -> tuple[Camera, float]:
    """The camera and the depth scale (units per metre)."""
    if not path.is_file():
        raise DataError(
            f"{path} is missing: it lies beside the scenes' folders, of which dataset.scene=room0 names one"
        )
    camera = read_json_object(path).get("camera")
    if not isinstance(camera, dict):
        raise DataError(f'{path} must hold {{"camera": {{{", ".join(CAMERA_KEYS)}}}}}')
    return camera_of(path, camera, CAMERA_KEYS)
