"""Writers of a transforms.json with images.

Sources: docs/quickstart/data_conventions.md, process_data/polycam_utils.py and nerfstudio_dataparser.py in
nerfstudio-project/nerfstudio; scripts/nerfcapture_dataset.py in jc211/NeRFCapture.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from framework.data import Camera
from tests.support.recordings.phone_exports import PhoneFrame, write_jpeg, write_png

NERFCAPTURE_DEPTH_SCALE = 10.0  # m, parameter --depth_scale of the script


def write_nerfstudio(folder: Path, frames: Sequence[PhoneFrame]) -> None:
    """Write one set of intrinsics, JPEG images and depth in millimeters, without timestamps."""
    content: dict[str, object] = {
        "camera_model": "OPENCV",
        **_intrinsics(frames[0].camera),
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }
    entries = []
    for k, frame in enumerate(frames, start=1):
        write_jpeg(folder / f"images/frame_{k:05d}.jpg", frame.color)
        write_png(folder / f"depth/frame_{k:05d}.png", frame.depth_mm)
        entries.append(
            {
                "file_path": f"images/frame_{k:05d}.jpg",
                "depth_file_path": f"depth/frame_{k:05d}.png",
                "transform_matrix": _opengl(frame),
            }
        )
    content["frames"] = entries[::-1]  # nerfstudio sorts frames by name
    (folder / "transforms.json").write_text(json.dumps(content, indent=4))


def write_nerfcapture(folder: Path, frames: Sequence[PhoneFrame]) -> None:
    """Write intrinsics of each frame and depth in units of a 65535th of the depth scale, resized to color."""
    content: dict[str, object] = {
        **_intrinsics(frames[0].camera),
        "integer_depth_scale": NERFCAPTURE_DEPTH_SCALE / 65535.0,
    }
    entries = []
    for k, frame in enumerate(frames):
        alpha = np.full((*frame.color.shape[:2], 1), 255, np.uint8)
        write_png(folder / f"images/{k}.png", np.concatenate([frame.color[..., ::-1], alpha], axis=2))
        units = frame.depth_mm / 1000 * 65535 / NERFCAPTURE_DEPTH_SCALE
        write_png(folder / f"images/{k}.depth.png", units.astype(np.uint16))
        entries.append(
            {
                "transform_matrix": _opengl(frame),
                "file_path": f"images/{k}",
                **_intrinsics(frame.camera),
                "depth_path": f"images/{k}.depth.png",
            }
        )
    content["frames"] = entries
    (folder / "transforms.json").write_text(json.dumps(content, indent=4))


def _intrinsics(camera: Camera) -> dict[str, float]:
    """Return the intrinsics with pixel centers at half integers."""
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "w": camera.width,
        "h": camera.height,
    }


def _opengl(frame: PhoneFrame) -> list[list[float]]:
    x, y, z, t = frame.T_world_camera.T
    return np.stack([x, -y, -z, t], axis=1).tolist()
