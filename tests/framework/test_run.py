"""What the top of the config says to the libraries."""

from __future__ import annotations

import subprocess
import sys

import pytest

from framework.errors import ConfigError
from framework.run import Settings


def test_threads_limit_what_is_loaded_and_what_is_loaded_later() -> None:
    """torch is not loaded for it, and obeys when it is."""
    code = """
import sys
from framework.run import Settings
Settings(seed=0, device="cpu", threads=1).apply()
import cv2, numba
assert "torch" not in sys.modules
import torch
print(numba.get_num_threads(), cv2.getNumThreads(), torch.get_num_threads())
Settings(seed=0, device="cpu", threads=3).apply()
print(torch.get_num_threads())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split() == ["1", "1", "1", "3"]


@pytest.mark.parametrize("threads", [-1, 1.0, True])
def test_threads_are_a_number_of_threads(threads: object) -> None:
    with pytest.raises(ConfigError, match="threads must be a whole number, 0 or more, found"):
        Settings(seed=0, device="cpu", threads=threads)  # type: ignore[arg-type]
