"""Writer of iPhone recordings in the layout of ScanNet++.

Source: common/scene_release.py, iphone/prepare_iphone_data.py (variants of depth.bin) and iphone/arkit_pcl.py (keys of
pose_intrinsic_imu.json) in scannetpp/scannetpp.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tests.support.recordings.phone_exports import PhoneFrame, write_jpeg, write_png, write_video


def write_scannetpp(
    scene: Path,
    frames: Sequence[PhoneFrame],
    step: int = 10,
    write_depth: Callable[[Path, Sequence[np.ndarray]], None] | None = None,
    video: bool = False,
) -> None:
    """Write every `step`-th frame of the metadata. Without `write_depth`, depth is written as extracted images.

    A video and depth.bin contain every frame, so `step` is then 1.
    """
    folder = scene / "iphone"
    folder.mkdir(parents=True)
    content = {}
    for k, frame in enumerate(frames):
        name = f"frame_{step * k:06d}"
        drift = np.eye(4)
        drift[0, 3] = 0.01 * k
        content[name] = {
            "pose": (drift @ frame.T_world_camera).tolist(),
            "intrinsic": frame.camera.K.tolist(),
            "timestamp": frame.timestamp,
            "imu": {"rotation_rate": [0.1, 0.2, 0.3], "acceleration": [0, 0, 0], "gravity": [0, -1, 0]},
            "aligned_pose": frame.T_world_camera.tolist(),
        }
        if not video:
            write_jpeg(folder / f"rgb/{name}.jpg", frame.color)
        if write_depth is None:
            write_png(folder / f"depth/{name}.png", frame.depth_mm)
    (folder / "pose_intrinsic_imu.json").write_text(json.dumps(content))
    if video:
        write_video(folder / "rgb.mp4", [frame.color for frame in frames])
    if write_depth is not None:
        write_depth(folder / "depth.bin", [frame.depth_mm for frame in frames])


def single_stream(path: Path, depths: Sequence[np.ndarray]) -> None:
    path.write_bytes(_deflate(b"".join(map(_float32, depths))))


def zlib_blocks(path: Path, depths: Sequence[np.ndarray]) -> None:
    path.write_bytes(b"".join(_block(_deflate(_float32(depth))) for depth in depths))


def lz4_blocks(path: Path, depths: Sequence[np.ndarray]) -> None:
    import lz4.block

    packed = [lz4.block.compress(depth.astype("<u2").tobytes(), store_size=False) for depth in depths]
    path.write_bytes(b"".join(map(_block, packed)))


def _float32(depth_mm: np.ndarray) -> bytes:
    return (depth_mm / np.float32(1000)).astype("<f4").tobytes()


def _deflate(raw: bytes) -> bytes:
    packer = zlib.compressobj(wbits=-15)
    return packer.compress(raw) + packer.flush()


def _block(packed: bytes) -> bytes:
    return struct.pack("<I", len(packed)) + packed
