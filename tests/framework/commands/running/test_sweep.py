"""Tests for sweeps with every launcher, including sweeps that are killed and restarted."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pandas
import psutil
import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf

from framework.commands.running.sweep import jobs_at_once
from framework.config.composition import one_line
from framework.files.folders.directory_lock import locked
from framework.files.search_paths import CONF
from framework.runs.provenance import config_hash
from framework.runs.run_directory import MAPPED
from tests.support.forked_commands import FAKE_CONF, completed

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

CHECKOUT = Path(__file__).resolve().parents[4]
FAILED = "error: a run failed: dataset tests.support.scenes.corner_room.CornerRoom: frames"
PLACE = Path("outputs") / "fake_ablation"
BY_JOBLIB = ("launcher=joblib", "hydra.launcher.n_jobs=2")
FAKES = [f"{stage}=fake" for stage in ("dataset", "detector", "tracker", "refiner", "fuser")]
SLOW = "dataset.slow_s=0.1"  # so that workers are killed in the middle of a run
SIX = ("row=half,broken", "seed=1,2,3", SLOW)  # six runs, of which those of the row `broken` fail
RUNS = {f"{SLOW},row=half,seed={seed}" for seed in (1, 2, 3)}
MEASURED = ("fps", "stage_ms.", "peak_rss_bytes")  # column prefixes of values that differ between runs
PATIENCE_S = 180


def begin(directory: Path, *arguments: str, sweep: str = "experiment=fake_ablation") -> subprocess.Popen[str]:
    """Start the fake experiment or another sweep in a separate process group, like a terminal."""
    fakes = ["--config-dir", str(FAKE_CONF), sweep]
    clean = {key: value for key, value in os.environ.items() if key != "HYDRA_FULL_ERROR"}
    environment = clean | {
        "PYTHONPATH": str(CHECKOUT),
        "RAY_AUTH_MODE": "disabled",  # otherwise Ray writes into the home directory
    }
    return subprocess.Popen(
        [sys.executable, "-m", "framework", *fakes, *arguments],
        cwd=directory,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def end(process: subprocess.Popen[str]) -> subprocess.CompletedProcess[str]:
    try:
        out, errors = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    return subprocess.CompletedProcess(process.args, process.returncode, out, errors)


def serial(
    directory: Path, *arguments: str, sweep: str = "experiment=fake_ablation"
) -> subprocess.CompletedProcess[str]:
    """Run a sweep without worker processes, in a forked process."""
    return completed(directory, "--config-dir", str(FAKE_CONF), sweep, *arguments, timeout=PATIENCE_S)


def wait_until(condition: Callable[[], object], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def recorded(directory: Path) -> dict[str, int]:
    """Return the completion time of each completed run, ns since the epoch, keyed by the directory name."""
    last = (directory / PLACE).glob("*/manifest.json")  # the last file of a completed run
    return {path.parent.name: path.stat().st_mtime_ns for path in last if (path.parent / "metrics.json").exists()}


def begun(directory: Path) -> dict[str, int]:
    """Return the start time of each active run, ns since the epoch, keyed by the directory name."""
    began = {path.parent.name: path.stat().st_mtime_ns for path in (directory / PLACE).glob("*/config.yaml")}
    return {name: began[name] for name in set(began) - set(recorded(directory))}


def tables(directory: Path) -> dict[str, str]:
    """Return the contents of the tables. Columns of table.csv with measured times and memory are omitted."""
    texts = {name: (directory / PLACE / name).read_text() for name in ("table.md", "table.tex")}
    runs = pandas.read_csv(directory / PLACE / "table.csv")
    kept = [key for key in runs if not key.startswith(MEASURED)]
    return texts | {"table.csv": runs[kept].to_csv()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Return the folder and the process of a finished joblib sweep. The runs of one row fail."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    directory = tmp_path_factory.mktemp("whole")
    return directory, end(begin(directory, *BY_JOBLIB, *SIX))


def test_sweep_by_joblib_continues_after_failed_runs(
    whole: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    directory, done = whole
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.count("ERROR") == 3, "expected one log line per failed run"
    assert "ERROR   #4 dataset" in done.stderr
    assert done.stderr.splitlines()[-1].startswith(
        "error: a run failed: dataset tests.support.scenes.corner_room.CornerRoom: frames"
    )
    assert set(recorded(directory)) == RUNS
    text = (directory / PLACE / "table.md").read_text()
    assert text in done.stdout
    assert f"Incomplete: {SLOW},row=broken,seed=1: failed: dataset" in text
    assert "threads=1" in text, "expected the number of threads, which affects the speed of the runs"


def test_sweep_with_other_launcher_keeps_completed_runs(
    whole: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    directory = Path(shutil.copytree(whole[0], tmp_path / "copy"))  # the table lists the other number of threads
    before = recorded(directory)
    again = serial(directory, "row=half", "seed=1,2,3", SLOW, "threads=2")
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("skipped: the completed run in") == 3
    assert recorded(directory) == before


@pytest.mark.acceptance
def test_sweep_resumed_after_kill_writes_same_table(
    whole: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    """A single worker is killed first, and then the whole sweep."""
    first = begin(tmp_path, *BY_JOBLIB, *SIX)
    wait_until(lambda: recorded(tmp_path) and begun(tmp_path), first)
    workers = [child for child in psutil.Process(first.pid).children() if "LokyProcess" in " ".join(child.cmdline())]
    workers[0].kill()
    done = end(first)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: the sweep stopped early: A worker process")
    assert "SIGKILL" in last
    assert (tmp_path / PLACE / "table.md").read_text() in done.stdout
    kept = recorded(tmp_path)
    assert 0 < len(kept) < len(RUNS)

    left = begun(tmp_path)
    second = begin(tmp_path, *BY_JOBLIB, *SIX)
    wait_until(lambda: begun(tmp_path) != left, second)
    os.killpg(second.pid, signal.SIGKILL)
    end(second)

    third = end(begin(tmp_path, *BY_JOBLIB, *SIX))
    assert third.stderr.count("skipped: the completed run in") >= len(kept)
    after = recorded(tmp_path)
    assert set(after) == RUNS
    assert {name: after[name] for name in kept} == kept
    assert tables(tmp_path) == tables(whole[0])


def test_sweep_without_experiment_reports_failures(tmp_path: Path) -> None:
    """The folder is named after the start time of the sweep, also in the worker processes."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    done = end(begin(tmp_path, *FAKES, "dataset.frames=few,many", "launcher=joblib", sweep="-m"))
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "error: a run failed: dataset tests.support.scenes.corner_room.CornerRoom: frames"
    )
    [place] = (tmp_path / "multirun").iterdir()
    assert len(list(place.glob("*dataset.frames=*/instancemap.log"))) == 2
    assert not list(place.glob("*launcher*"))


def swept(directory: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], dict[str, int]]:
    """Run a sweep without an experiment in `directory`.

    Return the process, and the completion time of each run, ns, keyed by the varying part of the directory name.
    """
    words = (*FAKES, "dataset.frames=3", "hydra.sweep.dir=s", *arguments)
    done = end(begin(directory, *words, sweep="-m")) if BY_JOBLIB[0] in words else serial(directory, *words, sweep="-m")
    assert done.returncode == 0, done.stderr
    runs = (directory / "s").glob("*/metrics.json")
    return done, {path.parent.name.partition("refiner=fake,")[2]: path.stat().st_mtime_ns for path in runs}


def test_sweep_without_experiment_is_resumed(tmp_path: Path) -> None:
    """Directory names do not contain settings without effect on the results."""
    _, first = swept(tmp_path, "seed=1,2")
    assert set(first) == {"seed=1,tracker=fake", "seed=2,tracker=fake"}
    harmless = (
        "threads=1",
        "prefetch=0",
        "detection_cache=read_write",
        f"detection_cache_dir={tmp_path}",
        "viewer=none",
    )
    done, second = swept(tmp_path, "seed=1,2,3", "skip_completed=true", "debug=false", *harmless)
    assert done.stderr.count("skipped: the completed run in") == 2
    assert set(second) == {*first, "seed=3,tracker=fake"}
    assert {name: second[name] for name in first} == first


@pytest.mark.acceptance
def test_sweep_over_settings_without_effect_has_separate_folders(tmp_path: Path) -> None:
    """If a sweep varies such a setting, the directory names contain it, also in worker processes."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    _, first = swept(tmp_path, "threads=1,2", "prefetch=0")
    assert set(first) == {"threads=1,tracker=fake", "threads=2,tracker=fake"}
    done, second = swept(tmp_path, "threads=1,2", "skip_completed=true", *BY_JOBLIB)
    assert second == first
    assert done.stderr.count("skipped: the completed run in") == 2


@pytest.mark.parametrize("signal_sent", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.acceptance
def test_sweep_signal_leaves_no_worker_processes(tmp_path: Path, signal_sent: signal.Signals) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    process = begin(tmp_path, *BY_JOBLIB, "row=all", "dataset.slow_s=1")
    wait_until(lambda: len(begun(tmp_path)) == 2, process)
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal_sent)
    sent = time.monotonic()
    done = end(process)
    assert time.monotonic() - sent < 15
    assert done.returncode == 128 + signal_sent
    assert done.stderr.splitlines()[-1] in ("interrupted by Ctrl-C", "ended by SIGTERM")
    assert not psutil.wait_procs(family, timeout=10)[1]


ENDLESS = ("dataset.frames=100000", "dataset.slow_s=0.01", "fuser.capacity=100000")


@pytest.mark.parametrize(
    ("signal_sent", "all_at_once", "n_jobs", "seeds", "at_work"),
    [
        (signal.SIGINT, False, 2, "1,2,3", 2),
        pytest.param(signal.SIGTERM, True, 2, "1,2,3", 2, marks=pytest.mark.acceptance),
        pytest.param(signal.SIGINT, True, 3, "1,2", 2, marks=pytest.mark.acceptance),  # more workers than runs
        pytest.param(signal.SIGINT, False, 1, "1,2", 1, marks=pytest.mark.acceptance),  # joblib starts no worker
    ],
)
def test_sweep_signal_leaves_partial_outputs_of_active_runs(
    tmp_path: Path, signal_sent: signal.Signals, all_at_once: bool, n_jobs: int, seeds: str, at_work: int
) -> None:
    """Ctrl-C in a terminal also signals the workers. `kill` signals only the main process."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    by_joblib = (*BY_JOBLIB, f"hydra.launcher.n_jobs={n_jobs}")
    process = begin(tmp_path, *by_joblib, "row=all", f"seed={seeds}", *ENDLESS, "fuser.note=${seed}.note")
    wait_until(lambda: len(list(tmp_path.glob("*.note"))) == at_work, process)
    if all_at_once:
        os.killpg(process.pid, signal_sent)
    else:
        process.send_signal(signal_sent)
    done = end(process)
    assert done.returncode == 128 + signal_sent
    ending = "after the active runs have written their outputs" if n_jobs > 1 else "after this frame"
    assert done.stderr.count(f"stopping {ending}; a second signal stops immediately") == 1
    assert done.stderr.splitlines()[-1] in ("interrupted by Ctrl-C", "ended by SIGTERM")
    assert "Traceback" not in done.stderr
    partial = list((tmp_path / PLACE).glob("*/metrics.partial.json"))
    assert len(partial) == at_work
    for file in partial:
        how = "ended by SIGTERM" if n_jobs > 1 else "interrupted by Ctrl-C"
        assert json.loads(file.read_text())["partial"] == how
        assert {path.name for path in file.parent.iterdir()} >= set(MAPPED)


@pytest.mark.acceptance
def test_sweep_second_signal_ends_workers_immediately(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    slow_record = ("fuser.slow_save_s=100", "fuser.note=${seed}.note")
    process = begin(tmp_path, *BY_JOBLIB, "row=all", "seed=1,2", *ENDLESS, *slow_record)
    wait_until(lambda: len(list(tmp_path.glob("*.note"))) == 2, process)
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    wait_until(lambda: len(list((tmp_path / PLACE).glob("*/mesh.ply"))) == 2, process)
    process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    done = end(process)
    assert time.monotonic() - sent < 15
    assert done.returncode == 128 + signal.SIGINT
    assert not psutil.wait_procs(family, timeout=10)[1]
    partial = [json.loads(path.read_text()) for path in (tmp_path / PLACE).glob("*/metrics.partial.json")]
    assert [each["frames"] > 0 for each in partial] == [True, True]


def running_after(seconds: float, processes: list[psutil.Process]) -> list[psutil.Process]:
    """Return the processes that are still running after some seconds, without zombies."""
    deadline = time.monotonic() + seconds
    while left := [one for one in processes if one.is_running() and one.status() != psutil.STATUS_ZOMBIE]:
        if time.monotonic() > deadline:
            return left
        time.sleep(0.1)
    return []


@pytest.mark.parametrize("signaled", [False, pytest.param(True, marks=REPEATED)])
def test_sweep_killed_leaves_partial_outputs_only(tmp_path: Path, signaled: bool) -> None:
    """If the main process is killed, the workers write partial outputs and exit, even if they get no signal."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    process = begin(tmp_path, *BY_JOBLIB, "row=all", "seed=1,2,3", *ENDLESS, "fuser.note=${seed}.note")
    wait_until(lambda: len(list(tmp_path.glob("*.note"))) == 2, process)
    family = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    for worker in family if signaled else ():
        worker.terminate()
    assert not running_after(10, family)
    process.communicate()
    partial = [json.loads(path.read_text()) for path in (tmp_path / PLACE).glob("*/metrics.partial.json")]
    assert [(each["partial"], each["frames"] > 0) for each in partial] == [("ended by SIGTERM", True)] * 2


@pytest.mark.parametrize("state", ["starting", "writing"])
@pytest.mark.acceptance
def test_sweep_killed_leaves_no_processes(tmp_path: Path, state: str) -> None:
    """Workers also exit if they are still starting, or if they take too long to write."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    process = begin(tmp_path, *BY_JOBLIB, "row=all", "seed=1,2", "fuser.slow_save_s=100", "fuser.capacity=100000")
    root = psutil.Process(process.pid)
    if state == "starting":
        wait_until(lambda: any("LokyProcess" in " ".join(one.cmdline()) for one in root.children()), process)
    else:
        wait_until(lambda: len(list((tmp_path / PLACE).glob("*/mesh.ply"))) == 2, process)
    family = root.children(recursive=True)
    process.kill()
    assert not running_after(10, family)
    process.communicate()


@pytest.mark.acceptance
def test_sweep_waits_for_runs_of_killed_sweep(tmp_path: Path) -> None:
    """The workers of a killed sweep first write their partial outputs. Then the next sweep repeats the runs."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    arguments = (*BY_JOBLIB, "row=half", "dataset.slow_s=1")
    first = begin(tmp_path, *arguments)
    wait_until(lambda: len(begun(tmp_path)) == 2, first)
    workers = psutil.Process(first.pid).children(recursive=True)
    for worker in workers:
        worker.suspend()  # until the second sweep waits; the result then does not depend on the speed of the machine
    first.kill()
    again = begin(tmp_path, *arguments)
    logs = (tmp_path / PLACE).glob
    wait_until(lambda: sum("waiting for" in log.read_text() for log in logs("*/instancemap.log")) == 2, again)
    for worker in workers:
        worker.resume()
    done = end(again)
    first.communicate()
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("in use by process") == 2
    assert done.stderr.count("mapping") == len(recorded(tmp_path)) == 2


def test_sweep_in_locked_folder_is_rejected(tmp_path: Path) -> None:
    with locked(tmp_path / PLACE):
        done = serial(tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert (
        f"error: {tmp_path / PLACE}: expected an unlocked directory, got a directory in use by process {os.getpid()} "
        in done.stderr
    )
    assert not (tmp_path / PLACE / "multirun.yaml").exists()


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        pytest.param(
            "hydra_plugins.hydra_submitit_launcher",
            ["launcher=submitit_local"],
            marks=pytest.mark.acceptance,
        ),
        pytest.param(
            "hydra_plugins.hydra_ray_launcher",
            ["launcher=ray", "hydra.launcher.ray.init.num_cpus=2"],
            marks=pytest.mark.acceptance,
        ),
    ],
)
def test_cluster_launchers_run_locally(tmp_path: Path, package: str, arguments: list[str]) -> None:
    pytest.importorskip(package)
    done = end(begin(tmp_path, *arguments, "row=half,broken", "seed=1"))
    assert done.returncode == 1, done.stderr
    assert set(recorded(tmp_path)) == {"row=half,seed=1"}
    assert OmegaConf.load(tmp_path / PLACE / "row=half,seed=1" / "config.yaml").threads == 1
    assert "Traceback" not in done.stderr
    assert "error: a run failed: dataset tests.support.scenes.corner_room.CornerRoom: frames" in done.stderr
    assert (tmp_path / PLACE / "table.md").read_text() in done.stdout


# Tests without a process


def test_launcher_missing_error_names_extra() -> None:
    error = MissingConfigException("?", missing_cfg_file="hydra/launcher/submitit_slurm", options=["basic"])
    assert one_line(error).endswith("pip install 'instancemap[slurm]'")


@pytest.mark.parametrize(("threads", "jobs"), [(1, 12), (5, 2), (12, 1), (13, 1), (0, 1)])
def test_jobs_at_once_depends_on_threads_and_cores(monkeypatch: pytest.MonkeyPatch, threads: int, jobs: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(12))
    assert jobs_at_once(threads) == jobs


@pytest.mark.parametrize(
    ("launcher", "node"), [("joblib", "n_jobs"), ("slurm", "cpus_per_task"), ("ray", "ray.remote.num_cpus")]
)
def test_launcher_config_uses_job_threads(launcher: str, node: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine has 12 cores, and threads=0 means all cores."""
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.replace('slurm', 'submitit')}_launcher")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(12))
    for threads in (3, 0):
        with initialize_config_dir(str(CONF), version_base="1.3"):
            own = compose("config", [f"launcher={launcher}", f"threads={threads}"], return_hydra_config=True)
        cores = threads or 12
        assert OmegaConf.select(own.hydra.launcher, node) == (12 // cores if launcher == "joblib" else cores)
        assert own.hydra.job.env_set.TQDM_DISABLE == "1"


def test_config_hash_ignores_threads() -> None:
    assert config_hash({"seed": 1, "threads": 0}) == config_hash({"seed": 1, "threads": 8})
