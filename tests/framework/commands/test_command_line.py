"""Tests for the directory names of sweeps, the exit of commands, and config directories."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from framework.commands.command_line import _config_dirs, directory_name, print_for_directories
from framework.errors import DataError

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values


def test_directory_name_is_built_from_overrides() -> None:
    assert directory_name("dataset.root=../a/b,seed=1") == "dataset.root=.._a_b,seed=1"
    assert directory_name("") == "defaults"
    assert directory_name(r"fuser.note=$\{seed\}.note") == "fuser.note=$seed}.note"


def test_directory_name_of_long_overrides_is_short_and_unique() -> None:
    names = [directory_name("dataset.root=" + 300 * "x" + f",seed={seed}") for seed in range(2)]
    assert names[0] != names[1]
    assert all(len(name) <= 200 for name in names)


def test_print_for_directories_continues_after_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(directory: Path, overrides: Sequence[str]) -> str:
        if directory.name == "empty":
            raise DataError("there is nothing")
        return " ".join([directory.name, *overrides])

    monkeypatch.setattr(
        sys, "argv", ["command", *(str(tmp_path / name) for name in ("a", "empty", "b")), "table.base=x"]
    )
    with pytest.raises(SystemExit) as ended:
        print_for_directories("", "", "table", write)
    assert ended.value.code == 1
    assert capsys.readouterr() == ("a table.base=x\nb table.base=x\n", "error: there is nothing\n")


@pytest.mark.parametrize(
    "command", ["tables", "plugins", *(pytest.param(name, marks=REPEATED) for name in ("figures", "evaluate"))]
)
def test_command_with_closed_pipe_ends_without_output(command: str) -> None:
    """An example is `python -m framework tables DIR | head -1`."""
    reader, writer = os.pipe()
    os.close(reader)
    arguments = [sys.executable, "-m", "framework", command, "--help"]
    ended = subprocess.run(arguments, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (-signal.SIGPIPE, b"")


@pytest.mark.parametrize(
    ("words", "folders"),
    [
        ([], []),
        (["--config-dir"], [""]),
        (["--config-dir", "mine", "seed=1", "--config-dir=theirs"], ["mine", "theirs"]),
    ],
)
def test_config_dirs_are_read_from_command_line(words: list[str], folders: list[str]) -> None:
    """Without arguments, the command maps the desk and has no config directories."""
    assert _config_dirs(words) == [Path(folder) for folder in folders]
