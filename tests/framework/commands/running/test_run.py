"""Tests for complete, partial and failed runs and their run directories."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import psutil
import pytest

from framework.files.folders.directory_lock import locked
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.source import DeviceFrame, Source
from framework.runs.stored_runs import MAPPED
from framework.testing.corner_room import frame_at
from tests.support.forked_commands import FAKE_CONF, ForkedCommand
from tests.support.noted_calls import CALLS

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

CHECKOUT = Path(__file__).resolve().parents[4]
FAKES = [f"{stage}=fake" for stage in ("dataset", "detector", "tracker", "refiner", "fuser")]
SMALL = ("trajectory.txt", "timings.csv", "instances.json")
ENDLESS = ("dataset.frames=100000", "dataset.slow_s=0.01", "fuser.capacity=100000", "fuser.note=note")
PATIENCE_S = 120
CAPACITY = "fuser.capacity: expected at most 1 frames, got more; increase fuser.capacity"


def begin(directory: Path, *arguments: str, before: Callable[[], object] | None = None) -> ForkedCommand:
    """Start a run with fake stages in `directory`. The process calls `before` first."""
    return ForkedCommand(directory, "--config-dir", str(FAKE_CONF), *FAKES, *arguments, before=before)


def end(process: ForkedCommand) -> tuple[int | None, str]:
    """Wait for the process and return its exit status and stderr."""
    try:
        _, stderr = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, stderr


def wait_for(file: Path, process: ForkedCommand) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not file.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.01)


def figures(directory: Path, name: str = "metrics.partial.json") -> dict[str, object]:
    read: dict[str, object] = json.loads((directory / name).read_text())
    return read


def limit_file_size() -> None:
    """Limit the size of files to 64 KiB, so that larger writes fail like on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))


def ignore_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@pytest.mark.parametrize(
    ("number", "background"),
    [
        (signal.SIGTERM, False),
        (signal.SIGXCPU, False),
        (signal.SIGHUP, True),
        *(pytest.param(number, False, marks=REPEATED) for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)),
        *(
            pytest.param(number, True, marks=REPEATED)
            for number in (signal.SIGTERM, signal.SIGXCPU, signal.SIGUSR1, signal.SIGUSR2)
        ),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_run_signal_leaves_partial_outputs(tmp_path: Path, number: signal.Signals, background: bool) -> None:
    """A run in the background of a shell script ignores Ctrl-C, but other signals end the run."""
    place = tmp_path / "run"
    process = begin(tmp_path, *ENDLESS, f"hydra.run.dir={place}", before=ignore_ctrl_c if background else None)
    wait_for(tmp_path / "note", process)
    process.send_signal(number)
    status, stderr = end(process)
    assert status == 128 + number
    assert "Traceback" not in stderr
    assert f"ended by {number.name}: stopping after this frame; a second signal stops immediately" in stderr
    assert stderr.splitlines()[-1] == f"ended by {number.name}"
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.partial.json"}
    assert figures(place)["partial"] == f"ended by {number.name}"
    assert not (place / "metrics.json").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGXCPU, marks=REPEATED)])
def test_run_repeated_sigxcpu_completes_partial_outputs(tmp_path: Path, number: signal.Signals) -> None:
    """The kernel sends SIGXCPU every second, also while the outputs are written."""
    place = tmp_path / "run"
    process = begin(tmp_path, *ENDLESS, "fuser.slow_save_s=1", f"hydra.run.dir={place}")
    wait_for(tmp_path / "note", process)
    process.send_signal(number)
    while process.poll() is None:
        process.send_signal(signal.SIGXCPU)
        time.sleep(0.02)
    status, stderr = end(process)
    assert (status, stderr.splitlines()[-1]) == (128 + number, f"ended by {number.name}")
    assert "Traceback" not in stderr
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.partial.json", "manifest.json"}
    assert figures(place)["partial"] == f"ended by {number.name}"
    assert figures(place, "manifest.json")["status"] == "PARTIAL"


def test_run_cpu_limit_leaves_partial_outputs(tmp_path: Path) -> None:
    place = tmp_path / "run"
    process = begin(tmp_path, *ENDLESS, f"hydra.run.dir={place}")
    wait_for(tmp_path / "note", process)
    used = sum(psutil.Process(process.pid).cpu_times()[:2])
    resource.prlimit(process.pid, resource.RLIMIT_CPU, (int(used) + 1, int(used) + 60))
    status, stderr = end(process)
    assert (status, stderr.splitlines()[-1]) == (128 + signal.SIGXCPU, "ended by SIGXCPU")
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.partial.json"}


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("OSError", "OSError: weights.bin: Input/output error"),
        pytest.param("ValueError", "ValueError: operands could not be broadcast together", marks=REPEATED),
        pytest.param("MemoryError", "MemoryError: Unable to allocate 40 GiB", marks=REPEATED),
        ("masks", "masks"),
    ],
)
def test_run_stage_error_leaves_partial_outputs(tmp_path: Path, kind: str, message: str) -> None:
    place = tmp_path / "run"
    status, stderr = end(begin(tmp_path, "detector=faulty", f"detector.kind={kind}", f"hydra.run.dir={place}"))
    assert status == 3
    assert message in stderr.splitlines()[-1] or message in stderr
    assert "ERROR" in stderr
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.partial.json"}
    left = figures(place)
    assert message in str(left["partial"])
    assert left["frames"] in (3, 4)  # a detector error is raised before the frame is counted, a mask error after that
    assert len((place / "trajectory.txt").read_text().splitlines()) in (3, 4)


def test_run_lost_recording_leaves_partial_outputs(tmp_path: Path) -> None:
    """A sweep repeats the run when the disk is connected again."""
    recording, place = tmp_path / "recording", tmp_path / "sweep" / "run"
    frames = [frame_at(k % 4) for k in range(40)]
    given = [
        DeviceFrame(f"{k}", k / 30, one.camera, one.color, one.depth, None, one.T_world_camera)
        for k, one in enumerate(frames)
    ]
    write_folder(
        Source("a test", [partial(lambda stored: stored, one) for one in given], 40, posed=True), recording, Writing()
    )
    words = (
        *("hydra.mode=MULTIRUN", f"hydra.sweep.dir={place.parent}", "hydra.sweep.subdir=run", "skip_completed=true"),
        *("dataset=rgbd_folder", f"dataset.root={recording}", "fuser.note=note", "fuser.slow_s=0.05", "detector=none"),
    )
    process = begin(tmp_path, *words)
    wait_for(tmp_path / "note", process)
    recording.rename(tmp_path / "unplugged")
    status, stderr = end(process)
    assert status == 1
    assert "Traceback" not in stderr
    assert "expected available storage, got an error" in str(figures(place)["partial"])
    left = figures(place)
    assert left["frames_skipped"] == 0
    assert 0 < left["frames"] == len((place / "trajectory.txt").read_text().splitlines()) < 40
    assert figures(place, "manifest.json")["status"] == "PARTIAL"
    assert not (place / "metrics.json").exists()
    (tmp_path / "unplugged").rename(recording)
    assert end(begin(tmp_path, *words))[0] == 0
    assert (figures(place, "metrics.json")["frames"], figures(place, "manifest.json")["status"]) == (40, "COMPLETE")


def test_run_folder_deleted_during_run_is_recreated(tmp_path: Path) -> None:
    place = tmp_path / "run"
    process = begin(tmp_path, *ENDLESS, "dataset.frames=100", f"hydra.run.dir={place}")
    wait_for(tmp_path / "note", process)
    config = (place / "config.yaml").read_bytes()
    shutil.rmtree(place)
    assert end(process)[0] == 0
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.json"}
    assert (place / "config.yaml").read_bytes() == config


def test_run_error_before_first_frame_leaves_no_outputs(tmp_path: Path) -> None:
    place = tmp_path / "run"
    status, _ = end(begin(tmp_path, "detector=faulty", "detector.at=0", f"hydra.run.dir={place}"))
    assert status == 1
    assert {path.name for path in place.iterdir()}.isdisjoint({*MAPPED, "metrics.partial.json", "metrics.json"})


def test_run_stage_system_exit_writes_partial_outputs(tmp_path: Path) -> None:
    """In a preempted job, submitit raises SystemExit."""
    place = tmp_path / "run"
    status, _ = end(begin(tmp_path, "detector=faulty", "detector.kind=SystemExit", f"hydra.run.dir={place}"))
    assert status == 7
    assert figures(place)["frames"] == 3


def test_run_on_full_disk_writes_small_files(tmp_path: Path) -> None:
    place = tmp_path / "run"
    place.mkdir()
    (place / "mesh.ply").write_text("of an earlier run")
    status, stderr = end(begin(tmp_path, f"hydra.run.dir={place}", before=limit_file_size))
    assert status == 3
    assert "Traceback" not in stderr
    left = {path.name for path in place.iterdir()}
    assert left >= {*SMALL, "metrics.partial.json"}
    assert left.isdisjoint({"mesh.ply", "map.npz", "metrics.json"})
    assert not list(place.glob(".*partial*"))
    fault = str(figures(place)["partial"])
    assert fault.startswith(f"{place / 'map.npz'}: expected a writable file, got an error (")
    assert figures(place)["instances.ap50"] == 1.0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=REPEATED)])
def test_run_signal_during_saving_completes_outputs(tmp_path: Path, number: signal.Signals) -> None:
    place = tmp_path / "run"
    process = begin(tmp_path, "fuser.slow_save_s=1", f"hydra.run.dir={place}")
    wait_for(place / "metrics.partial.json", process)
    process.send_signal(number)
    status, stderr = end(process)
    assert status == 0, stderr
    assert "stopping after the outputs are written; a second signal stops immediately" in stderr
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.json"}
    assert not (place / "metrics.partial.json").exists()


def test_run_second_signal_in_saving_leaves_complete_files(tmp_path: Path) -> None:
    place = tmp_path / "run"
    process = begin(tmp_path, "fuser.slow_save_s=30", f"hydra.run.dir={place}")
    wait_for(place / "metrics.partial.json", process)
    time.sleep(0.2)
    for number in (signal.SIGINT, signal.SIGTERM):
        process.send_signal(number)
        time.sleep(0.3)
    status, stderr = end(process)
    assert status == 143, stderr
    left = {path.name for path in place.iterdir()}
    assert left >= {"trajectory.txt", "timings.csv", "metrics.partial.json"}
    assert left.isdisjoint({"map.npz", "metrics.json"})
    assert not list(place.glob(".*partial*"))
    assert figures(place)["partial"] == "the outputs were not completed"


LIVE = ("dataset=live", "dataset.frames_sent=100000", "fuser.capacity=100000", "fuser.note=note")


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=REPEATED)])
def test_live_run_signal_completes_outputs(tmp_path: Path, number: signal.Signals) -> None:
    place = tmp_path / "run"
    process = begin(tmp_path, *LIVE, f"hydra.run.dir={place}")
    wait_for(tmp_path / "note", process)
    process.send_signal(number)
    status, stderr = end(process)
    assert status == 0, stderr
    assert "mapping live_room: live until Ctrl-C" in stderr
    assert "partial" not in stderr
    assert {path.name for path in place.iterdir()} >= {*MAPPED, "metrics.json"}
    assert not (place / "metrics.partial.json").exists()
    left = figures(place, "metrics.json")
    assert left["frames_dropped"] <= 2, "expected at most the prefetched frame and the waiting frame"
    assert isinstance(left["latency_ms"], float)
    assert left["frames"] == len((place / "trajectory.txt").read_text().splitlines()) > 0


def test_live_run_second_signal_leaves_partial_outputs(tmp_path: Path) -> None:
    place = tmp_path / "run"
    process = begin(tmp_path, *LIVE, "fuser.slow_s=2", f"hydra.run.dir={place}")
    wait_for(tmp_path / "note", process)
    time.sleep(0.5)  # during the second frame
    for number in (signal.SIGTERM, signal.SIGTERM):
        process.send_signal(number)
        time.sleep(0.05)
    status, stderr = end(process)
    assert status == 143, stderr
    assert figures(place)["partial"] == "ended by SIGTERM"


def test_live_run_source_failure_leaves_partial_outputs(tmp_path: Path) -> None:
    place = tmp_path / "run"
    status, stderr = end(begin(tmp_path, "dataset=live", "dataset.fails_after=3", f"hydra.run.dir={place}"))
    assert status == 3
    assert "expected a connected camera, got none" in stderr.splitlines()[-1]
    assert figures(place)["frames"] == 3


def test_sweep_signal_during_saving_ends_after_current_run(tmp_path: Path) -> None:
    sweep = (
        "hydra.mode=MULTIRUN",
        "seed=1,2",
        "fuser.slow_save_s=1",
        f"hydra.sweep.dir={tmp_path}",
        "hydra.sweep.subdir=${seed}",
    )
    process = begin(tmp_path, *sweep, before=ignore_ctrl_c)
    wait_for(tmp_path / "1" / "metrics.partial.json", process)
    process.send_signal(signal.SIGTERM)
    status, stderr = end(process)
    assert status == 143, stderr
    assert (tmp_path / "1" / "metrics.json").exists()
    assert not (tmp_path / "2").exists()


def test_sweep_run_error_continues_with_next_run(tmp_path: Path) -> None:
    sweep = ("hydra.mode=MULTIRUN", "detector=faulty", "detector.at=3,99", f"hydra.sweep.dir={tmp_path}")
    status, _ = end(begin(tmp_path, *sweep, "hydra.sweep.subdir=${detector.at}"))
    assert status == 1
    assert (tmp_path / "3" / "metrics.partial.json").exists()
    assert (tmp_path / "99" / "metrics.json").exists()


def test_run_in_locked_folder_changes_nothing(tmp_path: Path) -> None:
    place = tmp_path / "run"
    assert end(begin(tmp_path, "seed=1", f"hydra.run.dir={place}"))[0] == 0
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file() and path.name != ".lock_holder"}
    assert place / ".hydra" / "overrides.yaml" in before
    with locked(place):
        status, stderr = end(begin(tmp_path, "seed=2", f"hydra.run.dir={place}"))
    assert (status, len(stderr.splitlines())) == (1, 1)
    assert (
        f"error: {place}: expected an unlocked directory, got a directory in use by process {os.getpid()} on " in stderr
    )
    assert {path: path.read_bytes() for path in before} == before
    assert {path for path in place.rglob("*") if path.is_file()} - set(before) == {place / ".lock_holder"}


def test_run_with_pipe_as_log_is_rejected(tmp_path: Path) -> None:
    place = tmp_path / "run"
    place.mkdir()
    os.mkfifo(place / "instancemap.log")
    status, stderr = end(begin(tmp_path, f"hydra.run.dir={place}"))
    assert status == 1
    assert "instancemap.log" in stderr
    assert "Traceback" not in stderr


def test_run_default_folder_is_named_after_dataset(tmp_path: Path) -> None:
    assert end(begin(tmp_path))[0] == 0
    [place] = (tmp_path / "outputs").iterdir()
    assert place.name.endswith("_fake")
    assert (place / "metrics.json").is_file()


@pytest.mark.acceptance
def test_run_and_sweep_folders_differ_if_simultaneous(tmp_path: Path) -> None:
    runs = [begin(tmp_path, "hydra.run.dir=${new_directory:runs/now}") for _ in range(2)]
    assert [end(process)[0] for process in runs] == [0, 0]
    assert {path.parent.name for path in tmp_path.glob("runs/*/metrics.json")} == {"now", "now_2"}
    sweeps = [begin(tmp_path, "hydra.mode=MULTIRUN", "hydra.sweep.dir=${new_directory:sweeps/now}") for _ in range(2)]
    assert [end(process)[0] for process in sweeps] == [0, 0]
    assert {path.parent.parent.name for path in tmp_path.glob("sweeps/*/*/metrics.json")} == {"now", "now_2"}


def test_run_removes_leftover_partial_files(tmp_path: Path) -> None:
    torn, mine = tmp_path / ".mesh.4711-0123abcd.partial.ply", tmp_path / ".mine.partial.ply"
    torn.touch()
    mine.touch()
    assert end(begin(tmp_path, f"hydra.run.dir={tmp_path}"))[0] == 0
    assert (torn.exists(), mine.exists()) == (False, True)


@pytest.mark.parametrize(
    ("overrides", "status", "frames", "outcome"),
    [
        ([], 0, 6, [2, None, ""]),
        (["fuser.capacity=1"], 3, 1, [2, CAPACITY, CAPACITY]),
        (
            ["dataset.frames=1", "dataset.unreadable=0"],
            1,
            0,
            [None, None, "corner_room: expected usable frames, got none"],
        ),
    ],
)
def test_run_calls_viewer_from_begin_run_to_end_run(
    tmp_path: Path, overrides: list[str], status: int, frames: int, outcome: list[object]
) -> None:
    process = begin(tmp_path, "viewer=noted", "seed=3", "hydra.run.dir=run", *overrides)
    assert end(process)[0] == status
    calls = [json.loads(line) for line in (tmp_path / "run" / CALLS).read_text().splitlines()]
    shown = [["show", k] for k in range(frames)]
    assert calls[:-1] == [["begin_run", 3, True], ["begin", "corner_room"], *shown, ["end"]]
    assert calls[-1][:3] == ["end_run", *outcome[:2]]
    assert calls[-1][3].startswith(str(outcome[2]))


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, *(pytest.param(number, marks=REPEATED) for number in (signal.SIGUSR1, signal.SIGXCPU))]
)
def test_detect_signal_ends_in_one_line(tmp_path: Path, number: signal.Signals) -> None:
    words = ("dataset=fake", "dataset.frames=100000", "dataset.slow_s=0.01", "detector=fake", "out=found.json")
    process = ForkedCommand(tmp_path, "detect", "--config-dir", str(FAKE_CONF), *words)
    deadline = time.monotonic() + PATIENCE_S
    while not list(tmp_path.glob(".found.*")):  # the temporary file
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(number)
    status, stderr = end(process)
    assert (status, stderr.splitlines()[-1]) == (128 + number, f"ended by {number.name}")
    assert "Traceback" not in stderr
    assert not list(tmp_path.glob("*found*"))
