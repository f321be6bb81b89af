"""Tests for ICL-NUIM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Camera
from framework.datasets.icl_nuim import CAMERA, IclNuim
from framework.errors import DataError
from framework.geometry import transform
from framework.sensors.noise_models import SensorKind
from tests.support.recordings.phone_exports import PhoneFrame, write_png
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames
from tests.support.recordings.recordings import fault_of, opened, write_color, write_depth

SCENE = "living_room_traj0_frei_png"
FRAMES = tuple(replace(frame, timestamp=k / 30) for k, frame in enumerate(desk_frames()))
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def write_icl_nuim(folder: Path, frames: Sequence[PhoneFrame], first: int = 0) -> None:
    """Write "TUM RGB-D Compatible PNGs".

    Source: https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html and pull request 135 of nvidia-isaac/cuVSLAM.
    """
    poses, pairs = [], []
    for k, frame in enumerate(frames, start=first):
        write_png(folder / f"rgb/{k}.png", frame.color[..., ::-1])
        write_png(folder / f"depth/{k}.png", 5 * frame.depth_mm)
        T = MIRROR @ frame.T_world_camera @ MIRROR
        values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        poses.append(f"{k} {' '.join(f'{value:.9f}' for value in values)}")
        pairs.append(f"{k} depth/{k}.png {k} rgb/{k}.png")
    (folder / "livingRoom0.gt.freiburg").write_text("\n".join(poses) + "\n")
    (folder / "associations.txt").write_text("\n".join(pairs) + "\n")


@pytest.mark.parametrize("first", [0, 1])
def test_icl_nuim_desk_round_trip_preserves_frames(tmp_path: Path, first: int) -> None:
    write_icl_nuim(tmp_path / SCENE, FRAMES, first)
    sequence = opened("icl_nuim", f"dataset.root={tmp_path}", f"dataset.scene={SCENE}")
    check_round_trip(FRAMES, sequence, same_camera=False)
    assert sequence[0].camera == CAMERA == Camera(640, 480, 481.2, 480.0, 319.5, 239.5)


def test_icl_nuim_points_are_mirrored_published_points(tmp_path: Path) -> None:
    """A pixel back-projected with the published intrinsics (fy = -480) and pose gives the mirrored point.

    The first pose of livingRoom0.gt.freiburg is the identity at (0, 0, -2.25).
    """
    write_color(tmp_path / f"{SCENE}/rgb/1.png", (1, 2, 3))
    write_depth(tmp_path / f"{SCENE}/depth/1.png", 10_000)  # 2 m
    (tmp_path / f"{SCENE}/livingRoom0.gt.freiburg").write_text("1 0 0 -2.25 0 0 0 1\n")
    frame = IclNuim(tmp_path, SCENE)[0]
    u, v = 100.0, 30.0
    published = np.array([(u - 319.5) / 481.2 * 2, (v - 239.5) / -480.0 * 2, 2 - 2.25])
    camera = frame.camera
    z = float(frame.depth[30, 100])
    own = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    np.testing.assert_allclose(transform(frame.T_world_camera, own), published * [1, -1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "sensor"),
    [
        ("living_room_traj1_frei_png", SensorKind.EXACT),
        ("living_room_traj1n_frei_png", SensorKind.KINECT_V1),
        ("traj3n_frei_png", SensorKind.KINECT_V1),
        ("traj3_frei_png", SensorKind.EXACT),
    ],
)
def test_icl_nuim_sensor_is_that_of_folder_name(tmp_path: Path, name: str, sensor: SensorKind) -> None:
    write_icl_nuim(tmp_path / name, FRAMES[:1])
    assert IclNuim(tmp_path / name)[0].sensor is sensor


def test_icl_nuim_frame_without_pose_is_skipped(tmp_path: Path) -> None:
    write_icl_nuim(tmp_path / SCENE, FRAMES)
    path = tmp_path / f"{SCENE}/livingRoom0.gt.freiburg"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[2]]))
    message = "rgb/1.png: expected a pose in livingRoom0.gt.freiburg, got none for frame 1"
    assert message in fault_of(IclNuim(tmp_path / SCENE), 1)
    path.write_text("\n".join([lines[0], "1 0 0 0 0 0 0 2", lines[2]]))
    assert "line 2: expected a quaternion qx qy qz qw of length 1" in fault_of(IclNuim(tmp_path / SCENE), 1)


def test_icl_nuim_missing_files_raise(tmp_path: Path) -> None:
    write_icl_nuim(tmp_path / SCENE, FRAMES)
    with pytest.raises(DataError, match=r"expected one file with poses, such as livingRoom0.gt.freiburg, got 0; set"):
        IclNuim(tmp_path)
    (tmp_path / f"{SCENE}/traj0.gt.freiburg").write_text("")
    with pytest.raises(DataError, match=r"expected one file with poses, .*, got 2"):
        IclNuim(tmp_path / SCENE)
    (tmp_path / f"{SCENE}/traj0.gt.freiburg").unlink()
    (tmp_path / f"{SCENE}/depth/1.png").unlink()
    assert "depth/1.png: expected a readable file" in fault_of(IclNuim(tmp_path / SCENE), 1)
    (tmp_path / f"{SCENE}/depth").rename(tmp_path / "depth")
    with pytest.raises(DataError, match=r"depth: expected a folder, got none"):
        IclNuim(tmp_path / SCENE)
