"""Tests for the command `evaluate` on stored runs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.commands.results import evaluate
from framework.commands.running.run import run
from framework.config import composition
from framework.errors import DataError
from framework.files.folders.directory_lock import locked
from framework.files.manifest import Manifest
from framework.runs import reevaluation, run_directory
from framework.runs.provenance import config_hash
from framework.runs.stored_runs import read_record
from tests.support import reported_run
from tests.support.command_call import call_command
from tests.support.failing_disk import FailingDisk, Fault
from tests.support.reported_run import unverified_copy
from tests.support.scenes.corner_room import CornerRoom

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]
REPEATED = pytest.mark.acceptance  # the same rule with other values
CHECKOUT = Path(__file__).resolve().parents[4]
CONFIG = reported_run.CONFIG | {
    "dataset": reported_run.CONFIG["dataset"] | {"frames": 4},
    "fuser": reported_run.CONFIG["fuser"] | {"voxel_size": 0.04},
}
CODE = {"evaluation.git_commit": "abcdef0", "evaluation.git_dirty": False}


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a run. Its overview image is a placeholder."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(run_directory, "write_overview", lambda path, *_: path.write_bytes(b"picture"))
        patched.setattr(composition, "_added", [reported_run.FAKES])
        run(OmegaConf.create(CONFIG), directory, {})
    return directory


@pytest.fixture
def stored(mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the run directory, and set a known commit of the evaluation code."""
    monkeypatch.setattr(reevaluation, "code_version", lambda: {"git_commit": "abcdef0", "git_dirty": False})
    return unverified_copy(mapped, tmp_path / "runs" / "first")


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs the command in this process and returns the status, stdout and stderr."""

    def start(*arguments: object) -> tuple[int, str, str]:
        return call_command(evaluate, arguments, monkeypatch, capsys)

    return start


def metrics_of(directory: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((directory / "metrics.json").read_text())
    return metrics


def write_metrics(directory: Path, metrics: dict[str, Any]) -> None:
    (directory / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")


def test_evaluate_unchanged_run_keeps_exact_metrics(stored: Path, command) -> None:
    before, time = metrics_of(stored), (stored / "metrics.json").stat().st_mtime_ns
    assert 0 < before["instances.mean_iou"] < 1
    assert 0 < before["instances.to_map.mean_iou"] < 1
    assert command(stored) == (0, f"{stored}: unchanged\n", "")
    after = metrics_of(stored)
    assert after == before | CODE
    assert [key for key in after if key not in CODE] == list(before)
    assert (stored / "metrics.json").stat().st_mtime_ns == time, (
        "expected an unchanged modification time: tables use the latest outputs of a run"
    )
    assert command(stored) == (0, f"{stored}: unchanged\n", "")
    assert metrics_of(stored) == after


def test_evaluate_replaces_only_evaluation_metrics(stored: Path, command) -> None:
    true = metrics_of(stored)
    old = {key: value for key, value in true.items() if not key.startswith("instances.to_map.")}
    old |= {"instances.ap50": 0.125, "instances.ap50.sofa": 0.5, "annotation_release": "first", "fps": 3.0}
    old |= {"trajectory.ate_rmse_m": 0.25, "evaluation.git_commit": "0123456"}
    write_metrics(stored, old)
    status, out, err = command(stored)
    assert (status, err) == (0, "")
    assert out == f"{stored}: AP50 0.125 -> 1.000, annotation_release first -> unknown, 1 other, 5 new\n"
    assert metrics_of(stored) == true | CODE | {"fps": 3.0, "trajectory.ate_rmse_m": 0.25}


def test_evaluate_prints_new_main_metrics(stored: Path, command) -> None:
    true = metrics_of(stored)
    write_metrics(stored, {key: value for key, value in true.items() if not key.startswith("instances.ap")})
    status, out, err = command(stored, "--dry-run")
    assert (status, err) == (0, "")
    assert out.startswith(f"{stored}: AP50 1.000, AP25 1.000, AP {true['instances.ap']:.3f}, ")
    assert out.endswith(" new\n")


def test_evaluate_prints_metrics_of_chosen_transfer(stored: Path, command) -> None:
    true = metrics_of(stored)
    write_metrics(stored, true | {"instances.ap50": 0.125, "instances.to_map.ap25": 0.25})
    assert command(stored, "--transfer", "to_map", "--dry-run")[1].startswith(
        f"{stored}: AP25 to map 0.250 -> {true['instances.to_map.ap25']:.3f}, 1 other"
    )


def test_evaluate_tiny_difference_prints_all_digits(stored: Path, command) -> None:
    true = metrics_of(stored)
    write_metrics(stored, true | {"instances.mean_iou": true["instances.mean_iou"] + 1e-12})
    [line] = command(stored)[1].splitlines()
    assert line.endswith(f"-> {true['instances.mean_iou']!r}")


def test_evaluate_changed_ground_truth_requires_option(stored: Path, command) -> None:
    """A relative dataset.root can refer to other ground truth if the working directory changes."""
    true = metrics_of(stored)
    write_metrics(stored, true | {"truth_sha256": "0" * 64})
    status, out, err = command(stored)
    assert (status, out) == (1, "")
    assert "expected the ground truth of the run (truth_sha256 00000000), got " in err
    assert " from tests.support.scenes.corner_room.CornerRoom; check the dataset" in err
    assert metrics_of(stored)["truth_sha256"] == "0" * 64
    assert "set --allow-changed-ground-truth to evaluate anyway" in err
    assert command(stored, "--allow-changed-ground-truth")[:2] == (0, f"{stored}: 1 other\n")
    assert metrics_of(stored) == true | CODE


def test_evaluate_run_without_truth_hash_is_evaluated(stored: Path, command) -> None:
    true = metrics_of(stored)
    write_metrics(stored, {key: value for key, value in true.items() if key != "truth_sha256"})
    assert command(stored)[:2] == (0, f"{stored}: 1 new\n")
    assert metrics_of(stored) == true | CODE


def test_evaluate_dry_run_writes_nothing(stored: Path, command) -> None:
    write_metrics(stored, metrics_of(stored) | {"instances.ap50": 0.125})
    before = {path.name: path.read_bytes() for path in stored.iterdir()}
    assert "AP50 0.125 -> 1.000" in command("--dry-run", stored)[1]
    assert {path.name: path.read_bytes() for path in stored.iterdir()} == before


def _with_dataset(directory: Path, **parameters: object) -> None:
    """Change the dataset parameters of a stored run."""
    config = CONFIG | {
        "dataset": {"_target_": "tests.support.scenes.corner_room.CornerRoom", "frames": 4, **parameters}
    }
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    write_metrics(directory, metrics_of(directory) | {"config_hash": config_hash(config)})


def _another_config(directory: Path) -> None:
    (directory / "config.yaml").write_text("seed: 4\n")


def _interrupted(directory: Path) -> None:
    (directory / "metrics.partial.json").write_text('{"partial": "interrupted by Ctrl-C"}')
    (directory / "metrics.json").unlink()


def _one_instance_less(directory: Path) -> None:
    content = json.loads((directory / "instances.json").read_text())
    (directory / "instances.json").write_text(json.dumps(content[1:]))


def _another_id(directory: Path) -> None:
    content = json.loads((directory / "instances.json").read_text())
    (directory / "instances.json").write_text(json.dumps([content[0] | {"id": 77}, *content[1:]]))


def _another_size(directory: Path) -> None:
    content = json.loads((directory / "instances.json").read_text())
    (directory / "instances.json").write_text(json.dumps([content[0] | {"vertices": 1}, *content[1:]]))


def _truncated_mesh(directory: Path) -> None:
    path = directory / "mesh.ply"
    path.write_bytes(path.read_bytes()[:-1000])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_another_config, "expected the config_hash of config.yaml, "),
        (_interrupted, "partial: interrupted by Ctrl-C"),
        (_one_instance_less, "instances (as in metrics.json), got 1"),
        (_another_id, "vertices of instance"),
        (_another_size, "vertices of instance"),
        (_truncated_mesh, "mesh.ply, byte"),
        (lambda directory: (directory / "mesh.ply").unlink(), "mesh.ply"),
        (lambda directory: (directory / "instances.json").unlink(), "instances.json: expected a readable file"),
        (
            lambda directory: _with_dataset(directory, truth=False),
            "expected ground-truth instances of the dataset (as in metrics.json), got none",
        ),
        (lambda directory: _with_dataset(directory, colour=1), "got 'colour'"),
    ],
)
def test_evaluate_rejects_only_unusable_run(stored: Path, command, spoil: Callable[[Path], None], message: str) -> None:
    spoilt = Path(shutil.copytree(stored, stored.parent / "a spoilt one"))
    spoil(spoilt)
    before = {path.name: path.read_bytes() for path in spoilt.iterdir()}
    status, out, err = command(stored.parent)
    assert status == 1
    assert out == f"{stored}: unchanged\n"
    assert len(err.splitlines()) == 1, err
    assert err.startswith("error: ")
    assert str(spoilt) in err
    assert message in err
    assert {path.name: path.read_bytes() for path in spoilt.iterdir()} == before


def test_evaluate_folder_without_runs_is_rejected(stored: Path, tmp_path: Path, command) -> None:
    status, out, err = command(tmp_path / "nothing", stored)
    assert (status, out) == (1, f"{stored}: unchanged\n")
    assert err == f"error: {tmp_path / 'nothing'}: expected a run directory or a folder of runs, got neither\n"


def test_evaluate_runs_with_same_truth_load_truth_once(stored: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(stored, stored.parent / "second")
    _with_dataset(Path(shutil.copytree(stored, stored.parent / "other")), stop=3)
    made = []
    scene_truth = CornerRoom.scene_truth
    monkeypatch.setattr(CornerRoom, "scene_truth", lambda self: made.append(len(self)) or scene_truth(self))
    status, out, _ = command(stored.parent, stored, stored.parent / "second")
    assert status == 0
    assert sorted(out.splitlines()) == [f"{stored.parent / name}: unchanged" for name in ("first", "other", "second")]
    assert sorted(made) == [3, 4]


def test_evaluate_run_restarted_during_evaluation_is_rejected(
    stored: Path, command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begins_again(self: CornerRoom) -> None:
        (stored / "metrics.json").unlink()
        return scene_truth(self)

    scene_truth = CornerRoom.scene_truth
    monkeypatch.setattr(CornerRoom, "scene_truth", begins_again)
    status, out, err = command(stored)
    assert (status, out) == (1, "")
    assert "expected an unchanged file, got a file of a restarted run" in err
    assert not (stored / "metrics.json").exists()


def test_evaluate_run_without_truth_is_unchanged(stored: Path, command) -> None:
    write_metrics(
        stored, {key: value for key, value in metrics_of(stored).items() if not reevaluation.is_evaluation(key)}
    )
    _with_dataset(stored, truth=False)
    before = (stored / "metrics.json").read_bytes()
    assert command(stored) == (0, f"{stored}: unchanged\n", "")
    assert (stored / "metrics.json").read_bytes() == before


def test_evaluate_process_reports_results_and_status(mapped: Path, tmp_path: Path) -> None:
    unverified_copy(mapped, tmp_path / "run")
    done = subprocess.run(
        [sys.executable, "-m", "framework", "evaluate", "--config-dir", str(reported_run.FAKES), "run", "absent"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout == "run: unchanged\n", done.stderr
    assert done.stderr == "error: absent: expected a run directory or a folder of runs, got neither\n"
    assert done.returncode == 1


def test_evaluate_locked_run_is_unchanged(stored: Path, command) -> None:
    write_metrics(stored, metrics_of(stored) | {"instances.ap50": 0.5})
    before = (stored / "metrics.json").read_bytes()
    with locked(stored):
        status, out, err = command(stored)
    assert (status, out) == (1, "")
    assert f"error: {stored}: expected an unlocked directory, got a directory in use by process {os.getpid()}" in err
    assert (stored / "metrics.json").read_bytes() == before
    assert command(stored)[0] == 0


@pytest.mark.parametrize("started", [["-m", "framework"], pytest.param(["-P", "-m", "framework"], marks=REPEATED)])
def test_evaluate_does_not_execute_code_in_run_directory(started: list[str], stored: Path) -> None:
    (stored / "brought.py").write_text(
        "print('runs')\nfrom tests.support.scenes.corner_room import CornerRoom as Brought\n"
    )
    for name in ("numpy", "yaml", "matplotlib", "evo"):  # modules that the command imports
        (stored / f"{name}.py").write_text("print('runs')\n")
    _with_dataset(stored, _target_="brought.Brought")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [sys.executable, *started, "evaluate", "."],
        cwd=stored,
        env=environment | {"PYTHONPATH": str(CHECKOUT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert "dataset: expected the _target_ of a registered option of" in done.stderr


def test_evaluate_stored_config_cannot_read_environment(stored: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "hunter2")
    _with_dataset(stored, scene="${oc.env:SECRET}")
    status, out, err = command(stored)
    assert (status, out) == (1, "")
    assert "dataset.scene: expected a resolved value in the run's config.yaml, got ${oc.env:SECRET}" in err
    assert "hunter2" not in err


@pytest.mark.parametrize("fault", [Fault.FAILS, Fault.CUT])
def test_evaluate_fault_keeps_metrics_and_manifest_together(mapped: Path, tmp_path: Path, fault: Fault) -> None:
    stored = Path(shutil.copytree(mapped, tmp_path / "run"))
    record = read_record(stored)
    metrics = {**record.metrics, "instances.ap50": 0.25}
    at = 0
    while True:
        disk = FailingDisk(at, fault)
        with suppress(DataError, OSError), disk.active():
            reevaluation.Reevaluation(record, metrics).write_locked()
        assert Manifest.read(stored).changed_files(stored) == []
        if len(disk.operations) <= at:
            break
        at += 1
    assert at > 10
    assert metrics_of(stored)["instances.ap50"] == 0.25
