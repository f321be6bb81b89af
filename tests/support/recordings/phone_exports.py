"""Exports of phone apps, written from known frames."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Camera, Float64, Frame, UInt8, UInt16
from framework.datasets.rgbd_folder import RgbdFolder
from framework.sensors.noise_models import SensorKind
from tests.support.scenes.corner_room import look, pose_at

LIDAR = (192, 256)  # (h, w) of ARKit depth images, px
ARKIT_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # ARKit's camera axes: y up and z backward


@dataclass(frozen=True)
class PhoneFrame:
    """Frame of a phone."""

    timestamp: float  # s
    camera: Camera  # camera of the color image
    color: UInt8  # (H, W, 3) RGB
    depth_mm: UInt16  # (h, w)
    confidence: UInt8  # (h, w), 0 to 2
    T_world_camera: Float64  # T_world_camera (4, 4), in the camera axes of this project

    @property
    def T_world_arkit(self) -> Float64:
        return self.T_world_camera @ ARKIT_AXES


def seen_by_phone(frames: Sequence[Frame], shape: tuple[int, int] = LIDAR) -> Iterator[PhoneFrame]:
    """Yield frames with the depth resolution of a phone. The confidence is low next to depth steps."""
    for frame in frames:
        assert frame.T_world_camera is not None
        v, u = (
            np.rint((np.arange(n) + 0.5) * m / n - 0.5).astype(int)
            for n, m in zip(shape, frame.depth.shape, strict=True)
        )
        depth = frame.depth[v][:, u]
        kernel = np.ones((3, 3))
        beside_step = cv2.dilate(depth, kernel) > 1.05 * cv2.erode(np.where(depth > 0, depth, 100), kernel)
        yield PhoneFrame(
            timestamp=248630.5 + frame.timestamp,
            camera=frame.camera,
            color=frame.color,
            depth_mm=np.rint(depth * 1000).astype(np.uint16),
            confidence=np.where(depth == 0, 0, np.where(beside_step, 1, 2)).astype(np.uint8),
            T_world_camera=frame.T_world_camera,
        )


def numbered(values: np.ndarray | Sequence[float]) -> str:
    return ", ".join(repr(float(value)) for value in np.ravel(values))


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_jpeg(path: Path, color: UInt8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])


def write_video(path: Path, colors: Sequence[UInt8]) -> None:
    height, width = colors[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (width, height))
    assert video.isOpened()
    video.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
    for color in colors:
        video.write(np.ascontiguousarray(color[..., ::-1]))
    video.release()


def write_stray_scanner(folder: Path, frames: Sequence[PhoneFrame], own_intrinsics: bool = True) -> None:
    """Write an export of Stray Scanner, see docs/format.md and OdometryEncoder in StrayRobots/scanner."""
    folder.mkdir(parents=True)
    K = frames[0].camera.K
    (folder / "camera_matrix.csv").write_text("\n".join(numbered(row) for row in K))
    intrinsics = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y" if own_intrinsics else ""
    lines = [f"timestamp, frame, x, y, z, qx, qy, qz, qw{intrinsics}"]
    for k, frame in enumerate(frames):
        write_png(folder / f"depth/{k:06d}.png", frame.depth_mm)
        write_png(folder / f"confidence/{k:06d}.png", frame.confidence)
        T = frame.T_world_arkit @ ARKIT_AXES  # q_WA * q_AC in the app
        pose = numbered([*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])
        c = frame.camera
        own = f", {numbered([c.fx, c.fy, c.cx, c.cy])}, , " if own_intrinsics else ""
        lines.append(f"{frame.timestamp!r}, {k:06d}, {pose}{own}")
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    write_video(folder / "rgb.mp4", [frame.color for frame in frames])


ROOM = Camera(320, 240, 300.0, 301.0, 157.0, 118.0)
T_COLOR_DEPTH = np.eye(4)  # values of a RealSense D435i
T_COLOR_DEPTH[:3, :3] = Rotation.from_quat([0.001509, 0.001900, 0.006073, 0.999979]).as_matrix()
T_COLOR_DEPTH[:3, 3] = 0.015014, 0.000251, 0.000425


def room_frames(count: int = 4) -> list[PhoneFrame]:
    """Return frames of a small room with exact depth. The focal length changes from frame to frame."""
    frames = []
    for k in range(count):
        camera = replace(ROOM, fx=ROOM.fx - 2 * k, fy=ROOM.fy - 2 * k)
        T_world_camera = pose_at(k)
        color = look(camera, T_world_camera)[2]
        depth = look(camera.scaled(0.25), T_world_camera)[0]
        depth_mm = np.rint(1000 * depth).astype(np.uint16)
        confidence = np.full(depth.shape, 2, np.uint8)
        confidence[:10], confidence[10:20] = 0, 1
        frames.append(PhoneFrame(100.5 + k / 30, camera, color, depth_mm, confidence, T_world_camera))
    return frames


def check_imported(
    folder: Path, frames: Sequence[PhoneFrame], scale: float = 1.0, least: int = 1, tells_up: bool = True
) -> None:
    """Check the size, intrinsics, poses, up direction, color and depth of the imported folder."""
    sequence = RgbdFolder(folder)
    assert sequence.camera == frames[0].camera.scaled(scale)
    assert len(sequence) == len(frames)
    for frame, seen in zip(frames, sequence, strict=True):
        assert seen.sensor is SensorKind.PHONE_LIDAR
        assert seen.timestamp == pytest.approx(frame.timestamp, abs=1e-6)
        np.testing.assert_allclose(seen.T_world_camera, frame.T_world_camera, atol=1e-6)
        if tells_up:
            np.testing.assert_allclose(frame.T_world_camera[:3, :3] @ seen.up, [0, 1, 0], atol=1e-6)  # y is up in ARKit
        depth, _, color, ids = look(sequence.camera, frame.T_world_camera)
        rows = 240 * scale * np.array([0, 10, 20]) / 60
        unsure = np.zeros(depth.shape, bool)
        unsure[: max(0, int(rows[least]) - 4)] = True
        assert (seen.depth[unsure] == 0).all()
        sure = ~unsure
        sure[: int(rows[least]) + 4] = False
        assert (seen.depth[sure] > 0).all()
        error = np.abs(seen.depth - depth)[sure & (ids == 0) & (seen.depth > 0)]
        assert np.median(error) < 1e-3
        assert (error > 0.02).mean() < 0.05
        assert np.abs(seen.color.astype(int) - color).mean() < 12


def record3d_metadata(frames: Sequence[PhoneFrame], own_intrinsics: bool = True) -> dict[str, object]:
    """Return the content of metadata.json. Newer versions have separate intrinsics for each frame."""
    (dh, dw), camera = frames[0].depth_mm.shape, frames[0].camera
    poses = [[*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]] for T in (frame.T_world_arkit for frame in frames)]
    metadata = {
        "dh": dh,
        "dw": dw,
        "h": camera.height,
        "w": camera.width,
        "fps": 30,
        "cameraType": 1,
        "K": camera.K.T.ravel().tolist(),
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "poses": poses,
        "frameTimestamps": [frame.timestamp for frame in frames],
    }
    own = [[frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy] for frame in frames]
    return metadata | ({"perFrameIntrinsicCoeffs": own} if own_intrinsics else {})


def write_record3d_exr(folder: Path, frames: Sequence[PhoneFrame]) -> None:
    import OpenEXR

    (folder / "depth").mkdir(parents=True)
    (folder / "metadata.json").write_text(json.dumps(record3d_metadata(frames)))
    for k, frame in enumerate(frames):
        write_jpeg(folder / f"rgb/{k}.jpg", frame.color)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        depth = np.ascontiguousarray(frame.depth_mm / 1000, np.float16)  # OpenEXR requires contiguous memory
        OpenEXR.File(header, {"R": depth}).write(str(folder / f"depth/{k}.exr"))


def write_r3d(path: Path, frames: Sequence[PhoneFrame], confident: bool = True) -> None:
    import lzfse

    with zipfile.ZipFile(path, "w") as file:
        file.writestr("metadata", json.dumps(record3d_metadata(frames)))
        for k, frame in enumerate(frames):
            _, data = cv2.imencode(".jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
            file.writestr(f"rgbd/{k}.jpg", data.tobytes())
            file.writestr(f"rgbd/{k}.depth", lzfse.compress((frame.depth_mm / 1000).astype("<f4").tobytes()))
            if confident:
                file.writestr(f"rgbd/{k}.conf", lzfse.compress(frame.confidence.tobytes()))


def write_scanner_app(folder: Path, frames: Sequence[PhoneFrame]) -> None:
    """Write the "All Data" export of a low-resolution scan, in which every frame is complete."""
    for k, frame in enumerate(frames):
        write_png(folder / f"depth_{k:05d}.png", frame.depth_mm)
        write_png(folder / f"conf_{k:05d}.png", frame.confidence)
        write_jpeg(folder / f"frame_{k:05d}.jpg", frame.color)
        content = {
            "averageAngularVelocity": 0.1,
            "averageVelocity": 0.2,
            "cameraPoseARFrame": frame.T_world_arkit.ravel().tolist(),
            "exposureDuration": 0.016,
            "frame_index": k,
            "intrinsics": frame.camera.K.ravel().tolist(),
            "motionQuality": 0.9,
            "projectionMatrix": np.eye(4).ravel().tolist(),
            "time": frame.timestamp,
        }
        (folder / f"frame_{k:05d}.json").write_text(json.dumps(content))
    (folder / "info.json").write_text("{}")


def write_polycam(folder: Path, frames: Sequence[PhoneFrame], prefix: str = "") -> None:
    """Write raw data of Polycam, see the README of polyform. The prefix corrected_ marks optimized data."""
    keyframes = folder / "keyframes"
    (keyframes / f"{prefix}cameras").mkdir(parents=True)
    for frame in frames:
        stem = str(round(frame.timestamp * 1e6))
        write_jpeg(keyframes / f"{prefix}images/{stem}.jpg", frame.color)
        camera, T = frame.camera, frame.T_world_arkit
        content = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
        content |= {f"t_{row}{column}": float(T[row, column]) for row in range(3) for column in range(4)}
        content |= {"blur_score": 123.4, "timestamp": int(stem)}
        (keyframes / f"{prefix}cameras/{stem}.json").write_text(json.dumps(content))
        if not prefix:
            write_png(keyframes / f"depth/{stem}.png", frame.depth_mm)
            write_png(keyframes / f"confidence/{stem}.png", np.array([0, 54, 255], np.uint8)[frame.confidence])
