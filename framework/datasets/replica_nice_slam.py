"""Replica dataset as rendered for NICE-SLAM.

References: Straub et al., 2019; Zhu et al., CVPR 2022.

    cam_params.json                     for all scenes: {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}
    room0/results/frame000000.jpg       8-bit color, numbered from 0
    room0/results/depth000000.png       uint16 along z, `scale` units per meter
    room0/traj.txt                      line k, from 0: T_world_camera of frame k, 16 numbers, row-major, m

The camera axes are x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

from framework.datasets.calibration.camera_json import camera_of, read_json_object
from framework.datasets.frames.numbered_images import numbered_images, paired_images
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, Recording
from framework.errors import DataError
from framework.files.number_lines import read_matrix_lines
from framework.sensors.noise_models import SensorKind

CAMERA_KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


@dataclass
class ReplicaNiceSlam(Recording):
    """A Replica scene rendered for NICE-SLAM, with exact depth and poses but without ground-truth instances."""

    def open(self) -> Contents:
        path = self.folder.absolute().parent / "cam_params.json"  # not resolved: the scene may be a symbolic link
        if not path.is_file():
            expected = "expected camera parameters next to the scene folders, got no such file"
            raise DataError(f"{path}: {expected}; set dataset.scene to a scene folder, such as room0")
        content = read_json_object(path).get("camera")
        if not isinstance(content, dict):
            expected = f"expected a JSON object with the keys {', '.join(CAMERA_KEYS)}"
            raise DataError(f"{path}: camera: {expected}, got {content!r:.60}")
        camera, depth_scale = camera_of(path, content, CAMERA_KEYS)
        results, poses = self.folder / "results", read_matrix_lines(self.folder / "traj.txt")
        images = paired_images(numbered_images(results, (".jpg",)), numbered_images(results, (".png",)))
        frames = []
        for k, pair in images.items():
            if k < len(poses):
                frames.append(RecordedFrame.posed(pair, k / FRAME_RATE, poses[k].stored_pose))
            else:
                error = f"{pair.color_name}: expected pose {k} in traj.txt, got only {len(poses)} poses"
                frames.append(RecordedFrame(pair, k / FRAME_RATE, error=error))
        return Contents(camera, path, depth_scale, frames, sensor=SensorKind.EXACT)
