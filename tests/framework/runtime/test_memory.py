"""Tests for keeping freed memory in the process."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.integration

FAULTS = """
import os, resource, sys
import numpy as np
from framework.runtime.memory import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
for k in range(20):
    if k == 10:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    images = [np.ones(2**20) for _ in range(3)]
    del images
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="requires glibc")
@pytest.mark.parametrize(("setting", "variables"), [("kept", {}), ("default", {}), ("kept", {"GLIBC_TUNABLES": ""})])
def test_keep_freed_memory_avoids_page_faults(setting: str, variables: dict[str, str]) -> None:
    """By default, ten allocations of 24 MiB cause 61,000 page faults, or 120 with huge pages."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    answer = subprocess.run(
        [sys.executable, "-c", FAULTS, setting],
        env={**environment, **variables},
        check=True,
        capture_output=True,
        text=True,
    )
    assert (int(answer.stdout) < 60) == (setting == "kept" and not variables)
