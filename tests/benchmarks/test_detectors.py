"""Time and memory of every detector that can run here, at 640x480: `python -m pytest tests/benchmarks -k detectors`.

Each runs in a process of its own, so that its peak of memory is its own.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from framework.data import Frame
from framework.datasets.synthetic import Synthetic
from framework.errors import ConfigError, DataError
from tests import registered
from tests.benchmarks.comparison import Table

THREADS = 2
FRAMES = 8
ROUNDS = 3  # over the frames, after one to warm up


@dataclass(frozen=True)
class Measured:
    """What a detector took."""

    seconds: list[float]  # an image
    detections: float  # an image
    mib: float  # by which the process grew at its peak
    fault: str = ""  # why it cannot run here


def measure(name: str, frames: list[Frame]) -> Measured:
    """Builds detector=`name` and runs it on frames."""
    torch.set_num_threads(THREADS)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        detector = registered.built("detector", name, f"threads={THREADS}")
    except (ConfigError, DataError) as absent:
        return Measured([], 0.0, 0.0, str(absent))
    found = [len(detector.detect(frame)) for frame in frames]
    seconds = []
    for _ in range(ROUNDS):
        for frame in frames:
            began = time.perf_counter()
            detector.detect(frame)
            seconds.append(time.perf_counter() - began)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return Measured(seconds, float(np.mean(found)), grown / 1024)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """The synthetic room, where all can run, also those that look at the truth."""
    return list(Synthetic(frames=240, stride=240 // FRAMES))


@pytest.fixture(scope="module")
def table(tables: list[Table]) -> Table:
    table = Table(
        "Detectors, synthetic room at 640x480",
        ["detector", "ms", "images a second", "peak memory, MiB", "detections"],
        notes=[f"Medians over {FRAMES * ROUNDS} images, {THREADS} threads. Memory: what the process grew by."],
    )
    tables.append(table)
    return table


@pytest.mark.parametrize("name", registered.names("detector"))
def test_detectors(benchmark: BenchmarkFixture, table: Table, frames: list[Frame], name: str) -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        measured: Measured = benchmark.pedantic(process.submit(measure, name, frames).result, rounds=1)
    if measured.fault:
        pytest.skip(measured.fault)
    median = float(np.median(measured.seconds))
    table.rows.append(
        [name, f"{1e3 * median:.1f}", f"{1 / median:.0f}", f"{measured.mib:.0f}", f"{measured.detections:.1f}"]
    )
    benchmark.extra_info.update(ms=1e3 * median, peak_rss_growth_mib=measured.mib, detections=measured.detections)
