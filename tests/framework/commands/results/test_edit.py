"""Tests for the command `edit`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from PIL import Image

from framework.commands.results import edit
from framework.commands.results.evaluate import evaluate_runs
from framework.evaluation.instances import Transfer
from framework.runs.instances_file import read_instances
from framework.runs.stored_runs import read_record
from tests.support import reported_run
from tests.support.forked_commands import completed

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reported_run.write_run(tmp_path_factory.mktemp("runs") / "room")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of the first 24 frames of the desk."""
    directory = tmp_path_factory.mktemp("desk") / "run"
    words = ("dataset=desk", "dataset.stop=24", "fuser.voxel_size=0.02", f"hydra.run.dir={directory}")
    done = completed(directory.parent, *words)
    assert done.returncode == 0, done.stderr
    return directory


def edited(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["instancemap edit", *map(str, words)])
    edit.main()


def new_id(capsys: pytest.CaptureFixture[str]) -> int:
    """Return the id of the instance that the command has created."""
    [line] = [line for line in capsys.readouterr().out.splitlines() if "new: " in line]
    return int(line.rpartition("new: ")[2])


def ap50_against(run: Path, ground_truth: Path) -> float:
    assert evaluate_runs([run], Transfer.TO_TRUTH, write=True, ground_truth=str(ground_truth)) == 0
    return float(read_record(run).metrics["instances.ap50"])


def test_edit_corrects_damaged_desk_to_ap50_of_1(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two objects are merged, one has a wrong class, and a false one is split off the table."""
    found = sorted(read_instances(desk / "instances.json"), key=lambda one: one.confidence)
    ids = {one.class_name: one.id for one in found}  # the most likely object of each class
    keyboard, book, monitor, table = (ids[name] for name in ("keyboard", "book", "tv", "dining table"))
    damaged, corrected = tmp_path / "damaged", tmp_path / "corrected"
    wrong = ("--merge", keyboard, book, "--rename", monitor, "oven", "--split", table, "plane")
    edited(monkeypatch, desk, *wrong, "--out", damaged)
    right = ["--merge", table, new_id(capsys), "--rename", monitor, "tv", "--split", keyboard]
    edited(monkeypatch, damaged, *right, "--preview")
    right += ["--rename", keyboard, "keyboard", "--rename", new_id(capsys), "book"]
    edited(monkeypatch, damaged, *right, "--out", corrected)
    assert ap50_against(desk, damaged) < 0.9
    assert ap50_against(desk, corrected) == 1.0


def test_edit_applies_options_in_order(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "edits.json").write_text('[{"split": [1]}]')
    words = ("--merge", 1, 2, "--edits", tmp_path / "edits.json", "--rename", 3, "chair", "--rename", 3, "couch")
    edited(monkeypatch, run, *words, "--delete", 1, "--out", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "edits.json").read_text()) == [
        {"merge": [1, 2]},
        {"split": [1, "parts"]},
        {"rename": [3, "chair"]},
        {"rename": [3, "couch"]},
        {"delete": [1]},
    ]
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:5]] == [
        "merge 1, 2",
        "split 1 by parts",
        "rename 3",
        "rename 3",
        "delete 1",
    ]
    assert lines[5:] == [str(tmp_path / "out"), str(tmp_path / "out" / "edits.png")]
    assert [(one.id, one.class_name) for one in read_instances(tmp_path / "out" / "instances.json")] == [(3, "couch")]


@pytest.mark.parametrize(
    ("words", "lines", "panels"), [((), ["1 chair", "2 couch"], 1), (("--delete", "1"), ["delete 1"], 2)]
)
def test_edit_preview_writes_only_image(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    lines: list[str],
    panels: int,
) -> None:
    edited(monkeypatch, run, "--preview", *words, "--out", tmp_path / "out")
    assert capsys.readouterr().out.splitlines() == [*lines, str(tmp_path / "out.png")]
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]
    with Image.open(tmp_path / "out.png") as image:
        assert image.width == 960 * panels


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        ((), 2, "expected at least one of --merge, --split, --rename, --delete and --edits, got none"),
        (("--rename", 1), 2, "argument --rename: expected 2 arguments"),
        (("--merge", 1), 1, "error: --merge: expected two or more instance ids, got [1]"),
        (("--delete", "chair"), 1, "error: --delete: expected instance ids in [1, 16777216], got 'chair'"),
        (("--split", 1, "line"), 1, "error: --split: expected an instance id and optionally 'parts' or 'plane'"),
        (("--rename", 2, " chair"), 1, "error: --rename: expected a class name of 1 to 100 characters without outer"),
    ],
)
def test_edit_invalid_arguments_exit_with_one_line_error(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[object, ...],
    status: int,
    message: str,
) -> None:
    with pytest.raises(SystemExit) as ended:
        edited(monkeypatch, run, *words, "--out", tmp_path / "out")
    assert ended.value.code == status
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()
