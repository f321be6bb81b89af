"""The command `ranks` as a user meets it."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

from tests.framework.tables.test_ranks import experiment
from tests.support.doc_pages import CHECKOUT, LINES

RANKS = "python -m framework ranks "
FIGURES = {"a": (0.9,), "b": (0.8,), "c": (0.7,), "d": (0.6,)}


def start(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "framework", "ranks", *arguments]
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(CHECKOUT), "HOME": str(directory)}
    return subprocess.run(line, cwd=directory, env=environment, capture_output=True, text=True, timeout=120)


def test_the_command_of_the_pages_prints_and_writes(tmp_path: Path) -> None:
    [command] = [line.removeprefix(RANKS) for line in LINES if line.startswith(RANKS)]
    folders = [word for word in shlex.split(command) if word.startswith("outputs/ranks_")]
    assert len(folders) == 3
    for folder in folders:
        experiment(tmp_path / folder, FIGURES)
    done = start(tmp_path, *shlex.split(command))
    assert done.returncode == 0, done.stderr
    [out] = tmp_path.rglob("ranks.md")
    assert out.read_text() == done.stdout
    assert out.with_name("ranks.csv").exists()
    assert "+1.00" in done.stdout


def test_a_fault_is_one_line_and_a_status(tmp_path: Path) -> None:
    experiment(tmp_path / "rooms", FIGURES)
    done = start(tmp_path, "rooms", "flat")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: flat is not a folder with records of runs\n"
