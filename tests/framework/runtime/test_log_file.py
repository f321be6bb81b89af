"""Tests for the log file of a run."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from framework.runtime.log_file import LogFile


def log_lines(file: LogFile) -> None:
    log = logging.getLogger("framework.test")
    log.addHandler(file)
    logging.getLogger("framework").addHandler(file)  # like the root handler, which also receives the warning
    try:
        log.warning("first")
        log.warning("second")
    finally:
        log.removeHandler(file)
        logging.getLogger("framework").removeHandler(file)
        file.close()


def test_log_file_contains_messages(tmp_path: Path) -> None:
    file = LogFile(str(tmp_path / "run.log"))
    assert (tmp_path / "run.log").exists()
    log_lines(file)
    assert (tmp_path / "run.log").read_text().splitlines()[::2] == ["first", "second"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing/run.log", "No such file or directory"),
        ("folder", "Is a directory"),
        pytest.param(
            "/dev/full",
            "No space left on device",
            marks=pytest.mark.skipif(not Path("/dev/full").exists(), reason="requires /dev/full"),
        ),
    ],
)
def test_log_file_not_writable_warns_once(
    name: str, reason: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder").mkdir()
    log_lines(LogFile(str(tmp_path / name)))
    [warning] = set(caplog.messages) - {"first", "second"}
    assert f"{name}: expected a writable file, got an error ({reason}); the log is not complete" in warning
    assert len(caplog.messages) == 3
    assert capsys.readouterr().err == ""
