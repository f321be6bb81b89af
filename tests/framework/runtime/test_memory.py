"""Pages that are asked for ahead: each array's next one, once, and what is in use stays as it is."""

from __future__ import annotations

import os
import platform
import queue
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.runtime import memory
from framework.runtime.memory import PAGE, SMALL, PagesAhead

ROWS = 6 * PAGE // 1024
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(sys.platform != "linux", reason="pages are asked for on Linux"),
]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> queue.SimpleQueue[tuple[np.ndarray, int]]:
    """What is asked for, and given to nobody."""
    waiting: queue.SimpleQueue[tuple[np.ndarray, int]] = queue.SimpleQueue()
    monkeypatch.setattr(memory, "_asked", lambda: waiting)
    return waiting


def all_of(asked: queue.SimpleQueue[tuple[np.ndarray, int]]) -> list[tuple[Any, int]]:
    return [asked.get() for _ in range(asked.qsize())]


def test_each_array_has_its_next_page_before_it_comes_there(asked: queue.SimpleQueue[tuple[np.ndarray, int]]) -> None:
    arrays, ahead = [np.empty((ROWS, width), np.uint8) for width in (1024, 1024, 512)], PagesAhead()
    has = [0, 0, 0]
    for count in range(100, ROWS, 100):
        ahead.ask(arrays, count)
        for array, address in all_of(asked):
            k = next(k for k, one in enumerate(arrays) if one is array)
            assert address % PAGE == 0
            assert address >= has[k], "each once"
            assert array.ctypes.data + count * array.shape[1] <= address, "nothing of it is in use"
            assert address + PAGE <= array.ctypes.data + array.nbytes
            has[k] = address + PAGE
        for array, given in zip(arrays, has, strict=True):
            used, end = array.ctypes.data + count * array.shape[1], array.ctypes.data + array.nbytes
            if used - array.ctypes.data <= SMALL:
                assert given == 0
            elif used + 2 * PAGE <= end:
                assert given >= used


def test_a_jump_over_pages_asks_for_the_one_behind_it(asked: queue.SimpleQueue[tuple[np.ndarray, int]]) -> None:
    array, ahead = np.empty((ROWS, 1024), np.uint8), PagesAhead()
    count = 3 * PAGE // 1024 + 5
    for _ in range(2):
        ahead.ask([array], count)
    [(_, address)] = all_of(asked)
    assert 0 <= address - (array.ctypes.data + count * 1024) < PAGE


def resident(begin: int, end: int) -> int:
    """Bytes of the mappings that lie between two addresses that are in memory."""
    total, inside = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        first, _, _ = line.partition(" ")
        if "-" in first:
            low, high = (int(part, 16) for part in first.split("-"))
            inside = low < end and begin < high
        elif inside and first == "Rss:":
            total += 1024 * int(line.split()[1])
    return total


@pytest.mark.skipif(tuple(map(int, platform.release().split(".")[:2])) < (5, 14), reason="Linux 5.14 can")
def test_the_page_is_there_and_nothing_is_written() -> None:
    array = np.empty((64 * ROWS, 1024), np.uint8)  # large enough to be a mapping of its own
    count = PAGE // 1024
    array[: 2 * count] = 7
    begin = array.ctypes.data
    before = resident(begin, begin + array.nbytes)
    PagesAhead().ask([array], 2 * count)
    for _ in range(500):
        if resident(begin, begin + array.nbytes) >= before + PAGE:
            break
        time.sleep(0.01)
    assert PAGE <= resident(begin, begin + array.nbytes) - before <= 2 * PAGE
    assert (array[: 2 * count] == 7).all()


def test_a_process_that_forked_asks_a_thread_of_its_own() -> None:
    asked = memory._asked()
    child = os.fork()
    if child == 0:
        os._exit(int(memory._asked() is asked))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc can be told")
@pytest.mark.parametrize(("way", "said"), [("kept", {}), ("as ever", {}), ("kept", {"GLIBC_TUNABLES": ""})])
def test_what_a_frame_needs_comes_without_new_pages(way: str, said: dict[str, str]) -> None:
    """Ten times 24 MiB are 61,000 pages of 4 KiB, or 120 huge ones."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    answer = subprocess.run(
        [sys.executable, "-c", FAULTS, way], env={**environment, **said}, check=True, capture_output=True, text=True
    )
    assert (int(answer.stdout) < 60) == (way == "kept" and not said)
