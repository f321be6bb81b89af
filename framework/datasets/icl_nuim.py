"""ICL-NUIM dataset (Handa et al., ICRA 2014; https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html).

Rendered rooms in the layout "TUM RGB-D Compatible PNGs":

    living_room_traj0_frei_png/rgb/0.png            8-bit color, 640x480
    living_room_traj0_frei_png/depth/0.png          uint16 along z, 5000 units per meter
    living_room_traj0_frei_png/livingRoom0.gt.freiburg      frame number tx ty tz qx qy qz qw, m; traj0.gt.freiburg
                                                    in the office
    living_room_traj0_frei_png/associations.txt     not needed: images of a frame have its number as name

The frame rate is 30 Hz. The published camera has fy = -480, because the poses belong to a left-handed world with the y
axis up. Camera and world are mirrored about the plane y = 0 here, which gives fy = 480 and OpenCV's camera axes, with
the y axis down (pull request 135 of nvidia-isaac/cuVSLAM validates this). Folders such as living_room_traj0n_frei_png
contain simulated Kinect noise.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from framework.data import Camera, Float64
from framework.datasets.calibration.own_camera import own_camera
from framework.datasets.frames.conventions import Mirror
from framework.datasets.frames.numbered_images import numbered_images, paired_images
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, Recording
from framework.errors import DataError
from framework.files.tum_trajectory import TumLine, read_tum_lines
from framework.sensors.noise_models import SensorKind

CAMERA = Camera(640, 480, 481.20, 480.00, 319.50, 239.50)  # as published, with positive fy
DEPTH_SCALE = 5000.0  # units per meter
POSES = ".gt.freiburg"

log = logging.getLogger(__name__)

_NOISY = re.compile(r"traj[0-9]n(_|$)")


@dataclass
class IclNuim(Recording):
    """A sequence of ICL-NUIM, with exact poses."""

    def open(self) -> Contents:
        files = sorted(path for path in self.folder.iterdir() if path.name.endswith(POSES))
        if len(files) != 1:
            expected = f"expected one file with poses, such as livingRoom0{POSES}"
            if any(self.folder.glob("*.depth")):
                found = "got depth as text (.depth); download the TUM RGB-D compatible PNGs of this trajectory"
                raise DataError(f"{self.folder}: {expected}, {found}")
            raise DataError(f"{self.folder}: {expected}, got {len(files)}; set dataset.scene to a sequence")
        lines = {int(line.timestamp): line for line in read_tum_lines(files[0])}
        images = paired_images(*(numbered_images(self.folder / name, (".png",)) for name in ("rgb", "depth")))
        frames = []
        for number, pair in images.items():
            if number in lines:
                frames.append(RecordedFrame.posed(pair, number / FRAME_RATE, _mirrored(lines[number])))
            else:
                error = f"{pair.color_name}: expected a pose in {files[0].name}, got none for frame {number}"
                frames.append(RecordedFrame(pair, number / FRAME_RATE, error=error))
        sensor = SensorKind.KINECT_V1 if _NOISY.search(self.name) else SensorKind.EXACT
        own = own_camera(self.name, self.folder, [Path(pair.color_name) for pair in images.values()], DEPTH_SCALE)
        if own is None:
            log.info("%s: published camera of ICL-NUIM", self.name)
            return Contents(CAMERA, "the camera of ICL-NUIM", DEPTH_SCALE, frames, sensor=sensor)
        frames = [replace(frame, images=own.images(frame.images)) for frame in frames]
        camera, depth_scale, distortion, _ = own.stored
        return Contents(camera, own.source, depth_scale, frames, distortion, sensor)


def _mirrored(line: TumLine) -> Callable[[], Float64]:
    """Return the function that reads the pose (4, 4) in the mirrored world."""
    return lambda: Mirror.Y.undone(line.pose())
