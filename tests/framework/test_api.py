"""Tests for the Python API."""

from __future__ import annotations

import multiprocessing
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

import instancemap
from framework import api
from framework.api import Mapper, load_map
from framework.config.composition import composed
from framework.errors import ConfigError, DataError, InstanceMapError
from framework.files.search_paths import CONF
from framework.geometry import exp_se3
from framework.interfaces import BackEnd, MapFuser, SceneMap, SubmapChange
from framework.pipeline import Pipeline
from framework.pose_graph.depth_distortion_file import write_depth_distortion
from framework.refinement.lifting import lift
from framework.registry import build
from framework.runs.metrics import room_metrics
from framework.sensors.depth_distortion import NODES, DepthDistortion
from framework.sensors.noise_models import SensorKind
from framework.testing.corner_room import CAMERA
from tests.support import registered
from tests.support.failing_disk import FailingDisk, Fault
from tests.support.scenes.analytic_scene import Scene
from tests.support.scenes.analytic_scene import room as analytic_room
from tests.support.scenes.corner_room import CornerRoom, pose_at
from tests.support.scenes.given_changes import LAST, A, C, GivenChanges, RoomTracker, SubmapFuser

pytestmark = pytest.mark.integration

STAGES = ("detector=ground_truth", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")


def test_mapper_map_equals_pipeline_map(room: CornerRoom) -> None:
    mapper = Mapper(*STAGES)
    poses = [mapper.add(frame) for frame in room]
    assert not any(pose.lost for pose in poses)
    np.testing.assert_array_equal(poses[3].T_world_camera, pose_at(3))
    config = composed("~dataset", *STAGES)
    stages = {
        stage: build(registered.GROUPS[stage], config[stage]) for stage in registered.GROUPS if stage != "dataset"
    }
    result = Pipeline(**stages).run(room)
    ours, of_run = mapper.scene.mesh(), result.scene.mesh()
    np.testing.assert_array_equal(ours.vertices, of_run.vertices)
    np.testing.assert_array_equal(ours.instance_ids, of_run.instance_ids)
    assert list(mapper.instances()) == list(result.scene.instances()) != []


def test_run_in_directory_of_finished_process_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def locked_after_other_run(directory: Path) -> Iterator[None]:
        directory.mkdir()
        (directory / "metrics.json").write_text("{}")
        yield

    monkeypatch.setattr(api, "locked", locked_after_other_run)
    with pytest.raises(DataError, match="expected a new or empty folder"):
        instancemap.run(tmp_path / "run", "detector=none", dataset="desk")
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["metrics.json"]


def test_mapper_detection_interval_detects_every_nth_frame(room: CornerRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = Mapper(*STAGES, detection_interval=3)
    detector, detected = mapper.pipeline.detector, []
    detect = detector.detect
    monkeypatch.setattr(detector, "detect", lambda frame: detected.append(frame.index) or detect(frame))
    for frame in room:
        mapper.add(frame)
    assert detected == [0, 3]
    assert {record.visible for record in mapper.scene.table.records.values()} == {2}


def test_mapper_add_unusable_frame_keeps_map_unchanged(room: CornerRoom) -> None:
    mapper = Mapper(*STAGES)
    mapper.add(room[0])
    before = mapper.scene.mesh().vertices
    with pytest.raises(DataError, match=r"frame 1: expected a ground-truth pose at .* s, got none"):
        mapper.add(replace(room[1], T_world_camera=None))
    np.testing.assert_array_equal(mapper.scene.mesh().vertices, before)
    assert not mapper.add(room[2]).lost


def test_mapper_add_keeps_and_logs_sensor(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    mapper = Mapper(*STAGES, "detector=none")
    with caplog.at_level("INFO"):
        for k, sensor in enumerate((None, SensorKind.PHONE_LIDAR, None)):
            frame = room[k]
            mapper.add(frame.color, frame.depth, frame.T_world_camera, frame.camera, sensor=sensor)
    assert [record.message for record in caplog.records if "depth sensor" in record.message] == [
        "depth sensor: KINECT_V1, standard deviation of depth 1.9 mm at 1 m, 14.0 mm at 3 m",
        "depth sensor: PHONE_LIDAR, standard deviation of depth 10.0 mm at 1 m, 10.0 mm at 3 m",
    ]


def test_mapper_odometry_predicts_motion() -> None:
    """The camera turns by 23 degrees between frames; the odometry frame is not the world frame."""
    poses = [exp_se3(np.array([0.1, 0, 0, 0, 0.4, 0]) * k) for k in range(3)]
    start = exp_se3(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    stages = ("detector=none", "tracker.finest_scale=1", "tracker.relocalize=false", "fuser.voxel_size=0.02")
    without, mapper = Mapper(*stages), Mapper(*stages)
    frames = [analytic_room().frame(T, k) for k, T in enumerate(poses)]
    lost = [without.add(frame.color, frame.depth, camera=frame.camera).lost for frame in frames]
    assert lost == [False, True, True]
    for frame, T in zip(frames, poses, strict=True):
        found = mapper.add(frame.color, frame.depth, camera=frame.camera, odometry=start @ T)
        assert not found.lost, found.reason
        np.testing.assert_allclose(found.T_world_camera, T, atol=0.01)


@pytest.mark.parametrize("fuser", ["bayesian_tsdf", "open3d_vbg", "object_volumes", "class_only_fusion"])
def test_mapper_sensor_up_direction_is_saved_in_map(fuser: str, tmp_path: Path) -> None:
    """Only a slanted table is visible, from which the estimated up direction would be wrong."""
    tilt = np.radians(20)
    # in the frame of the first camera
    up = np.array([np.sin(tilt), -np.cos(tilt) * np.sin(1.0), -np.cos(tilt) * np.cos(1.0)])
    table = Scene(planes=[(np.array([0.0, -np.sin(1.0), -np.cos(1.0)]), -0.8)])
    stages = ("detector=none", "tracker=ground_truth", "refiner=identity", f"fuser={fuser}", "fuser.voxel_size=0.04")
    sensed, unsensed = Mapper(*stages), Mapper(*stages)
    for k in range(3):
        frame = table.frame(pose_at(k), k)
        unsensed.add(frame)
        sensed.add(frame.color, frame.depth, pose_at(k), frame.camera, up=pose_at(k)[:3, :3].T @ up)
    wrong, found = unsensed.up(), sensed.up()
    assert wrong is not None
    assert found is not None
    assert np.degrees(np.arccos(wrong @ up)) == pytest.approx(20, abs=1)
    assert np.degrees(np.arccos(min(found @ up, 1.0))) < 0.01
    assert (sensed.up_source(), unsensed.up_source(), Mapper(*stages).up_source()) == ("sensor", "surfaces", "")
    assert room_metrics(sensed.scene, sensed.mesh())["up_from"] == "sensor"
    sensed.save(tmp_path / "map.npz")
    again = load_map(tmp_path / "map.npz")
    np.testing.assert_array_equal(again.up(), found)
    assert again.up_source() == "sensor"


def test_mapper_is_thread_safe(room: CornerRoom) -> None:
    """Without the lock, kernels would write to the same buffers."""
    stages = ("detector=none", *STAGES[1:])  # frames with ground truth need increasing indices
    mapper, alone, faults = Mapper(*stages), Mapper(*stages), []

    def work(one: Callable[[], object]) -> None:
        try:
            for _ in range(10):
                one()
        except Exception as error:
            faults.append(error)

    def look() -> None:
        with mapper.lock:
            assert set(mapper.scene.mesh().instance_ids.tolist()) - {0} == set(mapper.instances())

    frame = room[0]

    def add(one: Mapper) -> None:
        one.add(frame.color, frame.depth, frame.T_world_camera, frame.camera)

    tasks = [lambda: add(mapper)] * 3 + [look, lambda: mapper.instances()]
    threads = [threading.Thread(target=work, args=(task,)) for task in tasks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults
    for _ in range(30):
        add(alone)
    np.testing.assert_array_equal(mapper.scene.mesh().vertices, alone.scene.mesh().vertices)


@pytest.mark.parametrize("fuser", ["bayesian_tsdf", "object_volumes", "class_only_fusion"])
def test_mapper_pickle_round_trip_continues_mapping(room: CornerRoom, fuser: str) -> None:
    mapper = Mapper(*STAGES, f"fuser={fuser}")
    mapper.add(room[0])
    pickled = pickle.dumps(mapper)
    assert len(pickled) < 20e6, "expected a pickle without reserved memory"
    copied = pickle.loads(pickled)
    for one in (mapper, copied):
        one.add(room[1])
    np.testing.assert_array_equal(copied.scene.mesh().vertices, mapper.scene.mesh().vertices)


def test_mapper_camera_matrix_equals_camera(room: CornerRoom) -> None:
    frame, found = room[0], []
    for camera in (frame.camera, frame.camera.K, frame.camera.K.tolist(), frame.camera.K.astype(np.float32)):
        mapper = Mapper("detector=none", *STAGES[1:])
        mapper.add(frame.color, frame.depth, pose=frame.T_world_camera, camera=camera)
        mapper.add(frame.color, frame.depth, pose=frame.T_world_camera)
        assert mapper._camera is not None
        assert mapper._camera.shape == frame.depth.shape
        found.append(mapper.mesh().vertices)
    for vertices in found[1:]:
        np.testing.assert_allclose(vertices, found[0], atol=1e-4)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (np.ones((4, 4)), r"camera: expected a Camera or \[\[fx, 0, cx\], .* got an array of shape \(4, 4\)"),
        (np.c_[np.eye(3), [-40, 0, 0]], r"got an array of shape \(3, 4\)"),  # of a stereo camera
        (np.full((3, 3), np.nan), r"camera: expected .* got \[\[nan, nan, nan\], .*\]\]$"),
        ([500, 500, 319.5, 239.5], r"got an array of shape \(4,\)"),
        ([[500, 2, 319.5], [0, 500, 239.5], [0, 0, 1]], "undistort and unskew the images first"),
        (np.diag([500.0, 500.0, 2.0]), r"camera: expected \[\[fx, 0, cx\], .* got "),
        (np.eye(3), "fx, fy, cx, cy in px"),
        ("camera.json", "got str"),
    ],
)
def test_mapper_invalid_camera_raises(room: CornerRoom, camera: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Mapper("detector=none", *STAGES[1:]).add(room[0].color, room[0].depth, camera=camera)


@pytest.mark.parametrize(
    "converted",
    [
        lambda K: K.tolist(),
        lambda K: K.astype(np.float32),
        lambda K: np.c_[K, np.zeros(3)],
        lambda K: np.vstack([np.c_[K, np.zeros(3)], [0, 0, 0, 1]]).tolist(),
        lambda K: K + np.array([[0, 1e-5, 0], [0, 0, 0], [0, 0, 0]]),
    ],
    ids=["list", "float32", "3x4", "4x4", "noise"],
)
def test_mapper_camera_matrix_of_any_form_is_camera(room: CornerRoom, converted: Any) -> None:
    c = room[0].camera
    K = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
    mapper = Mapper("detector=none", *STAGES[1:])
    mapper.add(room[0].color, room[0].depth, pose=room[0].T_world_camera, camera=converted(K))
    assert mapper._camera == c


@pytest.mark.parametrize(
    ("scale", "swap", "text"),
    [
        (2.0, False, "multiply fx, fy, cx, cy by 0.5"),
        (0.5, False, "multiply fx, fy, cx, cy by 2"),
        (1.0, True, "cx and cy are swapped"),
        (1.0, False, ""),
    ],
)
def test_mapper_camera_of_other_image_is_logged_once(
    room: CornerRoom, caplog: pytest.LogCaptureFixture, scale: float, swap: bool, text: str
) -> None:
    c = room[0].camera
    cx, cy = (c.cy, c.cx) if swap else (c.cx, c.cy)
    mapper = Mapper("detector=none", "tracker=ground_truth", *STAGES[2:])
    for k in range(2):
        K = np.diag([scale, scale, 1]) @ [[c.fx, 0, cx], [0, c.fy, cy], [0, 0, 1]]
        mapper.add(room[k].color, room[k].depth, pose=room[k].T_world_camera, camera=K)
    assert caplog.text.count("camera: expected a principal point near the center") == bool(text)
    assert text in caplog.text


@pytest.mark.parametrize(
    "converted",
    [
        lambda T: T.tolist(),
        lambda T: T.astype(np.float32),
        lambda T: T[:3],
        lambda T: T[:3].tolist(),
        lambda T: T * (1 + 1e-5 * (np.arange(4) < 3)),
    ],
    ids=["list", "float32", "3x4", "3x4_list", "rounded"],
)
def test_mapper_pose_of_any_form_is_pose(room: CornerRoom, converted: Any) -> None:
    mapper = Mapper("detector=none", "tracker=ground_truth", *STAGES[2:])
    pose = converted(room[1].T_world_camera)
    found = mapper.add(room[1].color, room[1].depth, pose=pose, camera=room[1].camera, odometry=pose)
    np.testing.assert_allclose(found.T_world_camera, room[1].T_world_camera, atol=1e-4)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.full((4, 4), np.nan), "frame 0: pose: expected finite values"),
        (np.diag([1.0, -1, 1, 1]), "frame 0: pose: expected a rigid transform, .* det R = -1"),
        (np.diag([2.0, 2, 2, 1]), "frame 0: pose: expected a rigid transform"),
        ([0, 0, 0, 0, 0, 0, 1], r"frame 0: pose: expected a rigid transform \(4, 4\), got an array of shape \(7,\)"),
        ((np.eye(3), np.zeros(3)), r"frame 0: pose: expected a rigid transform \(4, 4\), got tuple"),
        (np.eye(4) + np.outer([1, 1, 0, 0], [0, 0, 0, 5e5]), "within 10000 m"),
    ],
)
def test_mapper_invalid_pose_raises(room: CornerRoom, pose: Any, message: str) -> None:
    mapper = Mapper("detector=none", "tracker=ground_truth", *STAGES[2:])
    with pytest.raises(InstanceMapError, match=message):
        mapper.add(room[0].color, room[0].depth, pose=pose, camera=room[0].camera)


def test_mapper_poses_in_other_unit_are_logged(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    mapper = Mapper("detector=none", "tracker=ground_truth", *STAGES[2:])
    for k in range(6):
        pose = room[k].T_world_camera.copy()
        pose[:3, 3] *= 1000
        mapper.add(room[k].color, room[k].depth, pose=pose, camera=room[k].camera)
    assert caplog.text.count("depth is nowhere on the map of the frames before at 3 given poses") == 1


@pytest.mark.parametrize(
    ("tracker", "warned"), [("ground_truth", False), ("voxel_hashing_icp", True), ("open3d_odometry", True)]
)
def test_mapper_ignored_poses_are_logged_once(
    room: CornerRoom, caplog: pytest.LogCaptureFixture, tracker: str, warned: bool
) -> None:
    mapper = Mapper("detector=none", f"tracker={tracker}", *STAGES[2:])
    for k in range(3):
        assert "Mapper.add: pose" not in caplog.text or k > 1
        mapper.add(room[k].color, room[k].depth, pose=room[k].T_world_camera, camera=room[k].camera)
    assert caplog.text.count('set tracker="ground_truth", or omit pose after the first frame') == int(warned)


@pytest.mark.parametrize("index", [1, 0], ids=["repeated", "decreasing"])
def test_mapper_frame_index_not_increasing_raises(room: CornerRoom, index: int) -> None:
    """Observations are counted by index. Repeated frames would never confirm an instance."""
    mapper = Mapper(*STAGES)
    mapper.add(room[1])
    before = mapper.mesh().vertices
    with pytest.raises(DataError, match=f"frame {index}: index: expected at least 2 after frame 1, got {index}"):
        mapper.add(replace(room[2], index=index))
    np.testing.assert_array_equal(mapper.mesh().vertices, before)
    assert not mapper.add(room[2]).lost


def test_mapper_arrays_follow_frame_of_any_index(room: CornerRoom) -> None:
    mapper = Mapper("detector=none", *STAGES[1:])
    mapper.add(replace(room[0], index=41))
    mapper.add(room[1].color, room[1].depth, room[1].T_world_camera)
    assert mapper._journal.last_index == 42


@pytest.mark.parametrize("key", ["depth_distortion_from", "resume_from", "localize_in"])
def test_mapper_corrects_depth_as_stored_run(key: str, room: CornerRoom, tmp_path: Path) -> None:
    mapper = Mapper(*STAGES)
    for frame in room:
        mapper.add(frame)
    mapper.save(tmp_path / "map.npz")
    write_depth_distortion(tmp_path / "depth_distortion.json", DepthDistortion(np.full(NODES, 0.1), CAMERA.shape))
    corrected = Mapper(*STAGES, **{key: tmp_path}).pipeline.corrected(room[0])
    np.testing.assert_allclose(corrected.depth, room[0].depth + 0.1 * room[0].depth ** 2, rtol=1e-5)


def test_mapper_depth_distortion_of_other_run_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"depth_distortion_from: expected a run directory with depth_distortion\.json"):
        Mapper(*STAGES, depth_distortion_from=tmp_path)


def test_mapper_timestamp_order_is_logged_once(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    mapper = Mapper("detector=none", *STAGES[1:])
    for k, time in enumerate((5.0, 4.0, 4.0, 6.0)):
        mapper.add(room[k].color, room[k].depth, room[k].T_world_camera, room[k].camera, timestamp=time)
    assert caplog.text.count("frame 1: expected a timestamp after 5.000000 s, got 4.000000 s") == 1
    assert caplog.text.count("expected a timestamp after") == 1


def test_mapper_timestamp_in_nanoseconds_raises(room: CornerRoom) -> None:
    frame = room[0]
    with pytest.raises(DataError, match=r"frame 0: timestamp: expected a time within .* pass seconds, such as nanosec"):
        Mapper("detector=none", *STAGES[1:]).add(
            frame.color, frame.depth, frame.T_world_camera, frame.camera, timestamp=1_700_000_000_123_456_789
        )


def test_mapper_matrix_arguments_are_arrays_or_rejected(room: CornerRoom) -> None:
    frame, mapper = room[0], Mapper("detector=none", *STAGES[1:])
    with pytest.raises(DataError, match=r"frame 0: depth: expected an array, got a matrix; pass np\.asarray\(depth\)"):
        mapper.add(frame.color, np.matrix(frame.depth), frame.T_world_camera, frame.camera)
    found = mapper.add(frame.color, frame.depth, np.matrix(frame.T_world_camera), np.matrix(frame.camera.K))
    np.testing.assert_allclose(found.T_world_camera, frame.T_world_camera, atol=1e-9)


@pytest.mark.parametrize(
    ("path", "reason"),
    [("x" * 300, "got 300 characters"), ("a\0b", "null byte"), ("\ud800", "surrogates not allowed"), ("", "got ''")],
    ids=["long", "nul", "surrogate", "empty"],
)
@pytest.mark.parametrize(
    "use",
    [
        lambda path: Mapper(*STAGES).save(path),
        load_map,
        lambda path: Mapper(*STAGES, resume_from=path),
        lambda path: Mapper("tracker=trajectory_file", **{"tracker.path": path}),
        lambda path: instancemap.open_dataset("rgbd_folder", root=path),
        lambda path: instancemap.run(path, dataset="desk"),
        instancemap.report,
        instancemap.tables,
        instancemap.load_runs,
        lambda path: instancemap.export(path, "glb"),
        lambda path: instancemap.export("run", "glb", out=path),
        lambda path: instancemap.edit(path, []),
        lambda path: instancemap.edit("run", path),
        lambda path: instancemap.query(path, "chair"),
        lambda path: instancemap.import_map(path, "run"),
        lambda path: instancemap.import_map("mesh.ply", path),
    ],
)
def test_path_argument_invalid_name_raises_one_line(
    use: Any, path: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InstanceMapError) as refused:
        use(path)
    assert "\n" not in str(refused.value)
    assert reason in str(refused.value) or path == ""


def test_save_map_name_of_240_characters_is_written(tmp_path: Path) -> None:
    """The name of the temporary file must not be longer than the limit of the file system."""
    Mapper(*STAGES).save(tmp_path / ("x" * 240))
    assert [len(path.name) for path in tmp_path.iterdir()] == [240]


def test_forked_process_refuses_to_map(room: CornerRoom, tmp_path: Path) -> None:
    """OpenMP would terminate the process."""
    mapper = Mapper(*STAGES)
    mapper.add(room[0])
    mapper.save(tmp_path / "map.npz")
    context = multiprocessing.get_context("fork")
    receiving, sending = context.Pipe(duplex=False)
    uses: list[Callable[[], object]] = [
        lambda: mapper.add(room[1]),
        lambda: mapper.instances(),
        lambda: Mapper(*STAGES),
        lambda: load_map(tmp_path / "map.npz"),
        lambda: mapper.pipeline.run(room),
    ]

    def use_all() -> None:
        for use in uses:
            try:
                sending.send(use())
            except ConfigError as error:
                sending.send(str(error))

    process = context.Process(target=use_all)
    process.start()
    process.join(60)
    assert process.exitcode == 0
    for _ in uses:
        assert 'multiprocessing.get_context("spawn")' in receiving.recv()
    assert not mapper.add(room[1]).lost, "expected no effect on the parent process"


def test_mapper_add_none_raises() -> None:
    with pytest.raises(DataError, match=r"Mapper\.add: expected a Frame, or color and depth, got only NoneType"):
        Mapper(*STAGES).add(None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("detector=unregistered", "got unregistered"),
        ("fuser.voxel_sise=1", "did you mean fuser.voxel_size?"),
        ("fuser.voxel_size=-1", "voxel_size: expected a value in"),
        ("detection_cache=bogus", "detection_cache: expected one of"),
        ("seed=-1", r"seed: expected an integer in \["),
        ("~refiner", "refiner: expected a plugin's config .*; choose refiner=NAME"),
        ("dataset=desk", "got dataset=desk; use dataset, .* only on the command line"),
        ("hydra.run.dir=x", "got hydra.run.dir=x; use dataset, .* only on the command line"),
        (None, "Mapper: expected overrides such as 'fuser.voxel_size=0.02', got None"),
    ],
)
def test_mapper_invalid_override_raises_one_line_error(override: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")) as refused:
        Mapper(*STAGES, override)
    assert "\n" not in str(refused.value)


def test_mapper_works_inside_hydra_application(tmp_path: Path) -> None:
    (tmp_path / "theirs.yaml").write_text("theirs: 1\n")
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        Mapper(*STAGES)
        assert compose("theirs").theirs == 1


@pytest.mark.parametrize("fuser", registered.names("fuser"))
def test_load_map_restores_map_of_any_fuser(fuser: str, room: CornerRoom, tmp_path: Path) -> None:
    config = composed("~dataset", f"fuser={fuser}", "fuser.voxel_size=0.04")
    made: MapFuser = build(MapFuser, config.fuser)
    detector = registered.built("detector", "ground_truth")
    for frame in room:
        pose = instancemap.Pose(frame.T_world_camera)
        made.fuse(frame, pose, lift(detector.detect(frame), frame, pose))
    made.scene.save(tmp_path / "map.npz")
    stored = load_map(tmp_path / "map.npz")
    assert type(stored.scene) is type(made.scene)
    assert list(stored.instances()) == list(made.scene.instances())
    assert made.scene.instance_ids() >= set(made.scene.instances())


@pytest.mark.parametrize("place", [None, 7])
def test_save_map_invalid_path_raises(place: Any) -> None:
    with pytest.raises(DataError, match=f"map file: expected a path, got {place}"):
        Mapper(*STAGES).scene.save(place)


def test_mapper_save_on_failing_disk_keeps_a_map(room: CornerRoom, tmp_path: Path) -> None:
    mapper, path = Mapper(*STAGES), tmp_path / "map.npz"
    mapper.add(room[0])
    mapper.save(path)
    earlier = path.read_bytes()
    mapper.add(room[1])
    at = 0
    while True:
        disk = FailingDisk(at, Fault.CUT)
        try:
            with disk.active():
                mapper.save(path)
        except DataError as error:
            assert "expected a writable file, got an error (No space left on device)" in str(error)
        assert path.read_bytes() == earlier or len(load_map(path).instances()) == len(mapper.instances())
        if len(disk.operations) <= at:
            break
        at += 1
    assert at > 5


@pytest.mark.parametrize("content", [b"", b"PK", b"[]"])
def test_load_map_other_file_raises(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "map.npz").write_bytes(content)
    with pytest.raises(DataError, match=r"map\.npz: expected a map file, got unreadable data "):
        load_map(tmp_path / "map.npz")
    np.savez(tmp_path / "others.npz", a=np.zeros(3))
    with pytest.raises(DataError, match=r"others\.npz: expected a map file, got unreadable data "):
        load_map(tmp_path / "others.npz")


def test_load_map_damaged_file_raises_data_error(room: CornerRoom, tmp_path: Path) -> None:
    mapper = Mapper(*STAGES)
    mapper.add(room[0])
    mapper.scene.save(tmp_path / "map.npz")
    whole = (tmp_path / "map.npz").read_bytes()
    for position in range(0, 400, 7):
        damaged = bytearray(whole)
        damaged[position] ^= 0xFF
        (tmp_path / "map.npz").write_bytes(damaged)
        try:
            load_map(tmp_path / "map.npz")  # some bytes have no effect
        except DataError as error:
            assert "map.npz" in str(error)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("experiment=table3_map", "run: expected an override of a single run, got experiment=table3_map"),
        ("hydra.run.dir=x", "run: expected an override of a single run, got hydra.run.dir=x"),
        ("detector=unregistered", "got unregistered"),
        ("seed=-1", r"seed: expected an integer in \["),
        (None, "run: expected overrides such as 'fuser.voxel_size=0.02', got None"),
    ],
)
def test_run_invalid_override_writes_nothing(override: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        instancemap.run(tmp_path / "run", override)
    assert not (tmp_path / "run").exists()


def test_run_keeps_existing_directory(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DataError, match="expected a new or empty folder"):
        instancemap.run(tmp_path)


def test_report_and_tables_without_run_raise_data_error(tmp_path: Path) -> None:
    for function in (instancemap.report, instancemap.tables):
        with pytest.raises(DataError, match=str(tmp_path)):
            function(tmp_path)
    assert not [*tmp_path.iterdir()]


def test_api_configs_match_command() -> None:
    assert (CONF / "config.yaml").exists()
    assert composed("dataset=synthetic").fuser.voxel_size == composed("~dataset").fuser.voxel_size


def test_instancemap_help_lists_public_api() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import instancemap; help(instancemap)"], capture_output=True, text=True, check=True
    )
    for words in ("mapper.add(", "load_map(", "class Mapper", "class Frame", "depth: ", "class MapFuser"):
        assert words in done.stdout


def test_import_error_names_conflicting_framework_package(tmp_path: Path) -> None:
    (tmp_path / "framework").mkdir()
    (tmp_path / "framework" / "__init__.py").touch()
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import instancemap"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert f"got {tmp_path}/framework/__init__.py; rename the other package" in done.stderr


def test_mapper_returns_corrected_poses(room: CornerRoom) -> None:
    mapper = Mapper(*STAGES, "detector=none")
    pipeline = mapper.pipeline
    fuser = SubmapFuser()
    pipeline.tracker, pipeline.fuser, pipeline.backend = RoomTracker(), fuser, GivenChanges()
    for k, T_world_room in enumerate((np.eye(4), np.eye(4), A, A, C @ A, C @ A)):
        found = mapper.add(replace(room[k], truth=None))
        np.testing.assert_allclose(found.T_world_camera, T_world_room @ pose_at(k), atol=1e-14)
        np.testing.assert_allclose(mapper._T_world_color, found.T_world_camera, atol=1e-14)
    assert LAST not in fuser.corrected
    mapper.finish()
    assert fuser.corrected[-1] == LAST


def test_mapper_finish_raises_error_of_back_end() -> None:
    mapper = Mapper(*STAGES, "detector=none")
    mapper.pipeline.backend = _NoSolution()
    with pytest.raises(ValueError, match="no solution"):
        mapper.finish()


class _NoSolution(BackEnd):
    def finish(self, scene: SceneMap) -> SubmapChange | None:
        raise ValueError("no solution")
