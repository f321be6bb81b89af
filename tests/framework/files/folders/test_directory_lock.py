"""Tests for directory locks. A lock must be released when its process ends."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.files.folders.directory_lock import HOLDER, is_locked, locked, new_directory

pytestmark = pytest.mark.integration


def test_directory_lock_second_lock_error_names_holder(tmp_path: Path) -> None:
    place = tmp_path / "new" / "sweep"
    with (
        locked(place),
        pytest.raises(
            DataError,
            match=rf"sweep: expected an unlocked directory, got a directory in use by process {os.getpid()} on ",
        ),
        locked(place),
    ):
        pytest.fail("two processes hold the lock")
    with locked(place):
        pass


def test_is_locked_reports_lock_state(tmp_path: Path) -> None:
    assert not is_locked(tmp_path)
    assert not list(tmp_path.iterdir())
    with locked(tmp_path):
        assert is_locked(tmp_path)
    assert not is_locked(tmp_path)


def test_directory_lock_is_released_on_error(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        raise ZeroDivisionError
    with locked(tmp_path):
        pass


def test_directory_lock_waiting_is_acquired_after_release(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    order: list[str] = []

    def second() -> None:
        with locked(tmp_path, wait=True):
            order.append("second")

    with locked(tmp_path):
        waiting = threading.Thread(target=second)
        waiting.start()
        waiting.join(0.2)
        order.append("first")
    waiting.join(10)
    assert order == ["first", "second"]
    assert f"in use by process {os.getpid()}" in caplog.text


def test_directory_lock_of_killed_process_is_released(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
from framework.files.folders.directory_lock import locked
with locked(Path({str(tmp_path)!r})):
    print("locked", flush=True)
    input()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"locked\n"
        with pytest.raises(DataError, match=f"in use by process {holder.pid} on "), locked(tmp_path):
            pytest.fail("two processes hold the lock")
        holder.kill()
    with locked(tmp_path):
        pass


def test_directory_lock_unsupported_file_system_logs_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with locked(tmp_path):
        pass
    assert "expected a file system with locks, got an error (No locks available)" in caplog.text


def test_directory_lock_named_pipe_as_holder_file_raises(tmp_path: Path) -> None:
    """Opening a pipe without a reader would block."""
    os.mkfifo(tmp_path / HOLDER)
    with pytest.raises(DataError, match=rf"{HOLDER}: expected a regular file, got a device, a pipe"), locked(tmp_path):
        pytest.fail("expected an error before the lock is acquired")


def test_directory_lock_invalid_holder_file_raises_in_use(tmp_path: Path) -> None:
    with locked(tmp_path):
        for make in (os.mkfifo, Path.mkdir, lambda path: path.write_bytes(b"\xff\xfe")):
            (tmp_path / HOLDER).unlink()
            make(tmp_path / HOLDER)
            with pytest.raises(DataError, match="in use by another process"), locked(tmp_path):
                pytest.fail("two processes hold the lock")
            if (tmp_path / HOLDER).is_dir():
                (tmp_path / HOLDER).rmdir()
                (tmp_path / HOLDER).touch()


def test_new_directory_concurrent_calls_are_distinct(tmp_path: Path) -> None:
    wanted = str(tmp_path / "outputs" / "now")
    with ThreadPoolExecutor(8) as processes:
        made = list(processes.map(new_directory, [wanted] * 40))
    assert set(made) == {wanted, *(f"{wanted}_{number}" for number in range(2, 41))}
    assert len(made) == len(list((tmp_path / "outputs").iterdir())) == 40


def test_new_directory_creation_failure_raises(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match=r"run: expected a writable parent folder, got "):
        new_directory(str(tmp_path / "file" / "run"))
