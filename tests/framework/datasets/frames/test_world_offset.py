"""Tests for recordings with coordinates far from the origin."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from framework.data import Float64
from framework.datasets.frames.conventions import PoseKind, PoseReading
from framework.datasets.frames.world_offset import as_setting, origin_comments, world_offset_of
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import ConfigError, DataError, FrameError
from framework.exporting.exports import ExportFormat, export
from framework.files.tum_trajectory import read_tum
from framework.geometry import inverse
from framework.runs.stored_runs import read_metrics
from instancemap import load_map, run
from tests.support.recordings.damaged import write_damaged

DESK = TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy")
FAR = [(450000, 5400000, 300), (-84000, 0, 0), (12000, 12000, 0), (3980000, -12000, 4960000), (0, 0, 50000)]


TRIANGLE = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
    "property int instance\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


def shifted(shift: tuple[float, ...], T: Float64) -> Float64:
    T = T.copy()
    T[:3, 3] += shift
    return T


def recording(tmp_path: Path, shift: tuple[float, ...]) -> Path:
    return write_damaged(tmp_path / "far", DESK, pose=lambda T: shifted(shift, T), frames=6)


@pytest.mark.parametrize("shift", FAR, ids=str)
def test_recording_far_from_origin_is_recentered(
    tmp_path: Path, shift: tuple[float, ...], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    found = RgbdFolder(recording(tmp_path, shift))
    origin = np.array(found.world_origin)
    np.testing.assert_array_equal(origin % 1000, 0)
    for far, near in zip(found, DESK, strict=False):
        assert far.T_world_camera is not None
        assert np.linalg.norm(far.T_world_camera[:3, 3]) < 1000
        np.testing.assert_allclose(shifted(tuple(origin - shift), far.T_world_camera), near.T_world_camera, atol=2e-5)
    assert f"all coordinates are relative to {as_setting(origin)}" in caplog.text


def test_recording_near_origin_is_unchanged(tmp_path: Path) -> None:
    found = RgbdFolder(recording(tmp_path, (6000, 6000, 0)))
    assert found.world_origin == (0, 0, 0)
    assert DESK.world_origin == (0, 0, 0)


def test_recording_of_inverse_poses_is_recentered(tmp_path: Path) -> None:
    place = write_damaged(tmp_path / "far", DESK, pose=lambda T: inverse(shifted(FAR[1], T)), frames=3)
    found = RgbdFolder(place, pose_reading=PoseReading(PoseKind.T_CAMERA_WORLD))
    assert found.world_origin == (-83000, 0, 0) or found.world_origin == (-84000, 0, 0)
    assert np.abs(found[0].T_world_camera[:3, 3]).max() < 1500


def test_world_offset_of_outlier_is_zero() -> None:
    positions = np.zeros((9, 3))
    positions[0] = 1e12
    assert not world_offset_of("AUTO", positions).any()
    assert not world_offset_of("AUTO", np.zeros((0, 3))).any()
    np.testing.assert_array_equal(world_offset_of("1 -2.5 3e5", positions), (1, -2.5, 3e5))


@pytest.mark.parametrize("parameter", ["auto", "", "1 2", "1 2 3 4", "1 2 nan", "1 2 1e9", "1,2,3"])
def test_invalid_world_offset_raises(parameter: str) -> None:
    with pytest.raises(ConfigError, match=r'dataset\.world_offset: expected AUTO or three numbers "x y z"'):
        world_offset_of(parameter, np.zeros((1, 3)))


def test_pose_far_from_world_offset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"expected a pose within 10000 m of dataset\.world_offset, got 5"):
        RgbdFolder(recording(tmp_path, FAR[0]), world_offset="0 0 0")[0]


@pytest.mark.parametrize(
    ("shift", "world_offset"),
    [*((shift, "AUTO") for shift in FAR), ((30, 0, 0), "30 0 0"), ((0, 0, 0), "-9 4 0")],
    ids=str,
)
def test_truth_mesh_moves_with_world_offset(tmp_path: Path, shift: tuple[float, ...], world_offset: str) -> None:
    """A mesh in the world frame of the recording or in that of the map is the same ground truth.

    A mesh in the world frame of a map names the origin, or the origin is far.
    """
    place = recording(tmp_path, shift)
    origin = np.array(RgbdFolder(place, world_offset=world_offset).world_origin)
    comments = "".join(f"comment {comment}\n" for comment in origin_comments(origin) if world_offset != "AUTO")
    corners = np.array([[0, 0, 1], [1.25, 0, 1], [0, 1.5, 1.125]]) + shift
    (tmp_path / "instances.json").write_text('{"1": {"name": "desk", "class": "dining table"}}')
    for name, vertices in {"world": corners, "map": corners - origin}.items():
        rows = "".join(f"{x:.4f} {y:.4f} {z:.4f} 1\n" for x, y, z in vertices)
        header = TRIANGLE.replace("element vertex", f"{comments * (name == 'map')}element vertex")
        (tmp_path / f"{name}.ply").write_text(f"{header}{rows}3 0 1 2\n")
        truth = RgbdFolder(place, ground_truth=tmp_path / f"{name}.ply", world_offset=world_offset).scene_truth()
        assert truth is not None
        np.testing.assert_allclose(truth.points_world, corners - origin, atol=1e-3)


@pytest.mark.integration
def test_run_far_from_origin_equals_run_near_origin(tmp_path: Path) -> None:
    """The outputs are those of the run at the origin, and name the origin of the map."""
    formats = [ExportFormat(name) for name in ("ply", "obj", "glb", "floorplan", "graph")]
    stages = ("tracker=ground_truth", "detector=none", "fuser.voxel_size=0.02", "dataset=rgbd_folder")
    places = {"near": (0.0, 0.0, 0.0), "far": (450000.0, 5400000.0, 1000.0)}
    for name, shift in places.items():
        place = write_damaged(tmp_path / name, DESK, pose=lambda T, shift=shift: shifted(shift, T), frames=4)
        run(tmp_path / f"run_{name}", *stages, f"dataset.root={place}")
    near, far = (load_map(tmp_path / f"run_{name}" / "map.npz").mesh().vertices for name in places)
    origin = [read_metrics(tmp_path / "run_far")[f"map.origin.{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(near - (np.array(origin) - places["far"]), far, atol=1e-3)
    _, poses = read_tum(tmp_path / "run_far/trajectory.txt")
    assert np.abs(poses[:, :3, 3]).max() < 1000
    named = f"origin of the map in the world frame of the recording, m: {' '.join(f'{value:.12g}' for value in origin)}"
    assert (tmp_path / "run_far/trajectory.txt").read_text().startswith(f"# {named}\n")
    assert f"comment {named}\n".encode() in (tmp_path / "run_far/mesh.ply").read_bytes()
    export(tmp_path / "run_far", formats, up=(0, 0, 1), floor=1000.0)
    export(tmp_path / "run_near", formats, up=(0, 0, 1), floor=0.0)
    for name in ("scene.ply", "scene.obj", "scene.glb", "map.yaml"):
        assert named.encode() in (tmp_path / "run_far/export" / name).read_bytes()
        assert b"origin of the map" not in (tmp_path / "run_near/export" / name).read_bytes()
    for name in ("floor_plan.geojson", "scene_graph.json"):
        assert json.loads((tmp_path / "run_far/export" / name).read_text())["map_origin"] == origin
        assert "map_origin" not in json.loads((tmp_path / "run_near/export" / name).read_text())
    resumed = (*stages, f"dataset.root={tmp_path / 'far'}")
    run(tmp_path / "again", *resumed, resume_from=str(tmp_path / "run_far"))
    with pytest.raises(DataError, match=r'resume_from: expected poses .*; set "dataset\.world_offset=0 0 0"'):
        run(tmp_path / "refused", *resumed, resume_from=str(tmp_path / "run_near"))
