"""Tests for the run directory."""

from __future__ import annotations

import csv
import errno
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from framework.checking.changed_sequences import ChangedSequence
from framework.data import Frame, InstanceMesh, Pose, SceneTruth
from framework.errors import DataError, MapFullError
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import PredictedInstances, Transfer, evaluate
from framework.files.manifest import Manifest, RunStatus
from framework.files.tum_trajectory import read_tum
from framework.pipeline import Pipeline
from framework.pose_graph.graph_file import read_pose_graph
from framework.runs import provenance, reproduction, run_directory
from framework.runs.instances_file import write_instances
from framework.runs.mesh_file import write_mesh
from framework.runs.metrics import doubled_metrics, instance_metrics, run_metrics, trajectory_metrics
from framework.runs.reproduction import causes
from framework.runs.run_directory import RunRecord, headline
from framework.runs.stored_runs import MAPPED, read_record
from framework.runtime.corrected_frames import TrackedFrame
from framework.runtime.run_log import FUSION, STAGES, RunResult
from tests.support import registered
from tests.support.scenes.corner_room import (
    CLASSES,
    CornerRoom,
    GivenPose,
    GridFuser,
    GridMap,
    KeepAll,
    LiveRoom,
    SphereDetector,
    pose_at,
)
from tests.support.scenes.given_changes import AS_TRACKED, CORRECTED, GRAPH, GivenChanges, RoomTracker, SubmapFuser

pytestmark = pytest.mark.integration

CONFIG = OmegaConf.create({"seed": 3, "debug": False, "fuser": {"voxel_size": 0.01, "seed": "${seed}"}})
CHOICES = {"dataset": "fake", "detector": "simulated"}

Run = Callable[..., RunResult]


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunRecord:
    """Begin a run directory. The overview image is a placeholder."""
    monkeypatch.setattr(run_directory, "write_overview", lambda path, *_: path.write_bytes(b"picture"))
    return RunRecord.begin(tmp_path / "run", CONFIG, CHOICES)


def mapped(room: CornerRoom, capacity: int = 100, **tracking: int) -> RunResult:
    return Pipeline(SphereDetector(), GivenPose(**tracking), KeepAll(), GridFuser(capacity)).run(room)


def metrics_of(record: RunRecord, name: str = "metrics.json") -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((record.directory / name).read_text())
    return metrics


def test_run_directory_contains_all_documented_files(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room))
    assert sorted(path.name for path in record.directory.iterdir()) == [
        "config.yaml",
        "digests.csv",
        "environment.txt",
        "instances.json",
        "manifest.json",
        "map.npz",
        "mesh.ply",
        "metrics.json",
        "overview.png",
        "timings.csv",
        "trajectory.txt",
    ]


def test_manifest_lists_all_result_files(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room))
    manifest = Manifest.read(record.directory)
    assert manifest.status is RunStatus.COMPLETE
    assert set(manifest.files) == {path.name for path in record.directory.iterdir()} - {"manifest.json"}
    assert manifest.changed_files(record.directory) == []


def test_digests_list_each_stage_of_each_frame(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room))
    rows = list(csv.DictReader((record.directory / "digests.csv").open()))
    assert [(row["frame"], row["stage"]) for row in rows[:5]] == [
        ("0", stage) for stage in ("tracking", "detection", "lifting", "refinement", "fusion")
    ]
    assert len(rows) == 6 * 5
    first = (record.directory / "digests.csv").read_bytes()
    record.write(room, mapped(room))
    assert (record.directory / "digests.csv").read_bytes() == first


def test_environment_lists_installed_packages(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room))
    lines = (record.directory / "environment.txt").read_text().splitlines()
    assert lines[0] == f"# Python {platform.python_version()}"
    assert f"numpy=={np.__version__}" in lines
    assert f"torch=={torch.__version__.partition('+')[0]}" in lines


def test_causes_contain_changed_packages_of_environment(
    record: RunRecord, room: CornerRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    record.write(room, mapped(room))
    run = read_record(record.directory)
    versions = {"numpy": "0.1", "torch": f"{torch.__version__.partition('+')[0]}+cu130"}
    monkeypatch.setattr(reproduction, "PACKAGES", tuple(versions))
    monkeypatch.setattr(reproduction, "package_version", versions.get)
    [cause] = causes(run)
    assert cause.startswith(f"numpy: expected version {np.__version__}, got 0.1; install with the constraints in ")


def test_metrics_contain_all_documented_keys(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room))
    metrics = metrics_of(record)
    assert set(metrics) >= {
        *("frames", "frames_lost", "frames_skipped", "fps", "fps_median", "map.voxels"),
        *("map.bytes", "peak_rss_bytes", "pose_source"),
        *(f"stage_ms.{stage}.{figure}" for stage in (*STAGES, FUSION) for figure in ("median", "p95")),
        *("instances.count", "instances.ap50", "instances.ap25", "instances.ap50.chair", "instances.ap50.couch"),
        *("instances.ap25.chair", "instances.ap.chair", "instances.true_count.chair", "annotation_release"),
        *("instances.ap50_agnostic", "instances.mean_iou", "trajectory.ate_rmse_m", "trajectory.rpe_rmse_m"),
        *(
            "seed",
            "detection_interval",
            "config_hash",
            "inputs_sha256",
            "git_commit",
            "environment.python",
            "environment.torch",
            "environment.cpus",
        ),
    }
    assert (metrics["frames"], metrics["instances.count"], metrics["instances.ap50"]) == (6, 2, 1.0)
    assert metrics["trajectory.ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert (metrics["seed"], metrics["choice.detector"], metrics["choice.fuser"]) == (3, "simulated", None)
    assert metrics["peak_rss_bytes"] > 2**24


def test_doubled_metrics_count_true_instances_of_two_objects(room: CornerRoom) -> None:
    result = mapped(room)
    mesh = result.scene.mesh()
    assert doubled_metrics(room, mesh, {1, 2}, result) == {"map.doubled_instances": 0}
    every_second = np.arange(len(mesh.vertices)) % 2 == 0
    divided = replace(mesh, instance_ids=np.where(every_second & (mesh.instance_ids == 1), 3, mesh.instance_ids))
    assert doubled_metrics(room, divided, {1, 2, 3}, result) == {"map.doubled_instances": 1}
    assert doubled_metrics(room, divided, {1, 2}, result) == {"map.doubled_instances": 0}


class _WithoutTruth(ChangedSequence):
    def __getitem__(self, k: int) -> Frame:
        return replace(self.sequence[k], truth=None)


def test_doubled_metrics_are_empty_without_true_instances(room: CornerRoom) -> None:
    result = mapped(room)
    assert doubled_metrics(_WithoutTruth(room), result.scene.mesh(), {1, 2}, result) == {}
    assert doubled_metrics(LiveRoom(), result.scene.mesh(), {1, 2}, result) == {}


@pytest.mark.parametrize(("annotation", "release"), [("second", "second"), ("", None)])
def test_instance_metrics_have_both_transfers_and_truth_release(
    room: CornerRoom, annotation: str, release: str
) -> None:
    scene = mapped(room).scene
    room.annotation = annotation
    no_poses = np.zeros(0), np.zeros((0, 4, 4))
    metrics = instance_metrics(room, scene.mesh(), scene.instances(), CLASSES, no_poses, ComparedClasses())
    predictions = PredictedInstances.of_map(scene.mesh(), scene.instances(), CLASSES)
    to_truth, to_map = (evaluate(predictions, room.scene_truth(), transfer=way).metrics() for way in Transfer)
    assert to_map["instances.mean_iou"] != to_truth["instances.mean_iou"]
    assert metrics.pop("annotation_release") == release
    assert metrics.pop("instances.count") == 2
    assert len(str(metrics.pop("truth_sha256"))) == 64
    for name in ("ap50", "ap25", "ap", "ap50_agnostic", "mean_iou"):
        assert metrics.pop(f"instances.to_map.{name}") == to_map[f"instances.{name}"]
    for name in ("label_space", "names", "of_file", "ignored_in_map", "ignored_in_ground_truth"):
        assert metrics.pop(f"evaluated_classes.{name}") is None
    assert metrics.pop("coverage.ground_truth") == 1.0
    assert metrics.pop("coverage.map") > 0.99
    assert metrics == to_truth


def test_run_directory_without_truth_has_no_evaluation(record: RunRecord, room: CornerRoom) -> None:
    result = mapped(room)
    untrue = [type(frame)(frame.index, frame.position, frame.timestamp, frame.pose, None) for frame in result.tracked]
    blind = RunResult(result.scene, 6, 0, tuple(untrue), result.timings, result.seconds)
    record.write(CornerRoom(truth=False), blind)
    metrics = metrics_of(record)
    assert metrics["pose_source"] == "tracked"
    assert not [key for key in metrics if key.startswith(("trajectory.", "instances.ap"))]


def test_run_directory_failed_write_leaves_partial_metrics(
    record: RunRecord, room: CornerRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(path: Path, *_: object) -> None:
        raise DataError(f"{path} could not be written: no space left on device")

    monkeypatch.setattr(run_directory, "write_overview", full_disk)
    assert "no space" in str(record.write(room, mapped(room)).error)
    assert not (record.directory / "metrics.json").exists()
    assert "no space" in metrics_of(record, "metrics.partial.json")["partial"]


def test_run_directory_with_unusable_truth_keeps_map_files(record: RunRecord, room: CornerRoom) -> None:
    def far_off() -> SceneTruth:
        raise DataError("ground truth: a point lies far off")

    result = mapped(room)
    room.scene_truth = far_off  # type: ignore[method-assign]
    assert str(record.write(room, result).error) == "ground truth: a point lies far off"
    left = {path.name for path in record.directory.iterdir()}
    assert left == {"config.yaml", "digests.csv", "environment.txt", "manifest.json", "metrics.partial.json", *MAPPED}
    assert Manifest.read(record.directory).status is RunStatus.PARTIAL
    metrics = metrics_of(record, "metrics.partial.json")
    assert metrics["partial"] == "ground truth: a point lies far off"
    assert (metrics["frames"], metrics["instances.count"], "instances.ap50" in metrics) == (6, 2, False)


@pytest.mark.parametrize("name", MAPPED)
def test_run_directory_blocked_file_keeps_other_files(record: RunRecord, room: CornerRoom, name: str) -> None:
    (record.directory / name).mkdir()
    fault = record.write(room, mapped(room)).error
    assert name in str(fault)
    assert {path.name for path in record.directory.iterdir() if path.is_file()} >= {*MAPPED} - {name}
    assert name in metrics_of(record, "metrics.partial.json")["partial"]


def test_run_directory_full_disk_keeps_map_and_trajectory(
    record: RunRecord, room: CornerRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full after the files that cannot be recomputed."""
    result = replace(mapped(room), keyframes={"poses": np.zeros((1, 4, 4))})
    replace_file, renamed = Path.replace, list[str]()

    def full_after_six(path: Path, target: Path) -> Path:
        if len(renamed) == 6:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        renamed.append(target.name)
        return replace_file(path, target)

    monkeypatch.setattr(Path, "replace", full_after_six)
    assert "No space left" in str(record.write(room, result).error)
    kept = ["trajectory.txt", "timings.csv", "digests.csv", "metrics.partial.json", "map.npz", "keyframes.npz"]
    assert renamed == kept
    assert {path.name for path in record.directory.iterdir()} >= {"config.yaml", *kept}


def test_run_directory_unreadable_poses_keep_map(record: RunRecord, room: CornerRoom) -> None:
    class Unreadable(list[TrackedFrame]):
        def __iter__(self) -> Iterator[TrackedFrame]:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    assert "Input/output error" in str(record.write(room, replace(mapped(room), tracked=Unreadable())).error)
    assert {path.name for path in record.directory.iterdir()} >= {"map.npz", "mesh.ply", "instances.json"}
    assert not (record.directory / "trajectory.txt").exists()


def test_run_directory_removed_during_run_is_recreated(record: RunRecord, room: CornerRoom) -> None:
    config = (record.directory / "config.yaml").read_bytes()
    shutil.rmtree(record.directory)
    assert record.write(room, mapped(room)).error is None
    assert (record.directory / "config.yaml").read_bytes() == config
    assert read_record(record.directory).metrics["frames"] == 6


def test_rpe_ignores_steps_over_skipped_frames(room: CornerRoom) -> None:
    """The drift is 1 cm per frame. Because frame 2 is skipped, one step has a drift of 2 cm."""
    true = np.eye(4)
    tracked = []
    for position in (0, 1, 3, 4):
        drifted = np.eye(4)
        drifted[0, 3] = 0.01 * position
        tracked.append(TrackedFrame(10 * position, position, 0.1 * position, Pose(drifted), true))
    result = mapped(room)
    metrics = trajectory_metrics(RunResult(result.scene, 5, 1, tuple(tracked), (), 1.0))
    assert metrics["trajectory.rpe_rmse_m"] == pytest.approx(0.01)


def test_run_directory_of_corrected_run_has_both_trajectories(record: RunRecord, room: CornerRoom) -> None:
    corrected = Pipeline(SphereDetector(), RoomTracker(), KeepAll(), SubmapFuser(), backend=GivenChanges()).run(room)
    record.write(room, corrected)
    for name, T_world_room in (("trajectory.txt", CORRECTED), ("trajectory_tracked.txt", AS_TRACKED)):
        _, poses = read_tum(record.directory / name)
        np.testing.assert_allclose(poses, [T @ pose_at(k) for k, T in enumerate(T_world_room)], atol=1e-8)
    metrics = metrics_of(record)
    assert metrics["trajectory.ate_rmse_m"] == trajectory_metrics(corrected)["trajectory.ate_rmse_m"]
    tracked = trajectory_metrics(replace(corrected, tracked=corrected.as_tracked))["trajectory.ate_rmse_m"]
    assert metrics["trajectory.tracked_ate_rmse_m"] == tracked
    assert tracked != metrics["trajectory.ate_rmse_m"]
    assert {"trajectory_tracked.txt", "pose_graph.json"} <= {*Manifest.read(record.directory).files}
    graph = read_pose_graph(record.directory / "pose_graph.json")
    assert graph is not None
    assert graph.loops == GRAPH.loops
    record.write(room, mapped(room))  # without a back end
    assert not (record.directory / "trajectory_tracked.txt").exists()
    assert not (record.directory / "pose_graph.json").exists()
    assert "trajectory.tracked_ate_rmse_m" not in metrics_of(record)


def test_run_directory_of_stopped_run_has_partial_metrics(record: RunRecord, room: CornerRoom) -> None:
    result = mapped(room, capacity=2)
    assert isinstance(result.stopped_by, MapFullError)
    record.write(room, result)
    assert not (record.directory / "metrics.json").exists()
    metrics = metrics_of(record, "metrics.partial.json")
    assert metrics["partial"] == "fuser.capacity: expected at most 2 frames, got more; increase fuser.capacity"
    assert metrics["frames"] == 3


def test_run_directory_begin_removes_old_metrics(record: RunRecord) -> None:
    for name in ("metrics.json", "metrics.partial.json"):
        (record.directory / name).write_text("{}")
    (record.directory / ".staged").mkdir()
    RunRecord.begin(record.directory, CONFIG, CHOICES)
    assert [path.name for path in record.directory.iterdir()] == ["config.yaml"]


def test_run_directory_begin_replaces_linked_config(record: RunRecord, tmp_path: Path) -> None:
    """The run directory may be a copy of another run with links to its files."""
    (tmp_path / "other.yaml").write_text("seed: 1\n")
    (record.directory / "config.yaml").unlink()
    (record.directory / "config.yaml").symlink_to(tmp_path / "other.yaml")
    RunRecord.begin(record.directory, CONFIG, CHOICES)
    assert (tmp_path / "other.yaml").read_text() == "seed: 1\n"


def test_run_directory_config_is_resolved(record: RunRecord) -> None:
    assert OmegaConf.load(record.directory / "config.yaml").fuser.seed == 3
    assert "${" not in (record.directory / "config.yaml").read_text()


def test_run_directory_mesh_file_matches_map_mesh(record: RunRecord, room: CornerRoom) -> None:
    result = mapped(room)
    record.write(room, result)
    assert_same(read_ply(record.directory / "mesh.ply"), result.scene.mesh())


def test_write_mesh_accepts_empty_mesh(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", GridMap().mesh())
    assert len(read_ply(tmp_path / "mesh.ply").vertices) == 0


def test_mesh_file_is_readable_by_open3d(tmp_path: Path) -> None:
    import open3d as o3d

    mesh = mapped(CornerRoom(frames=1)).scene.mesh()
    write_mesh(tmp_path / "mesh.ply", mesh)
    read = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_array_equal(np.asarray(read.vertices).astype(np.float32), mesh.vertices)
    np.testing.assert_array_equal(np.asarray(read.triangles), mesh.triangles)
    np.testing.assert_allclose(np.asarray(read.vertex_colors) * 255, mesh.colors, atol=1e-3)


def test_run_directory_instances_have_class_and_geometry(record: RunRecord, room: CornerRoom) -> None:
    result = mapped(room)
    record.write(room, result)
    first, second = json.loads((record.directory / "instances.json").read_text())
    assert (first["id"], first["class"], second["id"], second["class"]) == (1, "chair", 2, "couch")
    assert first["class_probabilities"] == {"chair": 0.9, "couch": 0.1}
    assert first["observations"] == 6
    mesh = result.scene.mesh()
    points = mesh.vertices[mesh.instance_ids == 1]
    assert first["vertices"] == len(points)
    np.testing.assert_allclose(first["centroid"], points.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(first["aabb"]["min"], points.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(first["aabb"]["max"], points.max(axis=0), atol=1e-6)
    assert set(first["obb"]) == {"center", "extent", "rotation"}


def test_write_instances_without_instances_is_empty_list(tmp_path: Path) -> None:
    write_instances(tmp_path / "instances.json", GridMap().mesh(), {}, CLASSES)
    assert json.loads((tmp_path / "instances.json").read_text()) == []


def test_trajectory_file_omits_lost_frames(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room, lost_from=1, lost_to=3))
    timestamps, poses = read_tum(record.directory / "trajectory.txt")
    np.testing.assert_allclose(timestamps * 30, [0, 3, 4, 5], atol=1e-6)
    np.testing.assert_allclose(poses[1], pose_at(3), atol=1e-8)
    assert metrics_of(record)["frames_lost"] == 2


def test_run_directory_with_one_tracked_frame_is_written(record: RunRecord, room: CornerRoom) -> None:
    record.write(room, mapped(room, lost_from=1, lost_to=6))
    assert (metrics_of(record)["frames_lost"], metrics_of(record)["trajectory.ate_rmse_m"]) == (5, 0.0)


def test_timings_csv_matches_stage_metrics(record: RunRecord, room: CornerRoom) -> None:
    result = mapped(room)
    record.write(room, result)
    with (record.directory / "timings.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.timings) == 6 * 7
    assert set(rows[0]) == {"frame", "stage", "milliseconds"}
    fuse = [float(row["milliseconds"]) for row in rows if row["stage"] == "fusion"]
    assert metrics_of(record)["stage_ms.fusion.median"] == pytest.approx(np.median(fuse), abs=1e-3)
    assert metrics_of(record)["stage_ms.fusion.p95"] == pytest.approx(np.percentile(fuse, 95), abs=1e-3)


def test_pose_source_comes_from_tracker(room: CornerRoom) -> None:
    """Tracked poses may be lost or equal to the true poses."""
    one_frame = CornerRoom(frames=1)
    given = [mapped(room), mapped(room, lost_from=1, lost_to=99), mapped(one_frame)]
    assert [run_metrics(result)["pose_source"] for result in given] == ["ground_truth"] * 3

    class Tracks(GivenPose):
        pose_source = "tracked"

    for sequence, lost_to in ((room, 0), (room, 99), (one_frame, 0)):
        tracker = Tracks(lost_from=1, lost_to=lost_to)
        result = Pipeline(SphereDetector(), tracker, KeepAll(), GridFuser()).run(sequence)
        assert run_metrics(result)["pose_source"] == "tracked"


@pytest.mark.parametrize("tracker", registered.names("tracker"))
def test_tracker_pose_source_is_tracked_except_ground_truth(tracker: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    needs = [f"tracker.path={tmp_path / 'poses.txt'}"] if tracker == "trajectory_file" else []
    source = registered.built("tracker", tracker, *needs).pose_source
    assert source == ("ground_truth" if tracker == "ground_truth" else "tracked")


def test_headline_contains_key_metrics() -> None:
    metrics = {"sequence": "room0", "frames": 9, "fps": 3.21, "frames_lost": 2, "frames_skipped": 0}
    metrics |= {"instances.count": 4, "trajectory.ate_rmse_m": 0.0123, "instances.ap50": 0.5, "instances.ap25": None}
    expected = headline(metrics | {"pose_source": "tracked"})
    assert expected == "room0 | 9 frames at 3.2/s | 2 lost | ATE 0.012 m | 4 instances | AP50 0.50"
    expected = headline(metrics | {"pose_source": "ground_truth"})
    assert expected == "room0 | 9 frames at 3.2/s | 2 lost | given poses | 4 instances | AP50 0.50"


def test_overview_does_not_depend_on_speed(tmp_path: Path, room: CornerRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    titles: list[str] = []
    monkeypatch.setattr(run_directory, "write_overview", lambda *arguments: titles.append(arguments[-1]))
    result = mapped(room)
    for seconds in (1.0, 9.0):
        RunRecord.begin(tmp_path / f"run_{seconds}", CONFIG, CHOICES).write(room, replace(result, seconds=seconds))
    assert titles == 2 * [titles[0]]
    assert titles[0].startswith(f"{room.name} | 6 frames | ")


# Provenance


def test_config_hash_ignores_settings_without_effect() -> None:
    config = {"seed": 0, "fuser": {"voxel_size": 0.01, "block_limit": 9}}
    same = {
        "debug": True,
        "prefetch": 0,
        "hydra": {"run": {"dir": "/x"}},
        "fuser": {"block_limit": 9, "voxel_size": 0.01},
    }
    assert provenance.config_hash(config) == provenance.config_hash(config | same)
    assert provenance.config_hash(config) != provenance.config_hash(config | {"seed": 1})
    assert len(provenance.config_hash(config)) == 64


def test_code_version_reports_checkout_commit_and_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "framework"
    package.mkdir()
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(provenance.framework, "__file__", str(package / "__init__.py"))
    assert provenance.code_version() == {"git_commit": "unknown", "git_dirty": "unknown"}

    who = {"GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@b", "GIT_COMMITTER_NAME": "a", "GIT_COMMITTER_EMAIL": "a@b"}
    for command in ("init -q", "add .", "commit -q -m first"):
        subprocess.run(["git", "-C", tmp_path, *command.split()], check=True, env=os.environ | who)
    clean = provenance.code_version()
    assert len(str(clean["git_commit"])) == 40
    assert clean["git_dirty"] is False
    (package / "__init__.py").write_text("changed = 1\n")
    assert provenance.code_version() == {**clean, "git_dirty": True}


def test_code_version_of_installed_package_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subprocess.run(["git", "-C", tmp_path, "init", "-q"], check=True)
    installed = tmp_path / "venv" / "site-packages" / "framework"
    installed.mkdir(parents=True)
    monkeypatch.setattr(provenance.framework, "__file__", str(installed / "__init__.py"))
    assert provenance.code_version()["git_commit"] == "unknown"


def read_ply(path: Path) -> InstanceMesh:
    """Return the mesh of a PLY file. Counts and types are read from the header."""
    content = path.read_bytes()
    header, _, body = content.partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    types = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    counts = {words[1]: int(words[2]) for words in map(str.split, lines) if words[0] == "element"}
    scalars = [words for words in map(str.split, lines) if words[0] == "property" and words[1] != "list"]
    vertex = np.dtype([(words[2], types[words[1]]) for words in scalars])
    assert vertex.names == ("x", "y", "z", "red", "green", "blue", "instance", "class")
    face = np.dtype([("n", "u1"), ("corners", "<i4", (3,))])
    assert "property list uchar int vertex_indices" in lines
    assert len(body) == counts["vertex"] * vertex.itemsize + counts["face"] * face.itemsize
    vertices = np.frombuffer(body, vertex, counts["vertex"])
    faces = np.frombuffer(body, face, counts["face"], counts["vertex"] * vertex.itemsize)
    assert (faces["n"] == 3).all()
    [classes] = [line.removeprefix("comment classes ") for line in lines if line.startswith("comment classes ")]
    return InstanceMesh(
        vertices=np.stack([vertices[axis] for axis in "xyz"], axis=1),
        triangles=faces["corners"].astype(np.int32),
        colors=np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=1),
        instance_ids=vertices["instance"].astype(np.int32),
        class_ids=vertices["class"].astype(np.int32),
        classes=tuple(classes.split(",")),
    )


def assert_same(a: InstanceMesh, b: InstanceMesh) -> None:
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.classes == b.classes
