"""Tests for the kernel cache: damaged files, and folders that cannot store kernels."""

from __future__ import annotations

import errno
import importlib
import os
import random
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import pytest

from framework.commands.installation.compile import compile_named
from framework.compilation import catalog, kernel_cache
from framework.compilation.catalog import Kernel
from framework.compilation.kernel_cache import CheckedFiles, KernelCache, check_cache_folders, damaged_files
from framework.errors import DataError
from tests.support.recordings.damaged_files import EXAMPLES

CHECKOUT = Path(__file__).resolve().parents[3]
MODULE = """
from framework.compilation.kernel_cache import njit

@njit(cache=True)
def twice(x):
    return 2 * x
"""
CALL = "import kernels; print(kernels.twice(21), kernels.twice.stats.cache_hits.total())"
KEY = ("signature", ("codegen",), ("code",))


@pytest.fixture(autouse=True)
def no_warning_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "_warned", set())


@pytest.fixture
def twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a kernel of a new module, with its cache in tmp_path."""
    (tmp_path / "kernels.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "kernels", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return importlib.import_module("kernels").twice


def called(folder: Path) -> subprocess.CompletedProcess[str]:
    """Call the kernel in a new process. Print its result and the number of kernels loaded from the cache."""
    environment = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{CHECKOUT}", "NUMBA_CACHE_DIR": f"{folder}/cache"}
    return subprocess.run([sys.executable, "-c", CALL], env=environment, capture_output=True, text=True, check=False)


@pytest.mark.integration
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped bits", "zeros"])
def test_kernel_with_damaged_cache_file_is_recompiled(twice: Any, tmp_path: Path, suffix: str, damage: str) -> None:
    assert twice(4) == 8
    [path] = (tmp_path / "cache").rglob(f"*.{suffix}")
    content = bytearray(path.read_bytes())
    for position in random.choices(range(len(content)), k=20):
        content[position] ^= 1 << random.randrange(8)
    kinds = {"empty": b"", "truncated": content[: len(content) // 2], "zeros": bytes(len(content))}
    path.write_bytes(kinds.get(damage, content))
    first = called(tmp_path)
    assert (first.returncode, first.stdout) == (0, "42 0\n"), first.stderr
    assert first.stderr == (
        f"kernel cache: expected files with valid checksums, got damaged ones such as {path}; compiling again\n"
    )
    second = called(tmp_path)
    assert (second.stdout, second.stderr) == ("42 1\n", ""), "expected the stored kernel"


def test_checked_files_fuzzed_are_never_loaded(tmp_path: Path) -> None:
    files = CheckedFiles(str(tmp_path), "kernel", "stamp")
    files.save(KEY, b"machine code")
    assert files.load(KEY) == b"machine code"
    for path in sorted(tmp_path.iterdir()):
        content = path.read_bytes()
        for _ in range(EXAMPLES):
            damaged = bytearray(content)
            damaged[random.randrange(len(content))] ^= 1 << random.randrange(8)
            path.write_bytes(damaged[: random.choice([len(content), random.randrange(len(content))])])
            assert files.load(KEY) is None
            assert not files.contains(KEY)
            assert damaged_files([tmp_path]) == [path]
        path.write_bytes(content)
    assert files.load(KEY) == b"machine code"
    assert damaged_files([tmp_path, tmp_path / "missing"]) == []


def test_kernel_on_full_disk_is_kept_in_memory(
    twice: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(CheckedFiles, "_open_for_write", fail)
    assert (twice(21), twice(1.5), twice(21)) == (42, 3.0, 42)
    [message] = caplog.messages
    assert message.startswith("kernel cache: expected a writable folder with free space, got ")
    assert "(No space left on device); set NUMBA_CACHE_DIR=DIR; the kernels are compiled in memory" in message
    monkeypatch.setattr(KernelCache, "storage_required", True)
    with pytest.raises(OSError, match="No space left"):
        twice(1 + 2j)


@pytest.mark.integration
@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC, errno.ENOTDIR, errno.EDQUOT])
def test_kernel_without_cache_folder_is_kept_in_memory(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("tempfile.TemporaryFile", fail)
    (tmp_path / "kernels.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "kernels", raising=False)
    kernel = Kernel("kernels", "twice", "int64")
    assert kernel.dispatcher(21) == 42
    assert not kernel.is_compiled()
    monkeypatch.setattr(catalog, "listed", lambda *_: [kernel])
    monkeypatch.setattr(catalog, "compile_all", lambda *_: pytest.fail("expected no worker processes"))
    catalog.compile_for_run()
    assert len(caplog.messages) == 1
    with pytest.raises(DataError, match=r"kernel cache: expected a writable folder .*, got none; set NUMBA_CACHE_DIR"):
        compile_named([kernel], [])


def test_check_storage_reports_folder_and_reason(twice: Any, tmp_path: Path) -> None:
    check_cache_folders([twice._cache])
    (tmp_path / "file").touch()
    twice._cache._cache_path = str(tmp_path / "file" / "cache")
    with pytest.raises(DataError, match=r"got .*/file/cache \(Not a directory\); set NUMBA_CACHE_DIR=DIR"):
        check_cache_folders([twice._cache])


def test_cache_dir_not_writable_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "kernels.py").write_text(MODULE)
    (tmp_path / "file").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "kernels", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "file"))
    importlib.import_module("kernels")
    assert caplog.messages == [
        f"NUMBA_CACHE_DIR: expected a writable folder, got {tmp_path}/file; kernels are stored in the default folder"
    ]


def test_kernel_index_that_cannot_be_deleted_disables_cache(
    twice: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Otherwise, outdated code would be loaded."""
    twice(4)
    assert twice._cache.index.exists()

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", fail)
    twice._cache.flush()
    assert twice._cache.load_overload(twice.signatures[0], twice.targetctx) is None
    assert len(caplog.messages) == 1
    monkeypatch.undo()
    twice._cache.flush()
    assert not twice._cache.index.exists()


def test_stored_kernels_use_checked_cache() -> None:
    for path in (path for package in ("framework", "plugins") for path in (CHECKOUT / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert "cache=True" not in text or not re.search(r"(?m)^from numba import .*\bn?jit\b", text), path
