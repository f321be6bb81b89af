"""Tests for `instancemap verify`, and for readers of changed run files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.commands.results import evaluate, export, query, report, tables, verify
from framework.files.folders.directory_lock import locked
from framework.files.manifest import Manifest
from tests.support import reported_run
from tests.support.command_call import call_command

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]
FLIPPED = 100  # number of flipped bits

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the runs `run` and `other`."""
    folder = tmp_path_factory.mktemp("runs")
    reported_run.write_run(folder / "run", frames=4)
    reported_run.write_run(folder / "other", frames=5)
    return folder


@pytest.fixture
def stored(mapped: Path, tmp_path: Path) -> Path:
    """Return a copy of the run directory."""
    return Path(shutil.copytree(mapped / "run", tmp_path / "runs" / "run"))


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs a command in this process and returns the status, stdout and stderr."""
    return lambda module, *arguments: call_command(module, arguments, monkeypatch, capsys)


def test_verify_unchanged_run_is_accepted(stored: Path, command: Command) -> None:
    count = len(Manifest.read(stored).files)
    assert count >= 10
    assert command(verify, stored) == (0, f"{stored}: COMPLETE, {count} files unchanged\n", "")


def test_verify_every_flipped_bit_is_found(stored: Path, command: Command) -> None:
    generator = np.random.default_rng(0)
    files = [*Manifest.read(stored).files, "manifest.json"]
    for k in range(FLIPPED):
        path = stored / files[k % len(files)]
        before = path.read_bytes()
        position = int(generator.integers(len(before)))
        flipped = before[position] ^ (1 << int(generator.integers(8)))
        path.write_bytes(before[:position] + bytes([flipped]) + before[position + 1 :])
        status, _, error = command(verify, stored)
        assert status == 1, (path, position)
        assert error.startswith(f"error: {path}"), (path, position)
        path.write_bytes(before)
    assert command(verify, stored)[0] == 0


def test_verify_folder_reports_each_run(stored: Path, mapped: Path, command: Command) -> None:
    shutil.copytree(mapped / "other", stored.with_name("other"))
    (stored / "overview.png").unlink()
    shutil.copy(mapped / "other" / "mesh.ply", stored)
    status, output, error = command(verify, stored.parent)
    assert status == 1
    assert [line.split(": ")[1][:8] for line in output.splitlines()] == ["COMPLETE"] * 2
    assert "2 of" in output.splitlines()[1]
    assert f"error: {stored / 'mesh.ply'}: expected the SHA-256 " in error
    assert f"error: {stored / 'overview.png'}: expected a file of " in error


def test_verify_file_of_other_run_is_found(stored: Path, command: Command) -> None:
    (stored / "keyframes.npz").write_bytes(b"")
    assert "keyframes.npz: expected no file in this run" in command(verify, stored)[2]


def test_verify_accepted_files_are_unchanged(stored: Path, command: Command) -> None:
    reported_run.rename_class(stored, "globe")
    (stored / "mesh.ply").unlink()
    assert command(verify, stored)[0] == 1
    assert command(verify, stored, "--accept", "instances.json", "mesh.ply")[::2] == (0, "")
    assert "mesh.ply" not in Manifest.read(stored).files
    status, _, error = command(verify, stored, "--accept", "notes.txt")
    assert (status, "error: --accept: expected files listed in " in error) == (1, True)


def test_verify_accept_in_locked_directory_is_rejected(stored: Path, command: Command) -> None:
    reported_run.rename_class(stored, "globe")
    before = (stored / "manifest.json").read_bytes()
    with locked(stored):  # as `evaluate` does
        status, _, error = command(verify, stored, "--accept", "instances.json")
    assert (status, "expected an unlocked directory" in error) == (1, True)
    assert (stored / "manifest.json").read_bytes() == before


@pytest.mark.parametrize("folder", ["", "empty"])
def test_verify_folder_without_runs_is_rejected(folder: str, tmp_path: Path, command: Command) -> None:
    (tmp_path / "empty").mkdir()
    status, _, error = command(verify, tmp_path / (folder or "missing"))
    assert (status, "expected a run" in error) == (1, True)


READERS = {
    "evaluate": (evaluate, ()),
    "export": (export, ("--to", "glb")),
    "report": (report, ()),
    "tables": (tables, ()),
    "query": (query, ("chair",)),
}
READ = {
    "evaluate": ("config.yaml", "metrics.json", "mesh.ply", "instances.json", "trajectory.txt"),
    "export": ("mesh.ply", "instances.json", "metrics.json"),
    "report": (
        *("config.yaml", "metrics.json", "mesh.ply", "instances.json", "trajectory.txt", "timings.csv"),
        "overview.png",
    ),
    "tables": ("config.yaml", "metrics.json"),
    "query": ("map.npz", "metrics.json"),
}


@pytest.mark.parametrize(("reader", "name"), [(reader, name) for reader, names in READ.items() for name in names])
def test_reader_rejects_file_of_other_run(reader: str, name: str, stored: Path, mapped: Path, command: Command) -> None:
    shutil.copy(mapped / "other" / name, stored)
    module, arguments = READERS[reader]
    folder = stored.parent if reader == "tables" else stored
    status, output, error = command(module, folder, *arguments)
    assert f"{stored / name}: expected the SHA-256 " in output + error
    assert status == 1


def test_evaluate_keeps_hashes_of_other_files(stored: Path, command: Command) -> None:
    (stored / "overview.png").write_bytes(b"changed")
    assert command(evaluate, stored)[0] == 0
    assert [one.partition(":")[0] for one in Manifest.read(stored).changed_files(stored)] == [
        str(stored / "overview.png")
    ]


def test_resumed_map_of_other_run_is_rejected(stored: Path, mapped: Path) -> None:
    from framework.api import scene_of
    from framework.errors import DataError

    shutil.copy(mapped / "other" / "map.npz", stored)
    with pytest.raises(DataError, match=r"map\.npz: expected the SHA-256 .*instancemap verify .* --accept map\.npz"):
        scene_of("resume_from", stored)


def test_manifest_without_status_is_rejected(stored: Path, command: Command) -> None:
    content = json.loads((stored / "manifest.json").read_text())
    del content["status"]
    (stored / "manifest.json").write_text(json.dumps(content))
    assert command(report, stored)[0] == 1
