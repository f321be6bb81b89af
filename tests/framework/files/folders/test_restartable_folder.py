"""Tests for output folders that a command starts again after an interruption."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.files.folders.directory_lock import locked
from framework.files.folders.restartable_folder import check_finished, check_startable, restartable_folder

OWN = re.compile(r"images/\d\.png|done\.txt")


def write_part(folder: Path) -> None:
    with restartable_folder(folder, "import", OWN):
        (folder / "images").mkdir()
        for k in range(3):
            (folder / f"images/{k}.png").touch()
        raise KeyboardInterrupt


def interrupt(folder: Path) -> None:
    """Write a part of the files, like a command that is interrupted."""
    with pytest.raises(KeyboardInterrupt):
        write_part(folder)


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_restartable_folder_finished_contains_only_own_files(tmp_path: Path) -> None:
    with restartable_folder(tmp_path / "new", "import", OWN):
        assert (tmp_path / "new/.unfinished").read_text() == "import\n"
        (tmp_path / "new/done.txt").touch()
    assert names(tmp_path / "new") == {"done.txt"}
    check_finished(tmp_path / "new")
    with (
        pytest.raises(DataError, match="expected a new or empty folder"),
        restartable_folder(tmp_path / "new", "import", OWN),
    ):
        pass


def test_restartable_folder_interrupted_is_started_again(tmp_path: Path) -> None:
    interrupt(tmp_path / "out")
    (tmp_path / "out/images/mine.png").touch()
    (tmp_path / "out/.done.4711-0123abcd.partial.txt").touch()
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/0.png").touch()
    (tmp_path / "out/linked").symlink_to(tmp_path / "outside")
    with restartable_folder(tmp_path / "out", "import", OWN):
        assert names(tmp_path / "out") == {".lock", ".lock_holder", ".unfinished", "images/mine.png"}
        (tmp_path / "out/done.txt").touch()
    assert names(tmp_path / "out") == {"done.txt", "images/mine.png"}
    assert (tmp_path / "outside/0.png").exists()


def test_restartable_folder_of_other_command_is_refused(tmp_path: Path) -> None:
    interrupt(tmp_path / "out")
    with pytest.raises(DataError, match="expected a new or empty folder"):
        check_startable(tmp_path / "out", "edit")


def test_restartable_folder_in_use_is_refused(tmp_path: Path) -> None:
    interrupt(tmp_path / "out")
    before = names(tmp_path / "out")
    with locked(tmp_path / "out"):
        with (
            pytest.raises(DataError, match="got a directory in use by process"),
            restartable_folder(tmp_path / "out", "import", OWN),
        ):
            pass
        with pytest.raises(DataError, match="expected complete data, got a folder in use by process"):
            check_finished(tmp_path / "out")
    assert names(tmp_path / "out") == before
    message = "expected complete data, got an unfinished import; repeat `instancemap import`"
    with pytest.raises(DataError, match=message):
        check_finished(tmp_path / "out")


@pytest.mark.parametrize("existed", [False, True])
def test_restartable_folder_without_files_is_removed(tmp_path: Path, existed: bool) -> None:
    if existed:
        (tmp_path / "out").mkdir()
    with pytest.raises(DataError, match="no frames"), restartable_folder(tmp_path / "out", "import", OWN):
        raise DataError("no frames")
    assert [path.name for path in tmp_path.rglob("*")] == ["out"] * existed


def test_restartable_folder_killed_before_marker_is_new(tmp_path: Path) -> None:
    for name in (".lock", ".lock_holder", "..unfinished.4711-0123abcd.partial"):
        (tmp_path / name).touch()
    check_startable(tmp_path, "import")
