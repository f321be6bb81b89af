"""Worker processes of a parallel sweep. A worker ends when its sweep ends or is killed."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process

from framework.runtime.signals import received_from_sweep, signal_received

POLL_S = 0.5  # interval between checks of the parent process, s
GRACE_S = 7.0  # maximum time to write partial outputs after the end of the parent process, s

_job = threading.Lock()  # held while this process executes a job


@contextmanager
def job_of_worker() -> Iterator[None]:
    """Run a job of the sweep in the `with` body.

    SIGTERM or the end of the parent process ends the job, with partial outputs.

    Raises:
        Interrupted: SIGTERM arrived before the job.
    """
    with _job:
        received_from_sweep().check()
        yield


def end_with_parent() -> None:
    """Start a thread that ends this process after the end of its parent process.

    joblib calls this function in each new worker. Otherwise, workers of a killed sweep would wait for jobs until the
    time limit of joblib.
    """
    threading.Thread(target=_wait_for_end_of_parent, daemon=True).start()


def _wait_for_end_of_parent() -> None:
    while not _parent_has_ended():
        time.sleep(POLL_S)
    if not _job.acquire(blocking=False):
        if not signal_received():  # a second signal would end the job without partial outputs
            os.kill(os.getpid(), signal.SIGTERM)
        _job.acquire(timeout=GRACE_S)
    os._exit(1)  # the main thread may be blocked in joblib's queue


def _parent_has_ended() -> bool:
    parent = parent_process()
    assert parent is not None
    # POSIX assigns another parent to the process; Windows keeps the id of the parent
    return not parent.is_alive() if os.name == "nt" else os.getppid() != parent.pid
