"""Tests for process settings: threads, seeds, garbage collection and caches."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from omegaconf import OmegaConf
from scipy.spatial import cKDTree

from framework.errors import ConfigError
from framework.evaluation import instances
from framework.runtime.process_settings import Settings, available_cores, frozen_garbage_collector
from framework.synthetic.ray_caster import RayCaster

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]


def test_settings_apply_to_libraries_loaded_later() -> None:
    """Torch is imported after the first settings were applied. The settings themselves do not import torch."""
    code = """
import sys
from framework.runtime.process_settings import Settings
Settings(seed=4, device="cpu", threads=1).apply()
import cv2, numba
assert "torch" not in sys.modules
import torch
Settings(seed=5, device="cpu", threads=1).apply()
print(numba.get_num_threads(), cv2.getNumThreads(), torch.get_num_threads(), torch.initial_seed())
Settings(seed=5, device="cpu", threads=3).apply()
print(torch.get_num_threads())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split() == ["1", "1", "1", "5", "3"]


def test_thread_limit_is_passed_to_scipy_and_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    class Tree(cKDTree):
        def query(self, *of: Any, workers: int = 1, **kept: Any) -> Any:
            asked.append(workers)
            return super().query(*of, workers=workers, **kept)

    class Scene:
        def cast_rays(self, rays: Any, nthreads: int) -> Any:
            asked.append(nthreads)
            return scene.cast_rays(rays, nthreads)

    triangle = np.eye(3, dtype=np.float32)
    monkeypatch.setattr(instances, "cKDTree", Tree)
    caster = RayCaster(triangle, np.arange(3, dtype=np.int32)[None])
    scene = caster._scene
    monkeypatch.setattr(caster, "_scene", Scene())
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        instances.transfer_labels(triangle, np.arange(3, dtype=np.int32), triangle, 0.1)
        caster.cast(np.ones((1, 6), np.float32))
    finally:
        numba.set_num_threads(before)
    assert asked == [1, 1]


def test_frozen_garbage_collector_is_restored() -> None:
    with frozen_garbage_collector():
        assert gc.get_freeze_count() > 10_000, "expected frozen imported objects"
        circle: list[object] = []
        circle.append(circle)
        del circle
        assert gc.collect() >= 1
    assert gc.get_freeze_count() == 0
    gc.freeze()
    try:
        with frozen_garbage_collector():
            pass
        assert gc.get_freeze_count() > 10_000, "expected the previous state"
    finally:
        gc.unfreeze()


WITHOUT_CACHE_FOLDER = """
import os
os.access = lambda *_: False
from framework.runtime.process_settings import set_environment
set_environment()
print(os.environ["NUMBA_CACHE_DIR"], os.path.isdir(os.environ["NUMBA_CACHE_DIR"]))
from framework import geometry
"""


def test_numba_cache_is_temporary_without_writable_folder(tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(CHECKOUT)
    line = [sys.executable, "-c", WITHOUT_CACHE_FOLDER]
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    folder, was_there = done.stdout.split()
    assert was_there == "True"
    assert not Path(folder).exists(), "expected the folder to be removed at exit"
    given = subprocess.run(
        line, cwd=tmp_path, env=environment | {"NUMBA_CACHE_DIR": "given"}, capture_output=True, text=True, check=False
    )
    assert given.stdout.split()[0] == "given"


def test_available_cores_without_affinity_is_cpu_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")
    assert available_cores() == os.cpu_count()


@pytest.mark.parametrize(
    ("name", "value", "most"),
    [
        *[("prefetch", wrong, 1000) for wrong in ("x", -1, 1.5, 10**6, None, True)],
        *[("detection_interval", wrong, 10**6) for wrong in (0, -1, 1.5, 10**7, None, True)],
        *[("threads", wrong, 4096) for wrong in (10**6, "all", None)],
        *[("seed", wrong, 2**63 - 1) for wrong in (2**63, 10**400, "x" * 100_000)],
    ],
)
def test_settings_out_of_range_raise_with_bounds(name: str, value: object, most: int) -> None:
    config = OmegaConf.create({"seed": 0, "device": "cpu", "threads": 0, "prefetch": 2})
    least = 1 if name == "detection_interval" else 0
    config[name] = value
    with pytest.raises(ConfigError, match=rf"^{name}: expected an integer in \[{least}, {most}\], got") as expected:
        Settings.of(config)
    assert len(str(expected.value)) < 400


@pytest.mark.parametrize("threads", [-1, 1.0, True])
def test_settings_invalid_threads_raise(threads: object) -> None:
    with pytest.raises(ConfigError, match=r"threads: expected an integer in \[0, 4096\], got"):
        Settings(seed=0, device="cpu", threads=threads)  # type: ignore[arg-type]


IDLE_AFTER_A_PRODUCT = """
import framework.commands
import time
import cv2, numpy as np

for _ in range(2):
    cv2.gemm(np.ones((800, 128), np.float32), np.ones((128, 12), np.float32), 1, None, 0)
    np.ones((500, 500)) @ np.ones((500, 500))
done = time.process_time()
time.sleep(0.2)
print(time.process_time() - done)
"""


def test_matrix_product_threads_do_not_spin_when_idle() -> None:
    """Spinning threads use at least 0.02 s of CPU time while the process sleeps."""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_THREAD_TIMEOUT"}
    line = [sys.executable, "-c", IDLE_AFTER_A_PRODUCT]
    done = subprocess.run(line, cwd=CHECKOUT, env=environment, capture_output=True, text=True, check=True)
    assert float(done.stdout) < 0.01
