"""Tests for exported benchmark predictions, evaluated by a slow reference of ScanNet's rules."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.commands.results import import_map
from framework.commands.results.evaluate import evaluate_runs
from framework.commands.running.run import run
from framework.config import composition
from framework.config.composition import composed_with_choices
from framework.errors import DataError
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import Transfer
from framework.exporting.exports import Chosen, ExportFormat, export
from framework.runs.external_maps.class_labels import ClassIdNames
from tests.support import reported_run
from tests.support.command_call import call_command
from tests.support.scenes.corner_room import CornerRoom
from tests.support.slow_scannet import SceneFiles, slow_ious, slow_metrics

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values
SCENE = Path(__file__).resolve().parents[4] / "shared" / "data" / "scannet_scene0000"

OVERRIDES = (
    "dataset=scannet",
    f"dataset.root={SCENE}",
    "dataset.scene=scene0000_00",
    "dataset.frame_ground_truth=true",
    "dataset.stride=10",
    "detector=simulated",
    "tracker=ground_truth",
)


@pytest.fixture(scope="module")
def scannet_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run on a real room of ScanNet with simulated masks."""
    if not SCENE.is_dir():
        pytest.skip(f"{SCENE} does not exist")
    directory = tmp_path_factory.mktemp("scannet") / "run"
    config, choices = composed_with_choices(*OVERRIDES)
    run(config, directory, choices)
    return directory


def metrics_in(directory: Path, label_space: str) -> dict[str, Any]:
    """Evaluate a run in a label space and return its metrics."""
    classes = ComparedClasses.of({"evaluation": {"label_space": label_space}})
    assert evaluate_runs([directory], Transfer.TO_TRUTH, write=True, classes=classes) == 0
    metrics: dict[str, Any] = json.loads((directory / "metrics.json").read_text())
    return metrics


def benchmark_figures(metrics: dict[str, Any]) -> dict[str, float]:
    return {key: value for key, value in metrics.items() if key.startswith(("instances.scannet.", "semantic."))}


@pytest.mark.parametrize("label_space", ["scannet20", "scannet200", pytest.param("nyu40", marks=REPEATED)])
def test_exported_predictions_have_metrics_of_run(scannet_run: Path, tmp_path: Path, label_space: str) -> None:
    metrics = metrics_in(scannet_run, label_space)
    paths = export(scannet_run, [ExportFormat.SCANNET], tmp_path)
    assert [path.relative_to(tmp_path).parts[1] for path in paths] == ["instances", "semantics", "ground_truth"]
    files = SceneFiles.read(paths[0], paths[2])
    names = dict(ClassIdNames.of(label_space).names)
    objects = {key: name for key, name in names.items() if name not in ("wall", "floor")}
    expected = slow_metrics([files], objects)
    expected |= slow_ious([int(word) for word in paths[1].read_text().split()], files.codes, names)
    assert benchmark_figures(metrics) == pytest.approx(expected, abs=1e-6)
    assert 0.1 < metrics["instances.scannet.ap50"] < 1
    assert "lamp" not in metrics["evaluated_classes.ignored_in_map"]


def test_class_agnostic_evaluation_has_one_class(scannet_run: Path) -> None:
    metrics = metrics_in(scannet_run, "agnostic")
    assert metrics["instances.ap50"] == metrics["instances.ap50_agnostic"] == metrics["instances.ap50.object"]
    assert set(benchmark_figures(metrics)) == {
        *(f"instances.scannet.{name}" for name in ("ap", "ap50", "ap25")),
        *(f"instances.scannet.{name}.object" for name in ("ap", "ap50", "ap25")),
    }
    assert metrics["evaluated_classes.ignored_in_map"] is None


def test_npz_predictions_equal_text_files(scannet_run: Path, tmp_path: Path) -> None:
    [list_file, *_, arrays] = export(
        scannet_run, [ExportFormat.SCANNET, ExportFormat.NPZ], tmp_path, Chosen(label_space="scannet200")
    )
    found = np.load(arrays)
    lines = [line.split() for line in list_file.read_text().splitlines()]
    assert found["pred_classes"].tolist() == [int(line[1]) for line in lines]
    np.testing.assert_allclose(found["pred_scores"], [float(line[2]) for line in lines], rtol=1e-6)
    for k, line in enumerate(lines):
        mask = [word == "1" for word in (list_file.parent / line[0]).read_text().split()]
        np.testing.assert_array_equal(found["pred_masks"][:, k], mask)


def test_imported_predictions_have_metrics_of_run(
    scannet_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = metrics_in(scannet_run, "scannet20")
    export(scannet_run, [ExportFormat.SCANNET], tmp_path)
    mesh = SCENE / "scene0000_00/scene0000_00_vh_clean_2.ply"
    words = (mesh, tmp_path / "other", "--labels", tmp_path / "scannet/instances", *OVERRIDES[:3])
    status, _, err = call_command(import_map, (*words, "evaluation.label_space=scannet20"), monkeypatch, capsys)
    assert (status, err) == (0, "")
    theirs = json.loads((tmp_path / "other" / "metrics.json").read_text())
    assert benchmark_figures(theirs) == pytest.approx(benchmark_figures(ours), abs=1e-6)


def test_predictions_of_given_points_need_no_ground_truth(scannet_run: Path, tmp_path: Path) -> None:
    mesh = SCENE / "scene0000_00/scene0000_00_vh_clean_2.ply"
    default = export(scannet_run, [ExportFormat.SCANNET], tmp_path / "default", Chosen(label_space="nyu40"))
    chosen = Chosen(label_space="nyu40", points=mesh)
    given = export(scannet_run, [ExportFormat.SCANNET], tmp_path / "given", chosen)
    assert [path.read_text() for path in given] == [path.read_text() for path in default[:2]]


def test_class_ids_below_one_are_error(scannet_run: Path, tmp_path: Path) -> None:
    (tmp_path / "names.json").write_text('["chair", "table"]')
    with pytest.raises(DataError, match="a JSON file with class ids of at least 1, got the id 0"):
        export(scannet_run, [ExportFormat.NPZ], tmp_path, Chosen(label_space=str(tmp_path / "names.json")))
    (tmp_path / "names.json").write_text('{"20": "chair", "80": "table"}')
    [path] = export(scannet_run, [ExportFormat.NPZ], tmp_path, Chosen(label_space=str(tmp_path / "names.json")))
    assert set(np.load(path)["pred_classes"].tolist()) <= {20, 80}


def test_class_agnostic_predictions_have_one_class(scannet_run: Path, tmp_path: Path) -> None:
    [path] = export(scannet_run, [ExportFormat.NPZ], tmp_path, Chosen(label_space="agnostic"))
    found = np.load(path)
    assert found["pred_classes"].tolist() == [1] * len(json.loads((scannet_run / "instances.json").read_text()))


def test_predictions_without_class_of_label_space_are_error(scannet_run: Path, tmp_path: Path) -> None:
    (tmp_path / "names.json").write_text('{"7": "forklift"}')
    with pytest.raises(DataError, match=r"expected an instance with a class of .*names\.json, got none"):
        export(scannet_run, [ExportFormat.SCANNET], tmp_path, Chosen(label_space=str(tmp_path / "names.json")))


def test_left_out_predictions_are_reported(scannet_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "names.json").write_text('{"20": "chair", "80": "table"}')
    export(scannet_run, [ExportFormat.NPZ], tmp_path, Chosen(label_space=str(tmp_path / "names.json")))
    assert "names.json are left out: " in caplog.text
    assert "refrigerator (" in caplog.text


def test_predictions_without_ground_truth_are_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CornerRoom, "scene_truth", lambda self: None)
    directory = reported_run.write_run(tmp_path / "run")
    monkeypatch.setattr(composition, "_added", [reported_run.FAKES])
    with pytest.raises(DataError, match="expected ground-truth instances of the dataset, got none; set points"):
        export(directory, [ExportFormat.NPZ], tmp_path)


def test_imported_ground_truth_in_label_space_is_perfect(
    scannet_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Classes outside of COCO, such as cabinet, are kept for an evaluation in another label space."""
    [_, _, truth] = export(scannet_run, [ExportFormat.SCANNET], tmp_path, Chosen(label_space="nyu40"))
    codes = np.loadtxt(truth, dtype=np.int64)
    entries = []
    for code in np.unique(codes[codes // 1000 > 2]).tolist():  # without walls and floors
        np.save(tmp_path / f"{code}.npy", codes == code)
        entries.append({"mask": f"{code}.npy", "class": code // 1000, "confidence": 0.5})
    (tmp_path / "instances.json").write_text(json.dumps(entries))
    mesh = SCENE / "scene0000_00/scene0000_00_vh_clean_2.ply"
    words = (mesh, tmp_path / "true", "--labels", tmp_path, "--label-space", "nyu40", *OVERRIDES[:3])
    status, _, err = call_command(import_map, (*words, "evaluation.label_space=nyu40"), monkeypatch, capsys)
    assert (status, err) == (0, "")
    metrics = json.loads((tmp_path / "true" / "metrics.json").read_text())
    assert metrics["instances.ap"] == metrics["instances.scannet.ap"] == metrics["instances.ap50.cabinet"] == 1.0
    assert metrics["semantic.iou.cabinet"] == 1.0
    assert metrics["semantic.iou.wall"] == 0.0
