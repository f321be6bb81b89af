"""Tests for label spaces in the command `evaluate`, in tables and in reports."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from framework.commands.results import evaluate
from framework.reporting.run_contents import RunContents
from framework.reporting.run_page import RunReport
from framework.runs.reevaluation import classes_of
from framework.runs.stored_runs import read_record
from tests.support import reported_run
from tests.support.command_call import call_command

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reported_run.write_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def stored(mapped: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(mapped, tmp_path / "runs" / "first"))


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
    assert f"Compared in the label space {tmp_path / 'names.txt'}. Ignored in the map: chair (1)." in page
    assert "Label space" in page


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("--label-space", "nyu41"), "evaluation.label_space: expected one of coco"),
        (("--name", "a=b"), "--name: expected also --label-space"),
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
    assert "scenes together" not in command(*words)[1]  # one scene twice
    (other / "metrics.json").write_text(json.dumps(metrics_of(other) | {"sequence": "another"}))
    last = command(*words)[1].splitlines()[-1]
    ap50 = metrics_of(stored)["instances.scannet.ap50"]
    assert last.startswith("all 2 scenes together, by the rules of ScanNet's benchmark: AP ")
    assert f"AP50 {ap50:.3f}" in last
