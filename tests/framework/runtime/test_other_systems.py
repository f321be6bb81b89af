"""Tests for commands on systems without the Linux-specific and POSIX modules of Python."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]
FAKES = [f"{stage}=fake" for stage in ("dataset", "detector", "tracker", "refiner", "fuser")]

ELSEWHERE = """
import errno, fcntl, os, signal, sys

flags, synced, opened = fcntl.fcntl, os.fsync, os.open

def fsync(descriptor):
    assert flags(descriptor, 3) & os.O_ACCMODE, "Windows syncs only writable files"  # 3: F_GETFL
    synced(descriptor)

def open_file(path, *arguments, **named):
    if os.path.isdir(path) and "dir_fd" not in named:
        raise PermissionError(errno.EACCES, "Windows cannot open folders")
    return opened(path, *arguments, **named)

os.fsync, os.open = fsync, open_file
sys.modules["fcntl"] = sys.modules["resource"] = None
del os.sched_getaffinity, signal.SIGPIPE
from framework.__main__ import main
main()
"""


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="requires a system with these modules")
def test_commands_run_without_linux_specific_modules(tmp_path: Path) -> None:
    def start(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    options = ["--config-dir", str(CHECKOUT / "tests" / "support" / "fake_conf"), f"hydra.run.dir={tmp_path}"]
    start(*options, *FAKES, "dataset.frames=2")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["frames"], metrics["peak_rss_bytes"]) == (2, None)
    assert "AP50" in start("tables", str(tmp_path))
    assert "bayesian_tsdf" in start("plugins", "fuser")
