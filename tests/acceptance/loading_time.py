"""Time to load a map with a manifest, divided by the time without. Printed for the map file in the argument.

The measurement needs a separate process with the settings of the command line: threads of OpenMP otherwise occupy the
core that computes the hash.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import time
from pathlib import Path

import instancemap

LOADS = 31  # loads of each file


def ratio(path: Path) -> float:
    """Return the median ratio of alternating loads with and without the manifest in the folder of the map."""
    without = path.parent / "without_manifest" / path.name
    without.parent.mkdir()
    shutil.copy(path, without)
    pairs = [(_seconds(path), _seconds(without)) for _ in range(LOADS + 1)]
    return statistics.median(first / second for first, second in pairs[1:])  # the first loads compile the kernels


def _seconds(path: Path) -> float:
    began = time.perf_counter()
    instancemap.load_map(path)
    return time.perf_counter() - began


if __name__ == "__main__":
    instancemap.configure_process()
    print(ratio(Path(sys.argv[1])))
