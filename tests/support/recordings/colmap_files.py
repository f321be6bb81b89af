"""Writers of COLMAP models with the images, in binary and text form.

Source: https://colmap.github.io/format.html, and the sizes of the binary fields in scripts/python/read_write_model.py
of colmap/colmap (cameras.bin, images.bin and points3D.bin, little-endian).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.recordings.phone_exports import PhoneFrame, write_jpeg, write_png

OPENCV, OPENCV_PARAMETERS = 4, 8  # id and number of parameters of the camera model
STEP = 40  # px, distance of the pixels with a 3D point


def write_colmap(
    folder: Path, frames: Sequence[PhoneFrame], unit: float, binary: bool = True, lens=(0, 0, 0, 0)
) -> None:
    """Write the images and a model whose unit is `unit` m. Each 3D point is seen in one image."""
    for k, frame in enumerate(frames):
        write_jpeg(folder / f"images/frame_{k}.jpg", frame.color)
        write_png(folder / f"depth/frame_{k}.png", frame.depth_mm)
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    seen = [observations(frame, unit) for frame in frames]
    (_write_binary if binary else _write_text)(model, frames, seen, unit, lens)


def observations(frame: PhoneFrame, unit: float) -> list[tuple[float, float, np.ndarray]]:
    """Return the pixel (u, v), with pixel centers at half integers, and the position of each 3D point."""
    found = []
    height, width = frame.depth_mm.shape
    camera = frame.camera
    for v in range(STEP // 2, height, STEP):
        for u in range(STEP // 2, width, STEP):
            z = frame.depth_mm[v, u] / 1000
            if z > 0:
                point = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 1.0])
                found.append((u + 0.5, v + 0.5, (frame.T_world_camera @ point)[:3] / unit))
    return found


def _pose(frame: PhoneFrame, unit: float) -> list[float]:
    R, t = frame.T_world_camera[:3, :3].T, -frame.T_world_camera[:3, :3].T @ frame.T_world_camera[:3, 3]
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return [w, x, y, z, *(t / unit)]


def _parameters(frame: PhoneFrame, lens) -> list[float]:
    c = frame.camera
    return [c.fx, c.fy, c.cx + 0.5, c.cy + 0.5, *lens]


def _write_binary(model: Path, frames: Sequence[PhoneFrame], seen: list, unit: float, lens) -> None:
    camera = frames[0].camera
    parameters = struct.pack(f"<{OPENCV_PARAMETERS}d", *_parameters(frames[0], lens))
    head = struct.pack("<QiiQQ", 1, 1, OPENCV, camera.width, camera.height)
    (model / "cameras.bin").write_bytes(head + parameters)
    images, points = struct.pack("<Q", len(frames)), struct.pack("<Q", sum(map(len, seen)))
    number = 0
    for k, (frame, found) in enumerate(zip(frames, seen, strict=True), start=1):
        images += struct.pack("<i7di", k, *_pose(frame, unit), 1) + f"frame_{k - 1}.jpg".encode() + b"\0"
        images += struct.pack("<Q", len(found) + 1)
        for index, (u, v, point) in enumerate(found):
            number += 1
            images += struct.pack("<ddq", u, v, number)
            points += struct.pack("<Q3d3BdQii", number, *point, 1, 2, 3, 0.5, 1, k, index)
        images += struct.pack("<ddq", 1.5, 2.5, -1)  # a feature without a 3D point
    (model / "images.bin").write_bytes(images)
    (model / "points3D.bin").write_bytes(points)


def _write_text(model: Path, frames: Sequence[PhoneFrame], seen: list, unit: float, lens) -> None:
    camera = frames[0].camera
    parameters = " ".join(map(repr, map(float, _parameters(frames[0], lens))))
    (model / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: 1\n"
        f"1 OPENCV {camera.width} {camera.height} {parameters}\n"
    )
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    number = 0
    for k, (frame, found) in enumerate(zip(frames, seen, strict=True), start=1):
        images.append(f"{k} {' '.join(map(repr, map(float, _pose(frame, unit))))} 1 frame_{k - 1}.jpg")
        words = []
        for index, (u, v, point) in enumerate(found):
            number += 1
            words.append(f"{u} {v} {number}")
            points.append(f"{number} {' '.join(map(repr, map(float, point)))} 1 2 3 0.5 {k} {index}")
        images.append(" ".join([*words, "1.5 2.5 -1"]))
    (model / "images.txt").write_text("\n".join(images) + "\n")
    (model / "points3D.txt").write_text("\n".join(points) + "\n")
