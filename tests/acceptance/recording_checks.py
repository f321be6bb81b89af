"""Recordings with and without errors, for the acceptance of `instancemap check`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from framework.checking.recording_check import check
from framework.data import Float64
from framework.datasets.frames.conventions import CameraAxes
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.replica_nice_slam import ReplicaNiceSlam
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.scannet.scannet import ScanNet
from framework.datasets.seven_scenes import SevenScenes
from framework.datasets.tum_rgbd import TumRgbd
from framework.geometry import inverse
from framework.interfaces import RGBDSequence
from framework.sensors.noise_models import SensorChoice
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from tests.support.recordings.damaged import in_axes, in_millimeters, inverted_opengl, scalar_first, write_damaged

FARTHEST = 5.0  # maximum mapped depth, m
SYNTHETIC = 50  # number of valid synthetic recordings
KIND, AXES, DELAY, POSES = (f"dataset.{name}=" for name in ("pose_kind", "camera_axes", "depth_delay", "pose_delay"))


def inverted_ros(T: Float64) -> Float64:
    return inverse(in_axes(CameraAxes.ROS)(T))


# arguments of write_damaged and the setting that `check` must report; the depth scale depends on the recording
DAMAGES: list[tuple[Mapping[str, Any], str]] = [
    ({"pose": inverse}, f"{KIND}T_CAMERA_WORLD"),
    ({"pose": in_axes(CameraAxes.OPENGL)}, f"{AXES}OPENGL"),
    ({"pose": in_axes(CameraAxes.ROS)}, f"{AXES}ROS"),
    ({"pose": inverted_opengl}, f"{KIND}T_CAMERA_WORLD {AXES}OPENGL"),
    ({"pose": scalar_first}, "dataset.quaternion_order=WXYZ"),
    ({"pose": in_millimeters}, "dataset.pose_unit=0.001"),
    ({"pose": inverted_ros}, f"{KIND}T_CAMERA_WORLD {AXES}ROS"),
    ({"scale": 10.0}, ""),
    ({"scale": 0.2}, ""),
    ({"scale": 0.1}, ""),
    ({"depth_late": 2}, f"{DELAY}2"),
    ({"depth_late": -1}, f"{DELAY}-1"),
    ({"poses_late": 3}, f"{POSES}3"),
    ({"poses_late": 1}, f"{POSES}1"),
    ({"poses_late": -2}, f"{POSES}-2"),
]


def posed_recordings(data: Path) -> list[Recording]:
    """Return the valid recordings with poses."""
    return [
        RgbdFolder(data / "redkitchen"),
        RgbdFolder(data / "replica_floor2"),
        TumRgbd(data / "tum_fr1_rpy_a", scene="rgbd_dataset_freiburg1_rpy"),
        TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy"),
        ScanNet(data / "scannet_scene0000", scene="scene0000_00"),
    ]


def valid_recordings(data: Path) -> Iterator[RGBDSequence]:
    yield from posed_recordings(data)
    yield from (RgbdFolder(data / name) for name in ("mit76", "redwood5"))
    yield SevenScenes(data / "originals/seven_scenes/redkitchen", scene="seq-01")
    yield ReplicaNiceSlam(data / "originals/replica_nice_slam", scene="office0")
    sensors = [one for one in SensorChoice if one is not SensorChoice.AUTO]
    for seed in range(SYNTHETIC):
        kind = list(RoomKind)[seed % len(RoomKind)]
        yield Synthetic(seed=seed, kind=kind, sensor=sensors[seed % len(sensors)], frames=60)


def wrong_diagnoses(data: Path) -> Iterator[str]:
    """Check each posed recording with each damage, and yield one line for each wrong diagnosis."""
    for recording in posed_recordings(data):
        for damage, setting in DAMAGES:
            expected = setting or f"dataset.depth_scale={recording.contents.depth_scale:g}"
            with tempfile.TemporaryDirectory() as directory:
                place = write_damaged(Path(directory, "damaged"), recording, **damage)
                got = " ".join(finding.setting for finding in check(RgbdFolder(place), FARTHEST).errors)
            if got != expected:
                yield f"{recording.name}: expected {expected}, got {got or 'no setting'}"


def false_alarms(data: Path) -> Iterator[str]:
    """Check the valid recordings, and yield one line for each recording with an error."""
    for recording in valid_recordings(data):
        errors = check(recording, FARTHEST).errors
        if errors:
            yield f"{recording.name}: {errors[0].subject}: {errors[0].text}"
