"""Tests for the run directories of merged maps."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

import instancemap
from framework.commands.results.evaluate import evaluate_runs
from framework.commands.running.run import run as run_pipeline
from framework.data import Float64
from framework.editing.merged_run import MergedRun
from framework.errors import DataError
from framework.evaluation.instances import Transfer
from framework.files.manifest import Manifest, RunStatus
from framework.files.tum_trajectory import read_tum
from framework.geometry import exp_se3, transform
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Association
from framework.registry import assemble
from framework.runs.instances_file import read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_runs import completed_runs, read_record
from framework.runs.world_frames import in_world, known_transform
from framework.testing.corner_room import pose_at
from framework.tracking.keyframes import SAVED, write_keyframes
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support import reported_run
from tests.support.scenes.corner_room import GivenPose

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]

POINT = np.array([[0.5, 0.1, 2.0]], np.float32)


def add_keyframe(run: Path) -> None:
    """Add a keyframe at the first pose to a run."""
    values = {"poses": pose_at(0)[None], "counts": [1], "points_world": POINT, "descriptors": np.full((1, 128), 45)}
    write_keyframes(run / "keyframes.npz", {name: np.array(values[name], kind) for name, (_, kind) in SAVED.items()})
    Manifest.read(run).with_files(run, ["keyframes.npz"]).write(run)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return two runs with given poses and four frames each, two of which are common."""
    folder = tmp_path_factory.mktemp("runs")
    for name, start, stop in (("a", 0, 4), ("b", 2, 6)):
        add_keyframe(reported_run.write_run(folder / name, start=start, stop=stop))
    return folder / "a", folder / "b"


@pytest.fixture(scope="module")
def merged(runs: tuple[Path, Path]) -> Path:
    out = runs[0].parent / "merged"
    MergedRun.of(*runs).write(out)
    return out


def test_merged_run_is_complete(runs: tuple[Path, Path], merged: Path) -> None:
    manifest = Manifest.read(merged)
    assert manifest.status is RunStatus.COMPLETE
    assert not manifest.changed_files(merged)
    assert set(manifest.files) == {
        *("config.yaml", "metrics.json", "trajectory.txt", "map.npz", "keyframes.npz"),
        *("instances.json", "mesh.ply", "overview.png"),
    }
    assert (merged / "config.yaml").read_bytes() == (runs[0] / "config.yaml").read_bytes()


def test_merged_instances_have_ids_and_observations_of_both_runs(runs: tuple[Path, Path], merged: Path) -> None:
    a, b, found = (read_instances(run / "instances.json") for run in (*runs, merged))
    assert [(one.id, one.class_name) for one in found] == [(one.id, one.class_name) for one in a]
    assert [one.observations for one in found] == [x.observations + y.observations for x, y in zip(a, b, strict=True)]
    assert set(np.unique(read_mesh(merged / "mesh.ply").instance_ids).tolist()) == {0, 1, 2}


def test_merged_trajectory_has_both_runs_in_ascending_order(runs: tuple[Path, Path], merged: Path) -> None:
    times, poses = read_tum(merged / "trajectory.txt")
    assert (np.diff(times) > 0).all()
    parts = [read_tum(run / "trajectory.txt") for run in runs]
    np.testing.assert_allclose(poses, np.concatenate([part[1] for part in parts]), atol=1e-12)
    np.testing.assert_array_equal(times[:4], parts[0][0])
    np.testing.assert_allclose(np.diff(times[4:]), np.diff(parts[1][0]))


def test_merged_metrics_count_both_runs(runs: tuple[Path, Path], merged: Path) -> None:
    metrics = read_record(merged).metrics
    assert (metrics["frames"], metrics["instances.count"], metrics["merged_from_poses"]) == (8, 2, 4)
    assert (metrics["merged_from"], metrics["merged_with"]) == (str(runs[0]), str(runs[1]))
    assert not [key for key in metrics if key.startswith(("trajectory.", "stage_ms.", "fps", "instances.ap"))]


def test_merged_run_is_evaluated_in_world_of_first_run(merged: Path) -> None:
    assert evaluate_runs([merged], Transfer.TO_TRUTH, write=True) == 0
    assert read_record(merged).metrics["instances.ap50"] == 1.0


def test_merged_run_is_reported_exported_and_resumed(
    merged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = instancemap.report(merged, tmp_path / "report.html").read_text()
    assert "the map was merged from the frames of several runs" in page
    assert instancemap.export(merged, "glb", out=tmp_path / "exported")
    assert instancemap.query(merged, "chair").objects
    monkeypatch.setattr(GivenPose, "load_keyframes", lambda *_: None)
    run_pipeline(OmegaConf.create(reported_run.CONFIG | {"resume_from": str(merged)}), tmp_path / "resumed", {})
    before, after = (read_instances(run / "instances.json") for run in (merged, tmp_path / "resumed"))
    assert [(one.id, one.observations + 6) for one in before] == [(one.id, one.observations) for one in after]


@pytest.fixture
def shifted(runs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> Float64:
    """Return T_a_b of the runs, if their world frames are unknown."""
    T: Float64 = exp_se3(np.array([0.3, -0.2, 0.1, 0.02, 0.3, -0.1]))
    monkeypatch.setattr("framework.editing.merged_run.known_transform", lambda *_: None)
    monkeypatch.setattr("framework.editing.merged_run.align_maps", lambda *_: T)
    return T


def test_merged_run_moves_poses_keyframes_and_surface(runs: tuple[Path, Path], shifted: Float64) -> None:
    merged = MergedRun.of(*runs)
    np.testing.assert_allclose(merged.poses[4:], shifted @ read_tum(runs[1] / "trajectory.txt")[1], atol=1e-12)
    np.testing.assert_allclose(merged.keyframes["poses"], np.stack([pose_at(0), shifted @ pose_at(0)]))
    np.testing.assert_allclose(merged.keyframes["points_world"], [POINT[0], transform(shifted, POINT)[0]], atol=1e-6)
    assert merged.keyframes["counts"].tolist() == [1, 1]
    assert merged.shared == 0


def test_merge_of_same_or_contained_map_raises(runs: tuple[Path, Path], merged: Path) -> None:
    for one, other in ((runs[0], runs[0]), (merged, runs[0]), (runs[1], merged)):
        with pytest.raises(
            DataError, match=r"expected a map of other frames, got a map that contains .*; use it as it is"
        ):
            MergedRun.of(one, other)


def changed_copy(run: Path, copy: Path, name: str, change: Callable[[Path], object]) -> Path:
    """Copy a run, and change one of its files and the manifest."""
    shutil.copytree(run, copy)
    change(copy / name)
    Manifest.read(copy).with_files(copy, [name]).write(copy)
    return copy


def test_merge_of_edited_run_raises(runs: tuple[Path, Path], tmp_path: Path) -> None:
    def edit(metrics: Path) -> None:
        metrics.write_text(json.dumps(json.loads(metrics.read_text()) | {"edited_from": "demo"}))

    edited = changed_copy(runs[1], tmp_path / "edited", "metrics.json", edit)
    with pytest.raises(DataError, match=r"edited: expected an unedited map, got an edited map of demo; merge first"):
        MergedRun.of(runs[0], edited)


def test_merge_with_other_voxel_size_raises(runs: tuple[Path, Path], tmp_path: Path) -> None:
    other = changed_copy(runs[1], tmp_path / "run", "map.npz", assemble(BayesianTsdf, voxel_size=0.04).scene.save)
    with pytest.raises(DataError, match=r"run: fuser.voxel_size: expected 0.03 \(as in the first map\), got 0.04"):
        MergedRun.of(runs[0], other)


def test_merge_of_different_scenes_with_given_poses_raises(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """The world frames of given poses may be those of different buildings."""

    def move(file: Path) -> None:
        fuser = assemble(BayesianTsdf, voxel_size=0.03)
        fuser.scene.absorb(InstanceMap.load(file), exp_se3(np.array([0.0, 0.0, -0.3, 0.0, 0.2, 0.0])), Association())
        fuser.scene.save(file)

    other = changed_copy(runs[1], tmp_path / "run", "map.npz", move)
    with pytest.raises(DataError, match=r"run: expected surfaces that agree .*; map it again with localize_in="):
        MergedRun.of(runs[0], other)


def test_completed_runs_omit_merged_runs(runs: tuple[Path, Path], merged: Path) -> None:
    records, others = completed_runs(merged.parent)
    assert [one.directory for one in records] == list(runs)
    assert [one.reason for one in others] == [f"merged map of {runs[0]} and {runs[1]}"]


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ({"pose_source": "ground_truth"}, {"pose_source": "ground_truth", "map.origin.x": 1000.0}, (1000.0, 0.0, 0.0)),
        ({"pose_source": "tracked"}, {"pose_source": "tracked"}, None),
        ({"pose_source": "tracked"}, {"pose_source": "tracked", "merged_from": "a"}, (0.0, 0.0, 0.0)),
    ],
)
def test_known_transform_follows_from_world_frames(
    a: dict[str, object], b: dict[str, object], expected: tuple[float, ...] | None, tmp_path: Path
) -> None:
    if "merged_from" in b:
        b["merged_from"] = str(tmp_path / "a")
    for name, metrics in (("a", a), ("b", b)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text(json.dumps(metrics))
    T_a_b = known_transform(tmp_path / "a", tmp_path / "b")
    assert (None if T_a_b is None else tuple(T_a_b[:3, 3].tolist())) == expected
    assert in_world(tmp_path / "b", tmp_path / "a") == (expected is not None)
