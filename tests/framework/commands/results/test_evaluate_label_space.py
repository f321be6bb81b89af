"""Tests for label spaces in the command `evaluate`, in tables and in reports."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.commands.results import evaluate
from framework.reporting.comparison_page import Comparison
from framework.reporting.run_contents import RunContents
from framework.reporting.run_page import RunReport
from framework.runs.provenance import config_hash
from framework.runs.reevaluation import classes_of, evaluate_as_configured
from framework.runs.run_rows import rows_of
from framework.runs.stored_runs import find_records, read_record
from tests.support import reported_run
from tests.support.command_call import call_command
from tests.support.reported_run import unverified_copy

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reported_run.write_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def stored(mapped: Path, tmp_path: Path) -> Path:
    return unverified_copy(mapped, tmp_path / "runs" / "first")


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs the command in this process and returns the status, stdout and stderr."""
    return lambda *arguments: call_command(evaluate, arguments, monkeypatch, capsys)


def metrics_of(directory: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((directory / "metrics.json").read_text())
    return metrics


def test_evaluate_in_label_space_is_repeated_and_undone(stored: Path, tmp_path: Path, command) -> None:
    before = metrics_of(stored)
    names = tmp_path / "names.txt"
    names.write_text("seat\nwall\n")
    words = ("--label-space", names, "--name", "chair=seat", "--name", "couch=")
    status, _, err = command(stored, *words)
    assert (status, err) == (0, "")
    found = metrics_of(stored)
    assert found["evaluated_classes.label_space"] == str(names)
    assert json.loads(found["evaluated_classes.names"]) == {"chair": "seat", "couch": None}
    assert found["instances.ap50.seat"] == before["instances.ap50.chair"]
    assert "instances.ap50.chair" not in found
    assert found["instances.scannet.ap50.seat"] == found["instances.scannet.ap50"]
    assert "semantic.iou.seat" in found
    assert classes_of(read_record(stored)).names == {"chair": "seat", "couch": None}
    assert command(stored)[1].splitlines()[0] == f"{stored}: unchanged"
    assert metrics_of(stored) == found
    assert command(stored, "--label-space", "")[0] == 0
    after = metrics_of(stored)
    assert {key: after[key] for key in before} == before


def test_evaluate_prints_ignored_objects_and_report_names_them(stored: Path, tmp_path: Path, command) -> None:
    (tmp_path / "names.txt").write_text("couch\n")
    status, out, _ = command(stored, "--label-space", tmp_path / "names.txt")
    assert status == 0
    assert out.splitlines()[1:] == ["  ignored in the map: chair (1)", "  ignored in the ground truth: chair (1)"]
    record = read_record(stored)
    assert record.metrics["label_space"] == "coco"
    page = RunReport.of(RunContents.read(stored)).html()
    assert f"Evaluation label space: {tmp_path / 'names.txt'}. Ignored in the map: chair (1)." in page
    assert "Label space" in page


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("--label-space", "nyu41"), "evaluation.label_space: expected one of coco"),
        (("--name", "a=b"), "--name: expected --label-space, got none"),
        (("--label-space", "coco", "--name", "chair"), "--name: expected NAME=CLASS, got 'chair'"),
        (("--label-space", "coco", "--name", "sofa=sofa"), "evaluation.names: expected classes of coco, got 'sofa'"),
    ],
)
def test_evaluate_invalid_label_space_is_error(stored: Path, command, words: tuple[str, ...], error: str) -> None:
    before = metrics_of(stored)
    status, out, err = command(stored, *words)
    assert (status, out) == (1, "")
    assert error in err
    assert metrics_of(stored) == before


def test_evaluate_several_scenes_prints_metrics_over_all(stored: Path, tmp_path: Path, command) -> None:
    other = Path(shutil.copytree(stored, tmp_path / "runs" / "second"))
    words = (tmp_path / "runs", "--label-space", "agnostic")
    assert command(*words)[1].endswith("no metrics over all scenes: several runs have the same sequence\n")
    (other / "metrics.json").write_text(json.dumps(metrics_of(other) | {"sequence": "another"}))
    last = command(*words)[1].splitlines()[-1]
    ap50 = metrics_of(stored)["instances.scannet.ap50"]
    assert last.startswith("2 scenes, ScanNet benchmark metrics: AP ")
    assert f"AP50 {ap50:.3f}" in last


def test_label_space_of_removed_file_is_kept_in_run(stored: Path, tmp_path: Path, command) -> None:
    names = tmp_path / "names.txt"
    names.write_text("couch\n")
    assert command(stored, "--label-space", names)[0] == 0
    before = metrics_of(stored)
    names.write_text("chair\n")
    assert command(stored)[1].startswith(f"{stored}: unchanged")
    names.unlink()
    assert command(stored)[1].startswith(f"{stored}: unchanged")
    assert metrics_of(stored) == before | {key: value for key, value in metrics_of(stored).items() if key not in before}
    assert "Evaluation label space: " in RunReport.of(RunContents.read(stored)).html()


def test_runs_in_different_label_spaces_are_different_rows(stored: Path, tmp_path: Path, command) -> None:
    other = Path(shutil.copytree(stored, tmp_path / "runs" / "second"))
    config = OmegaConf.load(other / "config.yaml")
    config.seed = 1
    OmegaConf.save(config, other / "config.yaml")
    metrics = metrics_of(other) | {"seed": 1, "config_hash": config_hash(OmegaConf.to_container(config))}
    (other / "metrics.json").write_text(json.dumps(metrics))
    records, _ = find_records(tmp_path / "runs")
    assert len(rows_of(records, ["seed"])) == 1
    assert command(other, "--label-space", "nyu40")[0] == 0
    records, _ = find_records(tmp_path / "runs")
    rows = rows_of(records, ["seed"])
    assert sorted(row.name for row in rows) == ["evaluation.label_space=null", "evaluation.label_space=nyu40"]
    assert rows[0].peers != rows[1].peers
    status, out, _ = command(tmp_path / "runs")
    assert (status, "no metrics over all scenes" in out) == (0, False)  # only one run has a label space


def test_comparison_report_warns_of_different_label_spaces(stored: Path, tmp_path: Path, command) -> None:
    other = Path(shutil.copytree(stored, tmp_path / "runs" / "second"))
    runs = [RunContents.read(one) for one in (stored, other)]
    assert "label spaces differ" not in Comparison.of(runs, ["", ""]).html()
    assert command(other, "--label-space", "nyu40")[0] == 0
    page = Comparison.of([RunContents.read(one) for one in (stored, other)], ["", ""]).html()
    assert "The evaluation label spaces differ, so AP and IoU are not comparable" in page


def test_skipped_run_is_evaluated_in_label_space_of_config(stored: Path) -> None:
    plain = dict(read_record(stored).config)
    evaluate_as_configured(stored, plain)
    assert metrics_of(stored)["evaluated_classes.label_space"] is None
    evaluate_as_configured(stored, plain | {"evaluation": {"label_space": "agnostic", "names": None}})
    assert metrics_of(stored)["evaluated_classes.label_space"] == "agnostic"
    assert config_hash(plain) == config_hash(plain | {"evaluation": {"label_space": "agnostic"}})
