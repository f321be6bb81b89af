"""Import of scans from 3D Scanner App by Laan Labs (https://3dscannerapp.com), exported as "All Data".

    frame_00000.json        intrinsics of color, 3 x 3, row-major; cameraPoseARFrame, ARKit's T_world_camera, 4 x 4,
                            row-major; time, s
    frame_00000.jpg         8-bit color in sensor orientation, only for some frames
    depth_00000.png         uint16 mm, 256x192
    conf_00000.png          uint8 0 to 2, from ARKit, optional

Only low-resolution scans contain depth.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from framework.datasets.calibration.camera_json import number_list, numbers_of, pinhole, read_json_object
from framework.datasets.frames.sequence_reader import FRAME_RATE
from framework.errors import DataError
from framework.files.image_files import read_color, read_uint8, read_uint16
from framework.importing.source import DeviceFrame, Format, Source, arkit_pose, arkit_up, meters
from framework.sensors.noise_models import SensorKind

_FRAME = re.compile(r"frame_([0-9]{5,9})\.json")


def recognized(path: Path) -> bool:
    """Return True if the path is a scan of 3D Scanner App."""
    return path.is_dir() and any(_FRAME.fullmatch(entry.name) for entry in path.iterdir())


def open_source(path: Path) -> Source:
    """Open a recording.

    Raises:
        DataError: There are no frames with color and depth.
    """
    digits = sorted(match[1] for entry in path.iterdir() if (match := _FRAME.fullmatch(entry.name)))
    complete = [n for n in digits if (path / f"frame_{n}.jpg").exists() and (path / f"depth_{n}.png").exists()]
    if not complete:
        raise DataError(
            f"{path}: expected frames with frame_00000.jpg and depth_00000.png, got none; in the app, make a "
            'low-resolution scan, which includes depth, and export "All Data"'
        )
    frames = [partial(_read, path, number) for number in complete]
    return Source("3D Scanner App", frames, len(frames), posed=True, sensor=SensorKind.PHONE_LIDAR)


def _read(folder: Path, number: str) -> DeviceFrame:
    path = folder / f"frame_{number}.json"
    content = read_json_object(path)
    color = read_color(folder / f"frame_{number}.jpg")
    confidence = folder / f"conf_{number}.png"
    fx, _, cx, _, fy, cy, _, _, _ = number_list(f"{path}: intrinsics", content.get("intrinsics"), 9)
    pose = np.reshape(number_list(f"{path}: cameraPoseARFrame", content.get("cameraPoseARFrame"), 16), (4, 4))
    T_world_camera = arkit_pose(path, pose)
    height, width = color.shape[:2]
    return DeviceFrame(
        name=path,
        timestamp=numbers_of(path, content, "time")[0] if "time" in content else int(number) / FRAME_RATE,
        camera=pinhole(path, width, height, fx, fy, cx, cy),
        color=color,
        depth=meters(read_uint16(folder / f"depth_{number}.png")),
        confidence=read_uint8(confidence) if confidence.exists() else None,
        T_world_camera=T_world_camera,
        up=arkit_up(T_world_camera),
    )


NEEDS = 'a folder with frame_00000.json, exported from 3D Scanner App as "All Data"'
FORMAT = Format("scanner_app", NEEDS, recognized, open_source)
