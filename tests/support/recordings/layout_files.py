"""Writers of RGB-D videos in the layouts of published datasets.

Sources: https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html (ICL-NUIM), the Replica sequences of cvg/nice-slam, the
README of BundleFusion's dataset (https://graphics.stanford.edu/projects/bundlefusion), and the output of SensReader
(ScanNet/ScanNet).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Camera
from tests.support.recordings.phone_exports import PhoneFrame, write_jpeg, write_png
from tests.support.recordings.scannet_files import intrinsics

ICL_CAMERA = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)  # published with fy = -480
REPLICA_SCALE = 6553.5  # depth units per m


def write_icl_nuim(folder: Path, frames: Sequence[PhoneFrame], name: str = "livingRoom0", first: int = 0) -> None:
    """Write the "TUM RGB-D compatible PNGs", with poses of a left-handed world with the y axis up."""
    lines, associations = [], []
    for k, frame in enumerate(frames, start=first):
        write_png(folder / f"rgb/{k}.png", frame.color[..., ::-1])
        write_png(folder / f"depth/{k}.png", (5 * frame.depth_mm.astype(np.uint32)).astype(np.uint16))
        S = np.diag([1.0, -1.0, 1.0, 1.0])
        T = S @ frame.T_world_camera @ S
        quat_xyzw = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines.append(" ".join(f"{value:.9g}" for value in (k, *T[:3, 3], *quat_xyzw)))
        associations.append(f"{k} depth/{k}.png {k} rgb/{k}.png")
    (folder / f"{name}.gt.freiburg").write_text("\n".join(lines) + "\n")
    (folder / "associations.txt").write_text("\n".join(associations) + "\n")


def write_replica(folder: Path, frames: Sequence[PhoneFrame]) -> None:
    """Write a scene, and the camera of all scenes in the parent folder."""
    lines = []
    for k, frame in enumerate(frames):
        write_jpeg(folder / f"results/frame{k:06d}.jpg", frame.color)
        write_png(
            folder / f"results/depth{k:06d}.png", np.rint(frame.depth_mm * REPLICA_SCALE / 1000).astype(np.uint16)
        )
        lines.append(" ".join(f"{value:.18e}" for value in frame.T_world_camera.ravel()))
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    c = frames[0].camera
    content = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": REPLICA_SCALE}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": content}))


def write_bundlefusion(folder: Path, frames: Sequence[PhoneFrame]) -> None:
    """Write the images of SensReader, with the calibration in info.txt."""
    for k, frame in enumerate(frames):
        write_jpeg(folder / f"frame-{k:06d}.color.jpg", frame.color)
        write_png(folder / f"frame-{k:06d}.depth.png", frame.depth_mm)
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", frame.T_world_camera, fmt="%.9g")
    camera = frames[0].camera
    K, identity = (" ".join(f"{value:g}" for value in T.ravel()) + " " for T in (intrinsics(camera), np.eye(4)))
    lines = [
        *("m_versionNumber = 4", "m_sensorName = StructureSensor"),
        *(f"m_colorWidth = {camera.width}", f"m_colorHeight = {camera.height}"),
        *(f"m_depthWidth = {camera.width}", f"m_depthHeight = {camera.height}", "m_depthShift = 1000"),
        *(f"m_calibrationColorIntrinsic = {K}", f"m_calibrationColorExtrinsic = {identity}"),
        *(f"m_calibrationDepthIntrinsic = {K}", f"m_calibrationDepthExtrinsic = {identity}"),
        f"m_frames.size = {len(frames)}",
    ]
    (folder / "info.txt").write_text("\n".join(lines) + "\n")
