"""ScanNet files as published, either `.sens` files or folders exported by SensReader."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from framework.data import Camera

DEPTH_CAMERA = Camera(32, 24, 29.0, 29.0, 15.5, 11.5)
COLOR_CAMERA = Camera(65, 49, 58.5, 58.5, 32.5, 24.0)
NO_POSE = np.full((4, 4), -np.inf)
RAW, PNG, JPEG = 0, 1, 2
ZLIB, OCCIPITAL = 1, 2


@dataclass
class Shot:
    """Content of one frame. Images given as bytes are written unchanged."""

    color: np.ndarray | bytes
    depth: np.ndarray | bytes
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    times: tuple[int, int] = (0, 0)  # microseconds


def shots(count: int = 3) -> list[Shot]:
    """Return frames with smooth colors and slanted depth. The camera moves by 5 cm per frame along x."""
    u, v = np.meshgrid(np.arange(COLOR_CAMERA.width), np.arange(COLOR_CAMERA.height))
    x, y = np.meshgrid(np.arange(DEPTH_CAMERA.width), np.arange(DEPTH_CAMERA.height))
    made = []
    for k in range(count):
        color = np.stack([3 * u, 5 * v, np.full_like(u, 40 * k + 10)], axis=-1).astype(np.uint8)
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.05 * k
        made.append(Shot(color, (1500 + 10 * x + y + k).astype(np.uint16), T_world_camera, (100 + k, 33333 * k + 7)))
    return made


def sens(
    frames: list[Shot],
    *,
    color_camera: Camera = COLOR_CAMERA,
    depth_camera: Camera = DEPTH_CAMERA,
    color_extrinsics: np.ndarray | None = None,
    compressions: tuple[int, int] = (PNG, ZLIB),
    units: float = 1000.0,
    version: int = 4,
    count: int | None = None,
) -> bytes:
    """Return the content of a `.sens` file."""
    name = b"StructureSensor"
    parts = [struct.pack("<IQ", version, len(name)), name]
    extrinsics = np.eye(4) if color_extrinsics is None else color_extrinsics
    matrices = (intrinsics(color_camera), extrinsics, intrinsics(depth_camera), np.eye(4))
    parts += [matrix.astype("<f4").tobytes() for matrix in matrices]
    parts.append(struct.pack("<ii", *compressions))
    parts.append(struct.pack("<IIII", color_camera.width, color_camera.height, depth_camera.width, depth_camera.height))
    parts.append(struct.pack("<fQ", units, len(frames) if count is None else count))
    for shot in frames:
        color, depth = packed_color(shot.color, compressions[0]), packed_depth(shot.depth, compressions[1])
        parts.append(shot.T_world_camera.astype("<f4").tobytes())
        parts.append(struct.pack("<QQQQ", *shot.times, len(color), len(depth)))
        parts += [color, depth]
    parts.append(struct.pack("<Q", 1) + struct.pack("<15dQ", *range(15), 5))  # an IMU reading
    return b"".join(parts)


def write_sens(path: Path, frames: list[Shot], **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(sens(frames, **options))  # type: ignore[arg-type]


def write_exported(folder: Path, frames: list[Shot], suffix: str = ".png") -> None:
    """Write the output of `SensReader/python/reader.py`. By default, color is PNG and therefore exact."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for k, shot in enumerate(frames):
        assert cv2.imwrite(str(folder / "color" / f"{k}{suffix}"), shot.color[..., ::-1])
        assert cv2.imwrite(str(folder / "depth" / f"{k}.png"), shot.depth)
        np.savetxt(folder / "pose" / f"{k}.txt", shot.T_world_camera, fmt="%f")
    for name, camera in (("color", COLOR_CAMERA), ("depth", DEPTH_CAMERA)):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", intrinsics(camera), fmt="%f")
        np.savetxt(folder / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4), fmt="%f")


def write_posed_images(folder: Path, frames: list[Shot], camera: Camera = COLOR_CAMERA) -> None:
    """Write the output of `data/scannet/extract_posed_images.py` of MMDetection3D, with depth and JPEG color."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, shot in enumerate(frames):
        jpeg = [cv2.IMWRITE_JPEG_QUALITY, 100]
        assert cv2.imwrite(str(folder / f"{k:05d}.jpg"), shot.color[..., ::-1], jpeg)
        assert cv2.imwrite(str(folder / f"{k:05d}.png"), shot.depth)
        np.savetxt(folder / f"{k:05d}.txt", shot.T_world_camera, fmt="%f")
    np.savetxt(folder / "intrinsic.txt", intrinsics(camera), fmt="%f")


def intrinsics(camera: Camera) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = camera.K
    return matrix


def packed_color(image: np.ndarray | bytes, compression: int) -> bytes:
    if isinstance(image, bytes):
        return image
    if compression == RAW:
        return image.tobytes()
    return cv2.imencode(".png" if compression == PNG else ".jpg", image[..., ::-1])[1].tobytes()


def packed_depth(image: np.ndarray | bytes, compression: int) -> bytes:
    if isinstance(image, bytes):
        return image
    raw = image.astype("<u2").tobytes()
    return raw if compression == RAW else zlib.compress(raw)
