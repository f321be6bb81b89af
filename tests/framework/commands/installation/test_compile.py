"""Tests for the command `compile`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from framework.commands.installation.compile import compile_named
from framework.compilation.catalog import DEFAULT, listed
from framework.errors import ConfigError

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]


def compiling(cache: Path, *words: str) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "framework", "compile", *words]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    pipe = subprocess.PIPE
    return subprocess.Popen(line, cwd=CHECKOUT, env=environment, stdout=pipe, stderr=pipe, text=True)


def test_compile_second_call_compiles_no_kernels(tmp_path: Path) -> None:
    first, _ = compiling(tmp_path, "allocation_kernels.unpack", "binary_masks_kernels.mask_bounds").communicate()
    assert first.startswith("2 of 2 kernels compiled in ")
    second, _ = compiling(tmp_path, "allocation_kernels.unpack", "binary_masks_kernels.mask_bounds").communicate()
    assert second == "all 2 kernels are already compiled\n"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot send SIGINT to a single process")
def test_compile_ctrl_c_prints_one_line(tmp_path: Path) -> None:
    process = compiling(tmp_path)
    time.sleep(3)  # compilation is running or about to start
    process.send_signal(signal.SIGINT)
    asked = time.monotonic()
    _, message = process.communicate(timeout=10)
    assert time.monotonic() - asked < 5
    assert process.returncode == 128 + signal.SIGINT
    assert "Traceback" not in message
    assert message.splitlines()[-1].startswith("interrupted")


def test_compile_unknown_kernel_name_raises() -> None:
    with pytest.raises(ConfigError, match="NAME: expected part of a kernel name, got nothing"):
        compile_named(listed(DEFAULT), ["nothing"])
