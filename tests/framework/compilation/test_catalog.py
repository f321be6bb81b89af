"""Tests for kernels.txt, the list of all kernels. After `compile`, a run compiles no kernels."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from filelock import FileLock
from numba.core.dispatcher import Dispatcher

from framework.compilation import catalog
from framework.compilation.catalog import DEFAULT, OTHERS, Kernel, compile_all, line_of, listed
from framework.errors import DataError
from framework.mapping.voxels.voxel_grid import Grid

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]
LINES = [line for line in catalog.LIST.read_text().splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("kernel", listed(DEFAULT, OTHERS), ids=lambda kernel: f"{kernel.module}.{kernel.name}")
def test_kernel_catalog_contains_only_existing_kernels(kernel: Kernel) -> None:
    assert isinstance(kernel.dispatcher, Dispatcher)
    assert line_of(kernel.dispatcher, kernel.signature) in LINES
    assert len(kernel.signature) == kernel.dispatcher.py_func.__code__.co_argcount


def test_kernel_signature_text_round_trip_is_exact() -> None:
    frozen = np.zeros((2, 2), np.float32)
    frozen.flags.writeable = False
    column = np.zeros((2, 2))[:, 1:]
    values = [frozen, column, column.T, np.zeros((3, 2), np.int16, "F"), True, 3, 2.5, None, (1, 2.0), ((1, 2),), (1,)]
    signature = tuple(map(numba.typeof, values))
    kernel = listed(DEFAULT)[0]
    module, _, text = line_of(kernel.dispatcher, signature).rpartition(kernel.name)
    assert Kernel(module, kernel.name, text[1:-1]).signature == signature
    grids = [kernel for kernel in listed(DEFAULT) if Grid.__name__ in kernel.types]
    assert any(getattr(kind, "instance_class", None) is Grid for kernel in grids for kind in kernel.signature)


@pytest.mark.acceptance
def test_kernel_catalog_contains_all_called_kernels() -> None:
    """Run the demo, a synthetic scene, and all other refiners, fusers and trackers.

    To update kernels.txt, run `python -m tests.support.kernel_calls`.
    """
    if missing := [kernel for kernel in listed(DEFAULT, OTHERS) if not kernel.is_compiled()]:
        compile_all(missing)  # like `make test`
    line = [sys.executable, "-m", "tests.support.kernel_calls", "--check"]
    done = subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


SMALL = """
from framework.compilation.kernel_cache import njit
from kernel_callee import twice

@njit(cache=True)
def small(x):
    return twice(x) + 1

@njit(cache=True)
def faulty(x):
    return x.nothing
"""
PAIRS = """
from framework.compilation.kernel_cache import njit

@njit(cache=True)
def first(pair):
    return pair[0]
"""
CALLEE = """
from framework.compilation.kernel_cache import njit

@njit(cache=True)
def twice(x):
    return {0} * x
"""


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write two kernel modules that worker processes can import. Return the file of the called kernel."""
    (tmp_path / "kernel_caller.py").write_text(SMALL)
    callee = tmp_path / "kernel_callee.py"
    callee.write_text(CALLEE.format(2))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    for name in ("kernel_caller", "kernel_callee"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return callee


def test_kernel_is_recompiled_after_callee_change(small: Path) -> None:
    kernel = Kernel("kernel_caller", "small", "int64")
    assert not kernel.is_compiled()
    compile_all([kernel])
    assert kernel.is_compiled()
    assert not Kernel("kernel_caller", "small", "float64").is_compiled()
    os.utime(small, (time.time() + 5, time.time() + 5))
    assert not kernel.is_compiled()


def test_kernel_index_with_renamed_class_is_ignored(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kernel_types.py").write_text("from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    x: int\n")
    (tmp_path / "kernel_caller.py").write_text(PAIRS)
    monkeypatch.delitem(sys.modules, "kernel_types", raising=False)
    kernel = Kernel("kernel_caller", "first", "kernel_types.Pair(int64)")
    compile_all([kernel])
    assert kernel.is_compiled()
    monkeypatch.delattr("kernel_types.Pair")
    (tmp_path / "kernel_types.py").write_text("")  # for the worker process
    other = Kernel("kernel_caller", "first", "(int64,)")
    assert not other.is_compiled()
    compile_all([other])
    assert other.is_compiled()


def test_compile_all_faulty_kernel_raises_with_name(small: Path) -> None:
    good = Kernel("kernel_caller", "small", "int64")
    with pytest.raises(DataError, match=r"kernel_caller\.faulty: expected a compiled kernel, got .*:"):
        compile_all([Kernel("kernel_caller", "faulty", "int64"), good])
    assert good.is_compiled()


def test_compile_all_exited_worker_raises(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        catalog,
        "_worker",
        lambda: subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True),
    )
    with pytest.raises(DataError, match=r"kernel_caller\.small: expected a compiled kernel, got a terminated process"):
        compile_all([Kernel("kernel_caller", "small", "int64")])


def test_compile_for_run_waits_for_other_process(
    small: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kernel = Kernel("kernel_caller", "small", "int64")
    monkeypatch.setattr(catalog, "listed", lambda *_: [kernel])
    importlib.import_module("kernel_caller")  # a run imports the modules of its stages
    lock = FileLock(Path(kernel.dispatcher._cache.cache_path) / "compiling.lock")
    Path(lock.lock_file).parent.mkdir(exist_ok=True)
    caplog.set_level("INFO")
    with lock:
        second = threading.Thread(target=catalog.compile_for_run)
        second.start()
        while not caplog.messages:
            time.sleep(0.01)
        compile_all([kernel])
    second.join()
    assert caplog.messages == ["another process is compiling kernels; waiting for it"]
