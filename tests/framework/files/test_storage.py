"""Tests for the distinction between lost storage and a damaged or missing file."""

from __future__ import annotations

import errno
import os
import sqlite3
from pathlib import Path

import pytest

from framework.errors import DataError, FrameError, StorageError
from framework.files.image_files import read_image_file
from framework.files.storage import DEVICE_ERRORS, check_storage


def frame_error(path: Path) -> FrameError:
    with pytest.raises(FrameError) as error:
        read_image_file(path)
    return error.value


def caused_by(cause: Exception) -> FrameError:
    """Return the error of a frame with an indirect cause."""
    error, between = FrameError("frame 6: expected an image, got an error"), DataError("a file")
    error.__cause__, between.__cause__ = between, cause
    return error


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "color").mkdir()
    (tmp_path / "color/1.png").touch()
    return tmp_path / "color"


def test_check_storage_missing_file_passes(folder: Path) -> None:
    check_storage(frame_error(folder / "0.png"), folder.parent)
    check_storage(FrameError("0.png: expected an image, got an empty file"), folder.parent)


@pytest.mark.parametrize("kept", ["nothing", "folder"])
def test_check_storage_missing_or_empty_folder_raises(folder: Path, kept: str) -> None:
    (folder / "1.png").unlink()
    if kept == "nothing":
        folder.rmdir()
    with pytest.raises(StorageError, match=r"color: expected available storage, got an error \((No such|empty folder)"):
        check_storage(frame_error(folder / "0.png"))


def test_check_storage_unreadable_folder_raises(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    error = frame_error(folder / "0.png")
    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(StorageError, match="Permission denied"):
        check_storage(error)


def test_check_storage_missing_recording_raises(tmp_path: Path) -> None:
    (tmp_path / "room.mp4").touch()
    check_storage(FrameError("frame 6: expected a decodable image, got none"), tmp_path / "room.mp4")
    (tmp_path / "room.mp4").unlink()
    with pytest.raises(StorageError, match=r"room\.mp4: expected available storage"):
        check_storage(FrameError("frame 6: expected a decodable image, got none"), tmp_path / "room.mp4")


@pytest.mark.parametrize("number", sorted(DEVICE_ERRORS))
def test_check_storage_device_error_raises(number: int) -> None:
    with pytest.raises(StorageError, match="recording: expected available storage, got an error"):
        check_storage(caused_by(OSError(number, os.strerror(number))))


def test_check_storage_disk_error_of_database_raises() -> None:
    error = sqlite3.OperationalError("disk I/O error")
    check_storage(caused_by(error))
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR_READ
    with pytest.raises(StorageError, match="disk I/O error"):
        check_storage(caused_by(error))
