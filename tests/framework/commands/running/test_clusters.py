"""Tests for sweeps on clusters that preempt jobs or remove nodes. A resumed sweep must write identical tables."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.framework.commands.running.test_sweep import CHECKOUT, PLACE, begin, begun, end, recorded, tables, wait_until

pytestmark = pytest.mark.acceptance

THREE = ("row=half", "seed=1,2,3", "dataset.slow_s=0.7", "threads=1")  # three runs of four frames each


def mapping(directory: Path) -> dict[int, str]:
    """Return the names of the active runs, keyed by the process that holds the lock of the run directory."""
    holders = {}
    for name in begun(directory):
        words = (directory / PLACE / name / ".lock_holder").read_text().split()
        holders[int(words[1])] = name
    return holders


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the tables of a sweep that was not interrupted and executed its runs one after another."""
    directory = tmp_path_factory.mktemp("undisturbed")
    done = end(begin(directory, *THREE))
    assert done.returncode == 0, done.stderr
    return tables(directory)


def test_slurm_sweep_resumes_preempted_and_killed_jobs(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """One job gets the signal that SLURM sends before preemption, another one gets SIGKILL.

    The queue is that of submitit.
    """
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    arguments = ("launcher=submitit_local", *THREE)
    first = begin(tmp_path, *arguments)
    wait_until(lambda: len(mapping(tmp_path)) == 3, first)
    preempted, killed, _ = map(psutil.Process, mapping(tmp_path))
    preempted.send_signal(signal.SIGUSR2)
    # the process of the queue first, because it would end the job normally
    for process in (*killed.parents()[:1], killed):
        process.kill()
    done = end(first)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "error: the sweep stopped early: Job" in done.stderr
    logs = [path.read_text() for path in (tmp_path / PLACE).rglob("*_log.err")]
    assert sum("this job is preempted" in text for text in logs) == 1

    again = end(begin(tmp_path, *arguments))
    assert again.returncode == 0, again.stderr
    assert len(recorded(tmp_path)) == 3
    assert tables(tmp_path) == undisturbed
    assert not list((tmp_path / PLACE).glob("*/metrics.partial.json"))


@pytest.fixture
def ray_cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """Start a Ray cluster. Its head node runs no jobs."""
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    yield cluster
    cluster.shutdown()


def test_ray_sweep_restarts_run_of_removed_node(
    tmp_path: Path, undisturbed: dict[str, str], ray_cluster: object
) -> None:
    nodes = [ray_cluster.add_node(num_cpus=1) for _ in range(2)]
    sweep = begin(tmp_path, "launcher=ray", f"hydra.launcher.ray.init.address={ray_cluster.address}", *THREE)
    wait_until(lambda: len(mapping(tmp_path)) == 2, sweep)
    at_work = mapping(tmp_path)
    ray_cluster.remove_node(nodes[0], allow_graceful=False)
    done = end(sweep)
    assert done.returncode == 0, done.stderr
    assert len(recorded(tmp_path)) == 3
    assert tables(tmp_path) == undisturbed
    assert not all(psutil.pid_exists(pid) for pid in at_work), (
        "expected one process to be gone, because its run was restarted"
    )


def test_ray_sweep_restarted_after_failure_resumes(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    here = ("launcher=ray", "hydra.launcher.ray.init.num_cpus=1", *THREE)
    sweep = begin(tmp_path, *here, "hydra.launcher.ray.remote.max_retries=0")
    wait_until(lambda: recorded(tmp_path) and mapping(tmp_path), sweep)
    [worker] = mapping(tmp_path)
    os.kill(worker, signal.SIGKILL)
    done = end(sweep)
    assert done.returncode == 1
    assert "error: the sweep stopped early: " in done.stderr
    kept = recorded(tmp_path)
    assert 0 < len(kept) < 3

    again = end(begin(tmp_path, *here))
    assert again.returncode == 0, again.stderr
    after = recorded(tmp_path)
    assert {name: after[name] for name in kept} == kept
    assert tables(tmp_path) == undisturbed
