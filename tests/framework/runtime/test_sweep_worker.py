"""Tests for worker processes whose parent process has been killed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from framework.runtime.sweep_worker import POLL_S

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]
IDLE_WORKERS = """
import os, sys, time
from joblib import Parallel, delayed
from framework.runtime.sweep_worker import end_with_parent

initializer = end_with_parent if sys.argv[1] == "watched" else None
workers = Parallel(n_jobs=2, backend="loky", initializer=initializer)
print(*workers(delayed(os.getpid)() for _ in range(8)), flush=True)
time.sleep(100)
"""


@pytest.mark.parametrize("watched", ["watched", "unwatched"])
def test_idle_worker_ends_with_killed_parent(watched: str) -> None:
    """Without the watchdog, the workers of joblib would continue to wait."""
    pytest.importorskip("joblib")
    process = subprocess.Popen(
        [sys.executable, "-c", IDLE_WORKERS, watched], cwd=CHECKOUT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    workers = [psutil.Process(int(pid)) for pid in set(process.stdout.readline().split())]
    assert workers
    process.kill()
    process.wait()
    left = psutil.wait_procs(workers, timeout=4 * POLL_S + 1)[1]
    for worker in left:
        worker.kill()
    assert bool(left) == (watched == "unwatched")
    process.stdout.close()
