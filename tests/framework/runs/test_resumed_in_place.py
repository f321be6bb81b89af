"""Tests for runs that read an earlier run in their own directory."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.errors import DataError, PartialRunError
from framework.files.folders import output_folder
from framework.files.folders.directory_lock import new_directory
from framework.files.folders.output_folder import reads_results_in
from framework.files.manifest import Manifest, RunStatus
from framework.files.tum_trajectory import read_tum
from framework.pipeline import Pipeline
from framework.runs import run_directory
from framework.runs.run_directory import OWN_FILES, RunRecord, write_run
from framework.runs.stored_runs import read_metrics, read_record
from framework.runtime.run_log import RunResult
from framework.runtime.signals import Interrupted
from tests.support.failing_disk import Fault
from tests.support.scenes.corner_room import CornerRoom, GivenPose, GridFuser, KeepAll, SphereDetector

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.mark.acceptance  # 40 s for each fault
@pytest.mark.parametrize("fault", list(Fault))
def test_resumed_run_any_fault_leaves_complete_run(tmp_path: Path, fault: Fault) -> None:
    """A process that is killed after an operation leaves the same files as one that is killed before the next one."""
    command = [sys.executable, "-m", "tests.support.resumed_in_place", str(tmp_path), fault.name]
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT)}
    done = subprocess.run(command, cwd=CHECKOUT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("DAMAGED")] == []
    assert int(lines[-1].split()[1]) > 100


@pytest.fixture(autouse=True)
def small_overview(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_directory, "write_overview", lambda path, *_: path.write_bytes(b"picture"))


def pipeline() -> Pipeline:
    return Pipeline(SphereDetector(), GivenPose(), KeepAll(), GridFuser())


def begun(directory: Path, **settings: Any) -> RunRecord:
    return RunRecord.begin(directory, OmegaConf.create({"seed": 0, **settings}), {})


@pytest.fixture
def run(tmp_path: Path, room: CornerRoom) -> Path:
    """Return the directory of a run with a report."""
    directory = tmp_path / "run"
    assert begun(directory).write(room, pipeline().run(room)).error is None
    (directory / "report.html").touch()
    return directory


@pytest.fixture
def result() -> RunResult:
    """Return the result of a run with three frames."""
    return pipeline().run(CornerRoom(frames=3))


def files_of(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.parametrize("key", ["resume_from", "localize_in"])
def test_run_in_place_replaces_earlier_run_at_its_end(run: Path, room: CornerRoom, result: RunResult, key: str) -> None:
    before = files_of(run)
    record = begun(run, **{key: str(run)})
    assert files_of(run) == before
    written = record.write(room, result)
    assert (written.folder, written.error, written.moved) == (run, None, "")
    assert files_of(run).keys() == before.keys() - {"report.html"}
    assert Manifest.read(run).changed_files(run) == []
    assert read_record(run).config[key] == str(run)
    assert len(read_tum(run / "trajectory.txt")[0]) == 3


def link_to(run: Path) -> str:
    link = run.with_name("link")
    link.symlink_to(run)
    return str(link)


@pytest.mark.parametrize(
    "setting",
    [str, link_to, os.path.relpath, lambda run: f"{run}/../run/", lambda run: str(run / "trajectory.txt")],
)
def test_paths_of_run_directory_are_recognized(run: Path, setting: Callable[[Path], str]) -> None:
    settings = ["cpu", "", "\0", "~missing/map.npz", None, 7, setting(run)]
    assert reads_results_in(run, settings, OWN_FILES)
    assert not reads_results_in(run.parent, settings, OWN_FILES)


def full_disk(path: Path, *_: object) -> None:
    raise DataError(f"{path}: expected a writable file, got an error (No space left on device)")


def test_failed_run_in_place_keeps_earlier_run(
    run: Path, room: CornerRoom, result: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files_of(run)
    monkeypatch.setattr(run_directory, "write_mesh", full_disk)
    for name in ("run_rescued", "run_rescued_2"):
        written = begun(run, resume_from=str(run)).write(room, result)
        rescued = run.with_name(name)
        assert files_of(run) == before
        assert written.folder == rescued
        assert written.moved == f"the outputs are in {rescued}, and the earlier run in {run} is unchanged"
        assert "No space left" in str(written.error)
        assert files_of(rescued).keys() == before.keys() - {"mesh.ply", "metrics.json", "report.html"} | {
            "metrics.partial.json"
        }
        assert Manifest.read(rescued).status is RunStatus.PARTIAL
        assert Manifest.read(rescued).changed_files(rescued) == []


def test_failed_run_in_place_in_read_only_parent_is_kept(
    run: Path, room: CornerRoom, result: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def new_below_run(wanted: str) -> str:
        if Path(wanted).parent != run:
            raise DataError(f"{wanted}: expected a writable parent folder, got an error (Permission denied)")
        return new_directory(wanted)

    before = files_of(run)
    monkeypatch.setattr(run_directory, "write_mesh", full_disk)
    monkeypatch.setattr(output_folder, "new_directory", new_below_run)
    assert begun(run, resume_from=str(run)).write(room, result).folder == run / "rescued"
    assert (run / "rescued" / "map.npz").exists()
    assert {name: (run / name).read_bytes() for name in before} == before


def test_interrupted_run_in_place_replaces_earlier_run(run: Path, room: CornerRoom, result: RunResult) -> None:
    """All frames until the signal are in the new map."""
    written = begun(run, resume_from=str(run)).write(room, replace(result, stopped_by=Interrupted(15)))
    assert (written.folder, str(written.error)) == (run, "ended by SIGTERM")
    assert read_metrics(run)["partial"] == "ended by SIGTERM"
    assert Manifest.read(run).changed_files(run) == []


def file_instead(directory: Path) -> None:
    directory.rename(directory.with_name("before"))
    directory.touch()


def dangling_link_instead(directory: Path) -> None:
    directory.rename(directory.with_name("before"))
    directory.symlink_to("missing/folder")


@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("change", [file_instead, dangling_link_instead])
def test_run_without_usable_directory_is_saved_next_to_it(
    run: Path, room: CornerRoom, result: RunResult, change: Callable[[Path], None], in_place: bool
) -> None:
    record = begun(run, **({"resume_from": str(run)} if in_place else {}))
    change(run)
    written = record.write(room, result)
    assert written.folder == run.with_name("run_rescued")
    assert f"the outputs are in {written.folder}" in written.moved
    assert f"{run}: expected a writable folder, got an error" in str(written.error)
    assert Manifest.read(written.folder).status is RunStatus.COMPLETE
    assert read_record(written.folder).metrics["frames"] == 3


def test_run_without_writable_parent_is_saved_in_temporary_folder(
    tmp_path: Path, room: CornerRoom, result: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    parent, temporary = tmp_path / "parent", tmp_path / "temporary"
    record = begun(parent / "run")
    (parent / "run").rename(tmp_path / "before")
    parent.rmdir()
    parent.touch()
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr("tempfile.tempdir", None)
    assert record.write(room, result).folder == temporary / "run_rescued"


def test_write_run_reports_other_folder_in_one_line(
    tmp_path: Path, result: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "run"

    def mapped(*_: object) -> RunResult:
        file_instead(place)
        return result

    monkeypatch.setattr(run_directory, "build", lambda *_: CornerRoom(frames=3))
    monkeypatch.setattr(Pipeline, "run_to_any_end", mapped)
    with pytest.raises(PartialRunError) as caught:
        write_run(pipeline(), OmegaConf.create({"seed": 0}), place, {})
    assert str(caught.value).endswith(f"; the outputs are in {place}_rescued")
    assert "\n" not in str(caught.value)
