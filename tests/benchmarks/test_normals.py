"""Normals of a frame of 640x480 px: the first call and a repeated call.

Run with `python -m pytest tests/benchmarks/test_normals.py`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.data import Frame
from framework.datasets.tum_rgbd import TumRgbd
from framework.tracking.pyramid import normals_of

ROUNDS = 50


@pytest.fixture(scope="module")
def frame() -> Frame:
    return TumRgbd(Path("data/desk"), "rgbd_dataset_freiburg1_rpy")[0]


def test_normals_first_call_speed(benchmark, frame: Frame) -> None:
    normals_of(frame)  # compile the kernel
    benchmark.pedantic(normals_of, args=(frame,), setup=frame.depth_cache.clear, rounds=ROUNDS)


def test_normals_repeated_call_speed(benchmark, frame: Frame) -> None:
    benchmark.pedantic(normals_of, args=(frame,), rounds=ROUNDS, iterations=100)
