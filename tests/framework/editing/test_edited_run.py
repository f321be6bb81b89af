"""Tests for the run directories of edited maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image

import instancemap
from framework.commands.results.reproduce import reproduce_all
from framework.commands.running.run import run as run_pipeline
from framework.config import composition
from framework.datasets.ground_truth.named_truth import read_named_truth
from framework.editing import edited_run
from framework.editing.edited_run import EditedRun
from framework.editing.edits import read_edits
from framework.errors import ConfigError, DataError
from framework.files.hashing import path_hash
from framework.files.manifest import Manifest, RunStatus
from framework.mapping.instance_map import InstanceMap
from framework.registry import assemble
from framework.runs.instances_file import read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_runs import completed_runs, read_record
from framework.runs.world_frames import in_world
from framework.testing.corner_room import exact_clusters, frame_at, pose_at
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support import reported_run
from tests.support.scenes.corner_room import GivenPose
from tests.support.small_overviews import use_small_overviews

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered", "small_overviews")]

EDITS = [{"delete": [1]}, {"rename": [2, "chair"]}]
CHANGED = {"instances.json", "mesh.ply", "map.npz", "overview.png", "metrics.json"}


def write_run_of(config: dict[str, Any], directory: Path) -> None:
    run_pipeline(OmegaConf.create(config), directory, {})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reported_run.write_run(tmp_path_factory.mktemp("runs") / "room")


@pytest.fixture(scope="module")
def edited(run: Path) -> Path:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [reported_run.FAKES])
        use_small_overviews(patched)
        return instancemap.edit(run, EDITS)


def test_edit_writes_complete_run_next_to_stored_run(run: Path, edited: Path) -> None:
    assert edited == run.parent / "room_edited"
    old, new = Manifest.read(run), Manifest.read(edited)
    assert new.status is RunStatus.COMPLETE
    assert not new.changed_files(edited)
    assert not old.changed_files(run)
    assert new.files.keys() == old.files.keys() | {"edits.json"}
    assert {name for name in old.files if new.files[name] != old.files[name]} == CHANGED
    assert (new.inputs, new.parameters) == (old.inputs, old.parameters)
    assert json.loads((edited / "edits.json").read_text()) == EDITS


def test_edited_run_files_agree(edited: Path) -> None:
    [stored] = read_instances(edited / "instances.json")
    assert (stored.id, stored.class_name, stored.probability) == (2, "chair", 1.0)
    scene = instancemap.load_map(edited / "map.npz")
    assert [one.id for one in scene.instances("chair").values()] == [2]
    ids = scene.mesh().instance_ids
    assert set(np.unique(ids).tolist()) == {0, 2}
    assert np.count_nonzero(ids) == stored.vertices
    with Image.open(edited / "edits.png") as before_and_after, Image.open(edited / "overview.png") as overview:
        assert before_and_after.width == overview.width


def test_edited_run_metrics_are_evaluated_again(run: Path, edited: Path) -> None:
    """The ground truth of the corner room contains the deleted chair and the renamed couch."""
    before, after = read_record(run).metrics, read_record(edited).metrics
    assert (before["instances.ap50"], before["instances.ap50_agnostic"]) == (1.0, 1.0)
    assert (after["instances.ap50"], after["instances.ap50_agnostic"]) == (0.0, 0.5)
    assert (after["instances.count"], after["edited_from"]) == (1, str(run))
    assert after["fps"] == before["fps"]


def test_edited_run_metrics_are_omitted_without_dataset(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The dataset cannot be built if the fake stages are not registered."""
    monkeypatch.setattr(composition, "_added", [])
    instancemap.edit(run, EDITS, tmp_path / "out")
    metrics = read_record(tmp_path / "out").metrics
    assert [key for key in metrics if key.startswith("instances.")] == ["instances.count"]
    assert "instances are not evaluated: dataset: expected " in caplog.text


def test_edited_run_is_ground_truth(edited: Path) -> None:
    truth = read_named_truth(edited)
    assert truth.mesh.class_names == {2: "chair"}
    assert set(np.unique(truth.mesh.instance_ids).tolist()) == {0, 2}
    assert truth.trajectory is not None
    assert truth.trajectory.given


def test_edits_file_of_edited_run_repeats_edits(run: Path, edited: Path, tmp_path: Path) -> None:
    again = instancemap.edit(run, edited / "edits.json", tmp_path / "again")
    for name in ("mesh.ply", "instances.json", "map.npz"):
        assert path_hash(again / name) == path_hash(edited / name)


def test_edited_run_can_be_edited(edited: Path, tmp_path: Path) -> None:
    again = instancemap.edit(edited, [{"rename": [2, "couch"]}], tmp_path / "again")
    assert read_record(again).metrics["edited_from"] == str(edited)
    assert [one.class_name for one in read_instances(again / "instances.json")] == ["couch"]
    assert not Manifest.read(again).changed_files(again)


def test_edited_map_can_be_resumed(edited: Path) -> None:
    """The renamed couch keeps its class, and the deleted chair is found again as a new instance."""
    fuser = assemble(BayesianTsdf, **{k: v for k, v in reported_run.CONFIG["fuser"].items() if k != "_target_"})
    fuser.resume(InstanceMap.load(edited / "map.npz"))
    for k in range(4):
        frame = frame_at(k)
        fuser.fuse(frame, instancemap.Pose(pose_at(k)), exact_clusters(frame))
    classes = {k: one.class_probabilities.tolist() for k, one in fuser.scene.instances().items()}
    assert classes.pop(2) == [1.0, 0.0]
    assert len(classes) == 1


@pytest.fixture
def relocalized(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracker with given poses resumes maps."""
    monkeypatch.setattr(GivenPose, "load_keyframes", lambda *_: None)


@pytest.mark.usefixtures("relocalized")
def test_map_with_new_class_can_be_resumed(run: Path, tmp_path: Path) -> None:
    """The detector lacks the new class. The instance keeps it, and other instances keep theirs."""
    edited = instancemap.edit(run, [{"rename": [2, "forklift"]}], tmp_path / "edited")
    stored = {one.id: one for one in read_instances(edited / "instances.json")}
    assert (stored[2].class_name, stored[1].class_probabilities["forklift"]) == ("forklift", 0.0)
    assert read_mesh(edited / "mesh.ply").classes == ("chair", "couch", "forklift")
    write_run_of(reported_run.CONFIG | {"resume_from": str(edited)}, tmp_path / "resumed")
    resumed = {one.id: one for one in read_instances(tmp_path / "resumed" / "instances.json")}
    assert [one.class_name for one in resumed.values()] == ["chair", "forklift"]
    assert resumed[2].observations > stored[2].observations


@pytest.mark.usefixtures("relocalized")
def test_resume_with_other_detector_fails_before_the_run(run: Path, tmp_path: Path) -> None:
    detector = {"_target_": "plugins.detectors.none.NoDetections"}
    config = reported_run.CONFIG | {"resume_from": str(run), "detector": detector}
    with pytest.raises(ConfigError, match=r"detector: expected the 2 classes of the stored map, got other classes"):
        write_run_of(config, tmp_path / "resumed")
    assert not (tmp_path / "resumed").exists()


def test_completed_runs_omit_edited_runs(run: Path, edited: Path) -> None:
    """Corrected maps must not replace the results of their runs in tables."""
    records, others = completed_runs(run.parent)
    assert [one.directory for one in records] == [run]
    assert [(one.directory, one.reason) for one in others] == [(edited, f"edited map of {run}")]
    with pytest.raises(DataError, match=r"expected a completed run, got none \(room_edited: edited map of"):
        reproduce_all(edited, [], None, None)


def test_diff_of_edited_run_has_same_world_frame(tmp_path: Path) -> None:
    for name, source in (("run", {}), ("edited", {"edited_from": str(tmp_path / "run")})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text(json.dumps({"pose_source": "tracked", **source}))
    assert in_world(tmp_path / "edited", tmp_path / "run")
    assert not in_world(tmp_path / "run", tmp_path / "edited")


def test_edit_of_changed_run_raises_data_error(tmp_path: Path) -> None:
    reported_run.write_run(tmp_path / "run")
    reported_run.rename_class(tmp_path / "run", "sphere")
    with pytest.raises(DataError, match=r"instances.json: expected the SHA-256 .*; repeat the run"):
        EditedRun.of(tmp_path / "run", [])


def test_edit_error_names_the_edit(run: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r'^edit 2, {"rename": \[1, "chair"\]}: expected an instance out of 2, got 1'):
        instancemap.edit(run, [{"delete": [1]}, {"rename": [1, "chair"]}], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_edit_of_map_without_voxel_labels_raises_data_error(tmp_path: Path) -> None:
    config = reported_run.CONFIG | {"fuser": {"_target_": "plugins.fusers.object_volumes.ObjectVolumes"}}
    write_run_of(config, tmp_path / "run")
    with pytest.raises(DataError, match=r"map.npz: expected map format \d+, got .*; map with a fuser that stores"):
        EditedRun.of(tmp_path / "run", [])


def test_edit_into_existing_run_raises_config_error(run: Path, edited: Path) -> None:
    with pytest.raises(DataError, match="expected a new or empty folder, got"):
        instancemap.edit(run, EDITS, edited)
    assert read_edits(edited / "edits.json")


def test_interrupted_edit_leaves_no_files_and_can_be_repeated(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "edited"
    out.mkdir()
    (out / ".staged").mkdir()  # of a killed process
    with monkeypatch.context() as patched:
        patched.setattr(edited_run, "write_overview", lambda path, *_: read_record(path))
        with pytest.raises(DataError):
            instancemap.edit(run, EDITS, out)
    assert list(out.iterdir()) == []
    instancemap.edit(run, EDITS, out)
    assert not Manifest.read(out).changed_files(out)
