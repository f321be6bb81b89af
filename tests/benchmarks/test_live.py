"""Latency and dropped frames of a live run.

Run with `python -m pytest tests/benchmarks -k live`. Another process writes real frames into a folder at 15 Hz, and a
run with the default stages maps them at 1 cm. INSTANCEMAP_LIVE_FRAMES sets the number of frames, for example 2000. The
300 frames of the video are played forward and backward.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from framework.files.tum_trajectory import read_tum
from tests.benchmarks.comparison import NOTHING, Table, mib

CHECKOUT = Path(__file__).resolve().parents[2]
FRAMES = int(os.environ.get("INSTANCEMAP_LIVE_FRAMES", "300"))
HZ = 15.0
PATIENCE_S = 120.0
WARM_S = 10.0  # after this time, kernels are loaded and caches are warm


def resident(process: subprocess.Popen[str]) -> int:
    """Return the resident memory of a process, bytes."""
    pages = Path(f"/proc/{process.pid}/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="requires /proc")
def test_live_folder_reports_latency_and_dropped_frames(
    benchmark: BenchmarkFixture, shared: Path, tmp_path: Path, tables: list[Table]
) -> None:
    source, watched, place = shared / "data" / "redkitchen", tmp_path / "watched", tmp_path / "run"
    if not source.is_dir():
        pytest.skip(f"{source} does not exist")
    watched.mkdir()
    memory: list[int] = []

    def live() -> None:
        chosen = ["dataset=folder_watch", f"dataset.root={watched}", "fuser.voxel_size=0.01", f"hydra.run.dir={place}"]
        line = [sys.executable, "-m", "framework", *chosen, f"dataset.camera_timeout={PATIENCE_S}"]
        run = subprocess.Popen(line, cwd=CHECKOUT, stderr=subprocess.DEVNULL, text=True)
        deadline = time.monotonic() + PATIENCE_S
        while not (place / "config.yaml").exists():  # the network is loaded, and the run waits for the camera
            assert run.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        feeding = [sys.executable, "-m", "tests.benchmarks.feeder", str(source), str(watched), str(FRAMES), str(HZ)]
        with subprocess.Popen(feeding, cwd=CHECKOUT) as feeder:
            while feeder.poll() is None:
                memory.append(resident(run))
                time.sleep(1)
        assert run.wait(PATIENCE_S) == 0

    benchmark.pedantic(live, rounds=1)
    metrics = json.loads((place / "metrics.json").read_text())
    assert metrics["frames"] + metrics["frames_dropped"] == FRAMES
    there = np.loadtxt(watched / "feeder.csv", delimiter=",")[:, 1]
    noticed, _ = read_tum(place / "trajectory.txt")
    unnoticed = 1e3 * float(np.median([at - there[there <= at].max() for at in noticed]))
    late = there[there >= there[0] + WARM_S]
    late_dropped = len(late) - int((noticed >= late[0]).sum()) - metrics["frames_lost"]
    quarters = [float(np.mean(part)) for part in np.array_split(memory, 4)]
    tables.append(
        Table(
            f"Live: redkitchen in a folder at {HZ:g} Hz, {FRAMES} frames, 1 cm voxels, {os.cpu_count()} cores",
            ["", "measured", "target"],
            [
                ["latency from noticing a frame to its fusion, ms, median",
                 f"{metrics['latency_ms']:.0f}", "< 200"],
                ["latency from noticing a frame to its fusion, ms, 95 %", f"{metrics['latency_ms.p95']:.0f}", NOTHING],
                ["delay from writing a frame to noticing it, ms, median", f"{unnoticed:.1f}", NOTHING],
                ["frames per second, median", f"{metrics['fps_median']:.1f}", NOTHING],
                ["frames mapped", f"{metrics['frames']}", NOTHING],
                ["frames dropped", f"{metrics['frames_dropped']}", NOTHING],
                [f"frames dropped after the first {WARM_S:g} s, of {len(late)}", f"{late_dropped}", NOTHING],
                ["frames lost", f"{metrics['frames_lost']}", NOTHING],
                ["detection, ms, median", f"{metrics['stage_ms.detection.median']:.0f}", NOTHING],
                ["map, MiB", mib(metrics["map.bytes"]), NOTHING],
                *([f"resident, MiB, quarter {k}", mib(size), NOTHING] for k, size in enumerate(quarters, start=1)),
            ],
            ["Kernels are loaded in the first second. A frame is dropped if a newer one arrives before mapping."],
        )
    )  # fmt: skip
    benchmark.extra_info.update(
        latency_ms=metrics["latency_ms"], frames_dropped=metrics["frames_dropped"], resident=quarters
    )
