"""Tests for the command `import-map`, and for imported maps in the other commands."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import numpy as np
import pytest

import instancemap
from framework.api import load_runs
from framework.commands.results import diff, evaluate, export, import_map, query, reproduce
from framework.commands.results.report import write_reports
from framework.config import composition
from framework.files.manifest import Manifest
from framework.files.ply import read_ply, write_ply
from framework.runs import instances_file
from framework.runs.external_maps import imported_run
from framework.runs.instances_file import read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_runs import read_record
from framework.tables.experiment_tables import write_tables
from tests.support.command_call import call_command
from tests.support.reported_run import FAKES, write_run

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]

DATASET = ("dataset=fake", "dataset.frames=6")
NYU40 = {"chair": 5, "couch": 6}
NOT_WRITTEN = ("timings.csv", "trajectory.txt", "map.npz", "digests.csv", "environment.txt")


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a run with ground-truth poses."""
    return write_run(tmp_path_factory.mktemp("runs") / "ours")


@pytest.fixture
def folder(mapped: Path, tmp_path: Path) -> Path:
    """Return a folder with a copy of the run."""
    shutil.copytree(mapped, tmp_path / "runs" / "ours")
    return tmp_path / "runs"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs a command in this process and returns the status, stdout and stderr."""

    def start(module: ModuleType, *arguments: object) -> tuple[int, str, str]:
        return call_command(module, arguments, monkeypatch, capsys)

    return start


def metrics_of(directory: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((directory / "metrics.json").read_text())
    return metrics


def scores(directory: Path) -> dict[str, float]:
    """Return the metrics of the instances, without calibration, because imported maps have no probabilities."""
    calibrated = (
        "instances.likely.",
        "instances.ece.",
        "instances.brier.",
        "instances.auroc.",
        "instances.calibration_count.",
    )
    metrics = metrics_of(directory)
    return {key: metrics[key] for key in metrics if key.startswith("instances.") and not key.startswith(calibrated)}


def external_ply(run: Path, path: Path) -> Path:
    """Write the mesh of a run as another system does: other property names, NYU40 classes, and a wall."""
    mesh = read_mesh(run / "mesh.ply")
    classes = np.array([NYU40[name] for name in mesh.classes])[mesh.class_ids]
    labels = np.where(mesh.instance_ids > 0, classes, 1)
    ids = np.where(mesh.instance_ids > 0, mesh.instance_ids, 99)
    properties = {"objectId": ids.astype(np.int32), "label": labels.astype(np.int32)}
    write_ply(path, mesh.vertices, mesh.triangles, properties)
    return path


def scannet_predictions(run: Path, folder: Path) -> Path:
    mesh = read_mesh(run / "mesh.ply")
    (folder / "predicted_masks").mkdir(parents=True)
    lines = []
    for one in read_instances(run / "instances.json"):
        name = f"predicted_masks/{one.id:03d}.txt"
        np.savetxt(folder / name, mesh.instance_ids == one.id, "%d")
        lines.append(f"{name} {NYU40[one.class_name]} {one.confidence}\n")
    (folder / "mesh.txt").write_text("".join(lines))
    return folder


def mask_folder(run: Path, folder: Path) -> Path:
    folder.mkdir()
    mesh, entries = read_mesh(run / "mesh.ply"), []
    for one in read_instances(run / "instances.json"):
        np.save(folder / f"{one.id}.npy", np.flatnonzero(mesh.instance_ids == one.id))
        entries.append({"mask": f"{one.id}.npy", "class": one.class_name, "confidence": one.confidence})
    np.save(folder / "points.npy", mesh.vertices)
    (folder / "instances.json").write_text(json.dumps(entries))
    return folder


@pytest.mark.parametrize("form", ["labels", "header", "properties", "scannet", "masks", "points"])
def test_imported_map_has_scores_of_the_run(form: str, folder: Path, tmp_path: Path, command) -> None:
    ours, other = folder / "ours", folder / "other"
    mesh = ours / "mesh.ply"
    if form == "labels":
        words = [mesh, other, "--labels", ours / "instances.json"]
    elif form == "header":
        words = [mesh, other]
    elif form == "properties":
        words = [external_ply(ours, tmp_path / "other.ply"), other, "--label-space", "nyu40"]
    elif form == "scannet":
        words = [mesh, other, "--labels", scannet_predictions(ours, tmp_path / "predictions")]
    else:
        labels = mask_folder(ours, tmp_path / "masks")
        words = [labels / "points.npy" if form == "points" else mesh, other, "--labels", labels]
    status, out, err = command(import_map, *words, *DATASET)
    assert (status, err) == (0, "")
    assert scores(other) == pytest.approx(scores(ours), abs=1e-6)
    assert scores(other)["instances.ap50"] == 1.0
    assert ("left out: 1 of 3 instances without a COCO class: wall (1)" in out) is (form == "properties")
    assert ("confidence: unknown" in out) is (form in ("header", "properties"))


def test_imported_run_contains_no_invented_files(folder: Path, command) -> None:
    ours, other = folder / "ours", folder / "other"
    words = (ours / "mesh.ply", other, "--labels", ours / "instances.json", "--name", "Other system", "--up", 0, 0, 2)
    assert command(import_map, *words, *DATASET)[0] == 0
    assert not [name for name in NOT_WRITTEN if (other / name).exists()]
    metrics = metrics_of(other)
    assert not [key for key in metrics if key.startswith(("stage_ms", "fps", "frames", "trajectory", "environment"))]
    assert {metrics[f"choice.{stage}"] for stage in ("detector", "tracker", "refiner", "fuser")} == {"external"}
    assert (metrics["choice.dataset"], metrics["pose_source"], metrics["map.up.z"]) == ("fake", "external", 1.0)
    record = read_record(other)
    assert (record.row, record.is_imported) == ("Other system", True)
    manifest = Manifest.read(other)
    assert manifest.changed_files(other) == []
    assert manifest.files.keys() == {"config.yaml", "instances.json", "mesh.ply", "overview.png", "metrics.json"}
    assert {"external.mesh", "external.labels"} <= manifest.inputs.keys()
    schema = Path(instances_file.__file__).with_name("instances.schema.json")
    jsonschema.validate(json.loads((other / "instances.json").read_text()), json.loads(schema.read_text()))


def test_map_without_classes_has_class_agnostic_scores(folder: Path, command) -> None:
    ours, other = folder / "ours", folder / "other"
    assert command(import_map, ours / "mesh.ply", other, "--class-property", "", *DATASET)[0] == 0
    assert (scores(other)["instances.ap50_agnostic"], scores(other)["instances.ap50"]) == (1.0, 0.0)
    assert {one.class_name for one in read_instances(other / "instances.json")} == {"object"}
    assert command(import_map, other / "mesh.ply", folder / "again", *DATASET)[0] == 0
    assert scores(folder / "again") == scores(other)


def test_own_classes_are_kept_and_recorded(folder: Path, tmp_path: Path, command) -> None:
    ours, other = folder / "ours", folder / "other"
    words = [external_ply(ours, tmp_path / "other.ply"), other, "--label-space", "nyu40", "--class-names", "OWN"]
    assert command(import_map, *words, *DATASET)[0] == 0
    assert sorted(one.class_name for one in read_instances(other / "instances.json")) == ["chair", "sofa", "wall"]
    assert metrics_of(other)["external.class_names"] == "OWN"
    assert Manifest.read(other).parameters["external.class_names"] == "OWN"


def test_listed_masks_are_hashed(folder: Path, tmp_path: Path, command) -> None:
    ours = folder / "ours"
    labels = scannet_predictions(ours, tmp_path / "predictions") / "mesh.txt"
    hashes = []
    for name in ("before", "same", "after"):
        if name == "after":
            mask = sorted((tmp_path / "predictions" / "predicted_masks").iterdir())[0]
            mask.write_text(mask.read_text().replace("1", "2", 1))  # the same instance
        assert command(import_map, ours / "mesh.ply", folder / name, "--labels", labels)[0] == 0
        hashes.append(Manifest.read(folder / name).inputs["external.masks"])
    assert hashes[0] == hashes[1] != hashes[2]


def test_python_import_equals_command(
    folder: Path, tmp_path: Path, command, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(composition, "_added", [FAKES])
    mesh = external_ply(folder / "ours", tmp_path / "other.ply")
    np.savetxt(tmp_path / "T.txt", np.eye(4))
    words = ("--label-space", "nyu40", "--up", 0, 0, 2, "--name", "Other", "--transform", tmp_path / "T.txt")
    assert command(import_map, mesh, folder / "command", *words, *DATASET)[0] == 0
    written = instancemap.import_map(
        mesh, folder / "python", *DATASET, label_space="nyu40", up=(0, 0, 2), name="Other", transform=np.eye(4)
    )
    assert written == folder / "python"
    assert Manifest.read(written).changed_files(written) == []
    assert "left out: 1 of 3 instances without a COCO class: wall (1)" in caplog.text
    files = Manifest.read(written).files
    assert files["instances.json"] == Manifest.read(folder / "command").files["instances.json"]
    given = metrics_of(written)
    assert given.pop("external.transform") == str(np.eye(4).tolist())
    inputs = "inputs_sha256"  # contains the transform file
    assert {**given, inputs: ""} == {
        key: "" if key == inputs else value
        for key, value in metrics_of(folder / "command").items()
        if key != "external.transform"
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"class_names": "own"}, "class_names: expected one of AUTO, COCO, OWN, got 'own'"),
        ({"up": (1.0, 0.0)}, "up: expected a nonzero direction of 3 finite numbers"),
        ({"scale": 0}, "scale: expected a positive number"),
        ({"transform": np.ones((4, 4))}, "transform: expected a rigid transform"),
        ({"label_space": "nowhere"}, "label_space: expected one of"),
        ({"class_property": "nowhere"}, "class_property: expected one of"),
    ],
)
def test_python_import_invalid_argument_raises(arguments: dict[str, Any], message: str, folder: Path) -> None:
    with pytest.raises(instancemap.InstanceMapError, match=message):
        instancemap.import_map(folder / "ours" / "mesh.ply", folder / "other", **arguments)
    assert not (folder / "other").exists()


def test_transform_moves_map_to_the_world_frame(folder: Path, tmp_path: Path, command) -> None:
    ours, other = folder / "ours", folder / "other"
    T_map_world = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 5], [0, 0, 0, 1]])
    mesh = read_ply(ours / "mesh.ply")
    moved = 1000 * (mesh.vertices @ T_map_world[:3, :3].T + T_map_world[:3, 3])
    write_ply(tmp_path / "mm.ply", moved.astype(np.float32), mesh.triangles, mesh.properties, mesh.comments)
    np.savetxt(tmp_path / "T.txt", np.linalg.inv(T_map_world))
    words = (tmp_path / "mm.ply", other, "--scale", 0.001, "--transform", tmp_path / "T.txt", *DATASET)
    assert command(import_map, *words)[0] == 0
    assert scores(other) == pytest.approx(scores(ours), abs=1e-6)


def test_evaluate_imported_map_is_unchanged(folder: Path, command) -> None:
    other = folder / "other"
    command(import_map, folder / "ours" / "mesh.ply", other, *DATASET)
    assert command(evaluate, other) == (0, f"{other}: unchanged\n", "")


def test_map_without_dataset_is_not_evaluated(folder: Path, command) -> None:
    other = folder / "other"
    status, out, _ = command(import_map, folder / "ours" / "mesh.ply", other)
    assert (status, "no dataset: import the map again with dataset=NAME" in out) == (0, True)
    status, _, err = command(evaluate, other)
    assert (status, "expected a dataset to compare with, got none" in err) == (1, True)
    shutil.rmtree(folder / "ours")
    assert "| other |    1 |" in write_tables(folder)
    assert "This is an imported map" in write_reports([other])[0].read_text()


def test_table_shows_imported_map_as_named_row(folder: Path, command) -> None:
    command(import_map, folder / "ours" / "mesh.ply", folder / "other", "--name", "Other system", *DATASET)
    text = write_tables(folder)
    heads, _, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.split("\n\n")[1].splitlines()]
    cells = {row[0]: dict(zip(heads, row, strict=True)) for row in rows}
    assert cells.keys() == {"InstanceMap", "Other system"}
    assert cells["Other system"]["AP50"] == cells["InstanceMap"]["AP50"] == "1.000"
    assert {cells["Other system"][head] for head in ("Hz", "integration (ms)", "ATE (m)")} == {"–"}
    assert (cells["Other system"]["poses"], cells["InstanceMap"]["poses"]) == ("external", "ground_truth")
    assert f"Other system from {folder / 'ours' / 'mesh.ply'}" in text
    assert "None cores" not in text + (folder / "table.tex").read_text()


def test_load_runs_contains_imported_map(folder: Path, command) -> None:
    command(import_map, folder / "ours" / "mesh.ply", folder / "other", "--name", "Other system", *DATASET)
    runs = load_runs(folder).set_index("run")
    assert (runs.loc["other", "row"], runs.loc["other", "detector"]) == ("Other system", "external")
    assert runs.loc["other", "instances.ap50"] == 1.0
    assert runs["fps"].isna().to_dict() == {"other": True, "ours": False}


def test_diff_uses_poses_of_the_other_run(folder: Path, command) -> None:
    ours, other, empty = folder / "ours", folder / "other", folder / "without"
    command(import_map, ours / "mesh.ply", other, *DATASET)
    (folder / "chair.json").write_text('{"1": {"class": "chair", "confidence": 0.9}}')
    command(import_map, ours / "mesh.ply", empty, "--labels", folder / "chair.json", *DATASET)
    for runs in ((ours, other), (other, ours)):
        status, out, err = command(diff, *runs)
        assert (status, err) == (0, "")
        assert out == "no changes\n2 stayed, 0 not observed in the other run\n"
    status, _, err = command(diff, other, empty)
    assert (status, "expected at least one run with trajectory.txt" in err) == (1, True)


def test_export_of_imported_map_writes_surfaces(folder: Path, command) -> None:
    command(import_map, folder / "ours" / "mesh.ply", folder / "other", "--up", 0, 0, 1, *DATASET)
    assert command(export, folder / "other", "--to", "glb", "obj")[0] == 0
    names = {path.name for path in (folder / "other" / "export").rglob("*.*")}
    assert names >= {"scene.glb", "scene.obj", "chair_1.glb", "couch_2.glb"}


def test_query_of_imported_map_is_one_error(folder: Path, command) -> None:
    command(import_map, folder / "ours" / "mesh.ply", folder / "other", *DATASET)
    status, _, err = command(query, folder / "other", "a chair")
    assert status == 1
    assert err.startswith("error: query: expected a run directory with map.npz")
    assert err.count("\n") == 1


def test_reproduce_skips_imported_map(folder: Path, command) -> None:
    command(import_map, folder / "ours" / "mesh.ply", folder / "other", *DATASET)
    assert command(reproduce, folder / "other") == (0, "other: imported map, not run again\n", "")
    (folder / "other" / "instances.json").write_text("[]")
    status, out, _ = command(reproduce, folder / "other")
    assert (status, "other: changed: " in out) == (1, True)


def test_report_omits_unknown_sections(folder: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(composition, "_added", [FAKES])
    command(import_map, folder / "ours" / "mesh.ply", folder / "other", "--name", "Other system", *DATASET)
    *_, page, comparison = write_reports([folder / "ours", folder / "other"])
    text = page.read_text()
    assert "This is an imported map" in text
    assert 'id="objects-table"' in text
    assert "Correct" in text
    assert "data:image/webp" in text
    for section in ("trajectory", "growth", "times"):
        assert f'<section id="{section}"' not in text
        assert f'<section id="{section}"' in (folder / "ours" / "report.html").read_text()
    assert "Other system" in comparison.read_text()


def test_report_of_point_cloud_has_no_map(folder: Path, tmp_path: Path, command) -> None:
    labels = mask_folder(folder / "ours", tmp_path / "masks")
    command(import_map, labels / "points.npy", folder / "other", "--labels", labels, *DATASET)
    [page] = write_reports([folder / "other"])
    assert "The map has no triangles." in page.read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["fuser.voxel_size=0.01"], "import-map: expected dataset=NAME, dataset.KEY=VALUE, evaluation.KEY=VALUE or"),
        (["dataset.frames=6"], "import-map: expected dataset=NAME, got only dataset.frames=6"),
        (["dataset=nowhere"], "dataset: expected one of"),
        (["--up", "0", "0", "0"], "up: expected a nonzero direction"),
        (["--scale", "-1"], "scale: expected a positive number"),
        (["--transform", "nowhere.txt"], "nowhere.txt: expected a text file"),
        (["--labels", "nowhere.json"], "nowhere.json: expected"),
        (["--label-space", "nowhere"], "label_space: expected one of"),
    ],
)
def test_invalid_argument_writes_nothing(words: list[str], message: str, folder: Path, command) -> None:
    status, _, err = command(import_map, folder / "ours" / "mesh.ply", folder / "other", *words)
    assert status == 1
    assert err.startswith(f"error: {message}")
    assert not (folder / "other").exists()


def test_existing_directory_is_not_overwritten(folder: Path, command) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "ours").iterdir()}
    status, _, err = command(import_map, folder / "ours" / "mesh.ply", folder / "ours", *DATASET)
    assert (status, "expected a new or empty folder" in err) == (1, True)
    assert {path.name: path.stat().st_mtime_ns for path in (folder / "ours").iterdir()} == before


def test_interrupted_import_is_started_again(folder: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    words = (folder / "ours" / "mesh.ply", folder / "other", *DATASET)
    with monkeypatch.context() as patched:
        patched.setattr(imported_run, "write_overview", interrupted)
        assert command(import_map, *words)[0] == 130
    assert (folder / "other" / "mesh.ply").exists()
    assert command(import_map, *words)[0] == 0
    assert not Manifest.read(folder / "other").changed_files(folder / "other")
    assert not (folder / "other" / ".unfinished").exists()
