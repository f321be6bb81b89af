"""Replica dataset as rendered for NICE-SLAM.

References: Straub et al., 2019; Zhu et al., CVPR 2022.

    cam_params.json                     for all scenes: {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}; a file
                                        with intrinsics in the folder of a scene takes precedence
    room0/results/frame000000.jpg       8-bit color, numbered from 0
    room0/results/depth000000.png       uint16 along z, `scale` units per meter
    room0/traj.txt                      line k, from 0: T_world_camera of frame k, 16 numbers, row-major, m

The camera axes are x right, y down, z forward.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from framework.datasets.calibration.camera_json import StoredCamera, camera_of, read_json_object
from framework.datasets.calibration.own_camera import OwnCamera, own_camera
from framework.datasets.frames.numbered_images import numbered_images, paired_images
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, Recording
from framework.errors import DataError
from framework.files.number_lines import read_matrix_lines
from framework.sensors.noise_models import SensorKind

CAMERA_KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")
PARAMETERS = "cam_params.json"
DEPTH_SCALE = 6553.5  # units per meter, for files without a depth scale

log = logging.getLogger(__name__)


@dataclass
class ReplicaNiceSlam(Recording):
    """A Replica scene rendered for NICE-SLAM, with exact depth and poses but without ground-truth instances."""

    def open(self) -> Contents:
        own, results = self._own_camera(), self.folder / "results"
        poses = read_matrix_lines(self.folder / "traj.txt")
        images = paired_images(numbered_images(results, (".jpg",)), numbered_images(results, (".png",)))
        frames = []
        for k, pair in ((k, own.images(pair)) for k, pair in images.items()):
            if k < len(poses):
                frames.append(RecordedFrame.posed(pair, k / FRAME_RATE, poses[k].stored_pose))
            else:
                error = f"{pair.color_name}: expected pose {k} in traj.txt, got only {len(poses)} poses"
                frames.append(RecordedFrame(pair, k / FRAME_RATE, error=error))
        camera, depth_scale, distortion, sensor = own.stored
        return Contents(camera, own.source, depth_scale, frames, distortion, sensor)

    def _own_camera(self) -> OwnCamera:
        """Return the camera of the scene, or of all scenes if the folder of the scene has no file with a camera."""
        parent = self.folder.absolute().parent  # not resolved: the scene may be a symbolic link
        color = sorted(self.folder.glob("results/*.jpg"))
        folders = [self.folder, parent] if color else [parent]
        path = next((folder / PARAMETERS for folder in folders if (folder / PARAMETERS).is_file()), None)
        if color and (path is None or path.parent == parent):
            own = own_camera(self.name, self.folder, color, DEPTH_SCALE)
            if own is not None:
                return own
        if path is None:
            expected = "expected camera parameters next to the scene folders, got no such file"
            raise DataError(f"{parent / PARAMETERS}: {expected}; set dataset.scene to a scene folder, such as room0")
        content = read_json_object(path).get("camera")
        if not isinstance(content, dict):
            expected = f"expected a JSON object with the keys {', '.join(CAMERA_KEYS)}"
            raise DataError(f"{path}: camera: {expected}, got {content!r:.60}")
        log.info("%s: camera from %s", self.name, path)
        return OwnCamera(StoredCamera(*camera_of(path, content, CAMERA_KEYS), None, SensorKind.EXACT), path)
