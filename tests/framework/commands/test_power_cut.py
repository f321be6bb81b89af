"""Tests of files after a power cut at any moment of a command."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from omegaconf import OmegaConf

from framework.commands.installation import new_plugin
from framework.commands.recordings import import_recording
from framework.commands.results import (
    bundle,
    edit,
    evaluate,
    export,
    figures,
    import_map,
    merge,
    raycast,
    report,
    tables,
    verify,
)
from framework.commands.running.detect import write_detections
from framework.commands.running.run import run
from framework.files.folders.staged_files import REPLACING, STAGED, finish_replacement
from framework.files.manifest import MANIFEST, Manifest, RunStatus
from framework.runs.stored_runs import read_record
from framework.training.room_pictures import render_room
from tests.support import reported_run
from tests.support.command_call import call_command
from tests.support.power_cut import Lost, VolatileDisk
from tests.support.recordings.phone_exports import room_frames, write_stray_scanner
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

pytestmark = [pytest.mark.acceptance, pytest.mark.usefixtures("fakes_registered")]  # several seconds each
CONFIG = OmegaConf.create(reported_run.CONFIG | {"fuser": reported_run.CONFIG["fuser"] | {"voxel_size": 0.06}})

COMMANDS: dict[str, tuple[ModuleType, tuple[str, ...]]] = {
    "bundle": (bundle, (".", "--out", "bundle.zip")),
    "edit": (edit, ("run", "--delete", "1", "--out", "edited")),
    "evaluate": (evaluate, ("run", "--label-space", "agnostic")),
    "export": (export, ("run", "--to", "glb", "ply", "obj", "--out", "exported")),
    "merge": (merge, ("run", "other", "--out", "merged")),
    "import-map": (import_map, ("run/mesh.ply", "imported")),
    "figures": (figures, ("run", "figure.kind=stage_times")),
    "import": (import_recording, ("phone", "recording")),
    "new-plugin": (new_plugin, ("refiner", "my_refiner")),
    "raycast": (raycast, ("run",)),
    "report": (report, ("run",)),
    "tables": (tables, ("run", "table.columns=[fps]")),
    "verify": (verify, ("run", "--accept", "overview.png")),
}


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a run."""
    return reported_run.write_run(tmp_path_factory.mktemp("runs") / "run", frames=4)


@pytest.fixture
def folder(mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working folder, with a copy of the run."""
    folder = tmp_path / "work"
    shutil.copytree(mapped, folder / "run")
    write_stray_scanner(folder / "phone", room_frames(2))
    monkeypatch.chdir(folder)
    return folder


def damage(folder: Path, complete: tuple[str, ...]) -> str:
    """Return a description of the lost data in a folder after a power cut, "" = none.

    Args:
        folder: The folder.
        complete: The run directories that are complete.
    """
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.is_file() and not hidden and not path.stat().st_size:
            return f"{path.relative_to(folder)} is empty"
    for directory in {path.parent for name in (STAGED, REPLACING) for path in folder.rglob(name)}:
        finish_replacement(directory)
    for path in folder.rglob(MANIFEST):
        if STAGED not in path.parts and (changed := Manifest.read(path.parent).changed_files(path.parent)):
            return changed[0]
    for name in complete:
        if Manifest.read(folder / name).status is not RunStatus.COMPLETE:
            return f"{name} is not complete"
        read_record(folder / name)
    return ""


def cut_everywhere(folder: Path, action: Callable[[], object], *complete: str) -> int:
    """Cut the power before each file operation of an action, check the files, and return the number of cuts."""
    found = []

    def check(copy: Path, lost: Lost, operation: str) -> None:
        if cause := damage(copy, complete):
            found.append(f"{lost.name} before {operation}: {cause}")

    disk = VolatileDisk(folder, folder.with_name("held"), check)
    with disk.active():
        action()
    assert found == []
    return disk.cuts


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_command_after_power_cut_has_no_damaged_files(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, arguments = COMMANDS[name]
    if name == "merge":
        shutil.copytree(folder / "run", folder / "other")

    def action() -> None:
        status, _, error = call_command(module, arguments, monkeypatch, capsys)
        assert status == 0, error

    assert cut_everywhere(folder, action, "run") >= 4


@pytest.mark.parametrize("directory", ["run", "new"])
def test_run_after_power_cut_has_no_damaged_files(directory: str, folder: Path) -> None:
    assert cut_everywhere(folder, lambda: run(CONFIG, folder / directory, {})) >= 20


def test_resumed_run_after_power_cut_has_no_damaged_files(folder: Path) -> None:
    tracker = {"_target_": "plugins.trackers.ground_truth.GroundTruth"}
    config = OmegaConf.create(reported_run.CONFIG | {"resume_from": str(folder / "run"), "tracker": tracker})
    assert cut_everywhere(folder, lambda: run(config, folder / "run", {}), "run") >= 20


def test_detections_after_power_cut_are_undamaged(folder: Path) -> None:
    path = folder / "found.json"
    assert cut_everywhere(folder, lambda: write_detections(path, SphereDetector(), CornerRoom(frames=2))) >= 2


def test_rendered_room_after_power_cut_is_undamaged(folder: Path) -> None:
    assert cut_everywhere(folder, lambda: render_room(folder, 1, 2)) >= 4


def test_power_cut_without_sync_is_found(folder: Path) -> None:
    def action() -> None:
        (folder / "new.json").write_text("{}")
        (folder / "new.json").rename(folder / "run" / "metrics.json")

    with pytest.raises(
        AssertionError,
        match=r"DATA_LOST before rename .* new\.json is empty",
    ):
        cut_everywhere(folder, action, "run")
