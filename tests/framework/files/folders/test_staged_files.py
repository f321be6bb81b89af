"""Tests for the replacement of several files at once."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.files.atomic_write import atomic_write
from framework.files.folders.staged_files import REPLACING, STAGED, StagedFiles, finish_replacement, staged_files
from tests.support.failing_disk import FailingDisk, Fault


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """Return a directory with the files a, b and c."""
    for name in "abc":
        (tmp_path / name).write_text("old")
    return tmp_path


def contents(directory: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in directory.iterdir()}


NEW = {"a": "new", "c": "old", "d": "new"}  # after the replacement in `replace`


def replace(directory: Path) -> None:
    staged = StagedFiles.begin(directory)
    (staged.folder / "a").write_text("new")
    (staged.folder / "d").write_text("new")
    staged.replace(["a", "b", "missing"])


def test_staged_files_replace_and_remove_old_files(old: Path) -> None:
    replace(old)
    assert contents(old) == NEW


@pytest.mark.parametrize("fault", [Fault.FAILS, Fault.CUT])
def test_staged_files_fault_leaves_old_or_new_files(old: Path, fault: Fault) -> None:
    at, outcomes = 0, set[str]()
    while True:
        disk = FailingDisk(at, fault)
        try:
            with disk.active():
                replace(old)
        except (DataError, OSError):
            finish_replacement(old)
        StagedFiles(old).discard()
        found = contents(old)
        assert found in (NEW, dict.fromkeys("abc", "old"))
        outcomes.add(found["a"])
        if len(disk.operations) <= at:
            break
        for name in found:
            (old / name).unlink()
        for name in "abc":
            (old / name).write_text("old")
        at += 1
    assert outcomes == {"old", "new"}


def test_staged_files_error_leaves_directory_unchanged(old: Path) -> None:
    with pytest.raises(DataError, match="missing"), staged_files(old) as folder, atomic_write(folder / "missing" / "a"):
        (folder / "a").write_text("new")
    assert contents(old) == dict.fromkeys("abc", "old")


def test_staged_files_refuse_folder_of_same_name(old: Path) -> None:
    (old / "d").mkdir()
    with pytest.raises(DataError, match=r"/d: expected a regular file, got a folder"):
        replace(old)
    assert (old / "b").read_text() == "old"


def test_staged_files_discard_unfinished_files(old: Path) -> None:
    (StagedFiles.begin(old).folder / "b").write_text("unfinished")
    finish_replacement(old)
    assert (old / STAGED).exists()  # another process may still write these files
    replace(old)
    assert contents(old) == NEW


def test_staged_files_replace_link_instead_of_target(old: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    target = tmp_path_factory.mktemp("other") / "a"
    target.write_text("other")
    (old / "a").unlink()
    (old / "a").symlink_to(target)
    replace(old)
    assert (target.read_text(), contents(old)) == ("other", NEW)


@pytest.mark.parametrize("name", [STAGED, REPLACING])
@pytest.mark.parametrize("kind", ["link", "dangling link", "file"])
def test_staged_files_ignore_links_to_other_folders(
    old: Path, name: str, kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = tmp_path_factory.mktemp("other")
    (other / "a").write_text("other")
    if kind == "file":
        (old / name).touch()
    else:
        (old / name).symlink_to(other if kind == "link" else other / "missing")
    finish_replacement(old)
    assert (old / "a").read_text() == "old"
    replace(old)
    assert (contents(old), contents(other)) == (NEW, {"a": "other"})


def test_finish_replacement_completes_interrupted_one(old: Path) -> None:
    (old / REPLACING).mkdir()
    (old / REPLACING / "a").write_text("new")
    (old / REPLACING / "b.removed").touch()
    finish_replacement(old)
    assert contents(old) == {"a": "new", "c": "old"}


def test_finish_replacement_of_other_process_is_accepted(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (old / REPLACING).mkdir()
    (old / REPLACING / "a").write_text("new")
    replace_file = Path.replace

    def replaced_twice(path: Path, target: Path) -> Path:
        replace_file(path, target)
        path.parent.rmdir()
        return replace_file(path, target)

    monkeypatch.setattr(Path, "replace", replaced_twice)
    finish_replacement(old)
    assert contents(old) == {"a": "new", "b": "old", "c": "old"}


def test_finish_replacement_with_next_one_of_other_process_completes_both(
    old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rmdir, later = Path.rmdir, ["second", "third"]

    def removed_late(folder: Path) -> None:
        if later:
            (folder / "a").write_text(later.pop(0))
        rmdir(folder)

    (old / REPLACING).mkdir()
    (old / REPLACING / "a").write_text("first")
    monkeypatch.setattr(Path, "rmdir", removed_late)
    finish_replacement(old)
    assert (old / "a").read_text() == "third"
    assert not (old / REPLACING).exists()


def test_finish_replacement_in_read_only_folder_raises(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (old / REPLACING).mkdir()
    (old / REPLACING / "a").touch()

    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "replace", read_only)
    with pytest.raises(DataError, match=r"\.replacing: expected a writable folder .*, got an error \(Read-only file"):
        finish_replacement(old)


def test_finish_replacement_without_replacement_only_reads(old: Path) -> None:
    disk = FailingDisk(0, Fault.FAILS)
    with disk.active():
        finish_replacement(old)
    assert disk.operations == []
