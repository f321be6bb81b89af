"""Round trips of the desk video through file formats: the map of the imported recording is that of the original."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from framework.api import open_dataset
from framework.data import Float64
from framework.datasets.icl_nuim import IclNuim
from framework.datasets.replica_nice_slam import ReplicaNiceSlam
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.scannet.scannet import ScanNet
from framework.datasets.seven_scenes import SevenScenes
from framework.interfaces import RGBDSequence
from framework.pipeline import Pipeline
from framework.runtime.run_log import RunResult
from plugins.detectors.none import NoDetections
from plugins.trackers.ground_truth import GroundTruth
from tests.support import registered
from tests.support.recordings.arkit_scenes_files import write_arkit_scenes
from tests.support.recordings.colmap_files import write_colmap
from tests.support.recordings.layout_files import ICL_CAMERA, write_bundlefusion, write_icl_nuim, write_replica
from tests.support.recordings.phone_exports import (
    PhoneFrame,
    write_polycam,
    write_r3d,
    write_record3d_exr,
    write_scanner_app,
    write_stray_scanner,
)
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames, imported
from tests.support.recordings.rtabmap_files import write_rtabmap
from tests.support.recordings.scannet_files import Shot, write_posed_images
from tests.support.recordings.scannetpp_files import write_scannetpp
from tests.support.recordings.trajectory_files import write_euroc, write_kitti, write_tum_with_ids
from tests.support.recordings.transforms_files import write_nerfcapture, write_nerfstudio
from tests.support.scenes.corner_room import KeepAll

pytestmark = pytest.mark.integration

FRAMES = desk_frames()
WRITERS: dict[str, Callable[..., None]] = {
    "arkit_scenes": write_arkit_scenes,
    "nerfstudio": write_nerfstudio,
    "nerfcapture": write_nerfcapture,
    "colmap": partial(write_colmap, unit=0.4),
    "rtabmap.db": write_rtabmap,
    "scannetpp": write_scannetpp,
    "stray_scanner": write_stray_scanner,
    "polycam": write_polycam,
    "record3d.r3d": write_r3d,
    "record3d_exr": write_record3d_exr,
    "scanner_app": write_scanner_app,
}


def mapped(sequence: RGBDSequence) -> tuple[RunResult, Float64]:
    """Map all frames with their poses. Return the result and the vertices (P, 3), m, of the mesh."""
    fuser = registered.built("fuser", "bayesian_tsdf", "fuser.voxel_size=0.03")
    result = Pipeline(NoDetections(), GroundTruth(), KeepAll(), fuser, prefetch=0).run(sequence)
    return result, fuser.scene.mesh().vertices


@pytest.fixture(scope="module")
def original() -> Float64:
    """Return the map of the original frames as points (P, 3), m."""
    return mapped(open_dataset("desk", stop=30, stride=10))[1]


def check_same_map(points: Float64, original: Float64) -> None:
    for found, expected in ((points, original), (original, points)):
        distance, _ = cKDTree(expected).query(found)
        assert np.median(distance) < 2e-3
        assert np.quantile(distance, 0.99) < 0.02


@pytest.mark.parametrize("name", WRITERS)
def test_imported_desk_gives_same_map(tmp_path: Path, original: Float64, name: str) -> None:
    WRITERS[name](tmp_path / name, FRAMES)
    assert not imported(tmp_path / name, tmp_path / "out")
    result, points = mapped(RgbdFolder(tmp_path / "out"))
    assert result.frames == len(FRAMES)
    check_same_map(points, original)


@pytest.mark.parametrize(
    ("write", "name", "dataset"),
    [
        (write_replica, "room0", ReplicaNiceSlam),
        (write_bundlefusion, "apt0", SevenScenes),
        (write_icl_nuim, "living_room_traj0_frei_png", IclNuim),
        (partial(write_icl_nuim, name="traj1", first=1), "traj1_frei_png", IclNuim),
    ],
)
def test_desk_in_published_layout_gives_same_map(
    tmp_path: Path, write: Callable[..., None], name: str, dataset: Callable[..., RGBDSequence]
) -> None:
    frames = FRAMES
    if dataset is IclNuim:  # its camera is fixed
        frames = tuple(replace(frame, camera=ICL_CAMERA) for frame in FRAMES)
    write(tmp_path / name, frames)
    write_arkit_scenes(tmp_path / "scan", frames)
    assert not imported(tmp_path / "scan", tmp_path / "out")
    sequence = dataset(tmp_path, scene=name)
    without_times(frames, sequence)
    for frame, seen in zip(frames, sequence, strict=True):
        np.testing.assert_allclose(seen.depth, frame.depth_mm / np.float32(1000), atol=6e-4)
    check_same_map(mapped(sequence)[1], mapped(RgbdFolder(tmp_path / "out"))[1])


def test_posed_images_of_desk_give_same_map(tmp_path: Path, original: Float64) -> None:
    shots = [Shot(frame.color, frame.depth_mm, frame.T_world_camera) for frame in FRAMES]
    write_posed_images(tmp_path / "scene", shots, FRAMES[0].camera)
    check_same_map(mapped(ScanNet(tmp_path, "scene"))[1], original)


def without_times(frames: tuple[PhoneFrame, ...], sequence: RGBDSequence) -> None:
    for frame, seen in zip(frames, sequence, strict=True):
        np.testing.assert_allclose(seen.T_world_camera, frame.T_world_camera, atol=2e-6)


@pytest.mark.parametrize("write", [write_tum_with_ids, write_euroc, write_kitti])
def test_poses_of_rgbd_folder_in_other_formats_give_same_map(
    tmp_path: Path, original: Float64, write: Callable[..., None]
) -> None:
    write_arkit_scenes(tmp_path / "scan", FRAMES)
    assert not imported(tmp_path / "scan", tmp_path / "out")
    times = [frame.timestamp for frame in FRAMES]
    write(tmp_path / "out/poses.txt", times, [frame.T_world_camera for frame in FRAMES])
    sequence = RgbdFolder(tmp_path / "out")
    if write is write_kitti:
        without_times(FRAMES, sequence)
    else:
        check_round_trip(FRAMES, sequence, pose_tolerance=2e-6)
    check_same_map(mapped(sequence)[1], original)
