"""Growth of memory and time over a long run in a known place: `python -m tests.acceptance.long_run`.

A synthetic room is played forward and backward. The errors of the detector differ in each frame. Python allocates small
objects with malloc (PYTHONMALLOC=malloc), so that the heap contains all objects. The voxels and their labels are in
reserved memory, which the heap contains from the start. The surface of the room limits their size, which is printed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from framework.api import Mapper
from framework.data import Float64
from framework.mapping.instances.instance_list import InstanceTableMap
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from framework.synthetic.walk import FRAME_RATE
from tests.acceptance.runner import CHECKOUT
from tests.support.process_memory import ALLOCATOR, memory
from tests.support.reference_time import Reference

FRAMES = 20_000
VIEWS = 100  # number of views of the room
INTERVAL = 2 * VIEWS  # number of frames forward and backward; values are compared at equal positions
# 120 new instances for each 900 frames; in a real kitchen, 36
OVERRIDES = ("detector=simulated_maskrcnn2go", "detector.false_positives=0.8", "fuser.voxel_size=0.03")
REFERENCE_INTERVAL = 10  # number of frames between two timings of the reference


class Growth(NamedTuple):
    """Growth between the first and the last quarter of the frames."""

    bytes_per_frame: float  # difference of the median sizes, per frame between the centers of the quarters
    time_ratio: float  # ratio of the median processor times of a frame, each relative to the reference


def measure() -> Growth:
    """Map the long run in another process, and return its growth."""
    command = [sys.executable, "-m", "tests.acceptance.long_run"]
    environment = os.environ | {ALLOCATOR: "malloc", "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=CHECKOUT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return Growth(*json.loads(done.stdout.splitlines()[-1]))


def growth_of(size: Float64, relative_ms: Float64) -> Growth:
    """Return the growth, given the memory (n,) in bytes and the relative time (n,) of a frame at equal intervals."""
    quarter = len(size) // 4
    (first, last), (early, late) = (
        (np.median(values[:quarter]), np.median(values[-quarter:])) for values in (size, relative_ms)
    )
    return Growth(float(last - first) / (0.75 * FRAMES), float(late / early))


def main() -> None:
    room = Synthetic(seed=3, kind=RoomKind.LIVING_ROOM, frames=VIEWS, width=160, height=120)
    views = [room[k] for k in range(VIEWS)]
    mapper, reference = Mapper(*OVERRIDES), Reference(views[0])
    scene = mapper.scene
    assert isinstance(scene, InstanceTableMap)
    milliseconds, constant = np.full((2, FRAMES), np.nan)
    size = np.empty(FRAMES // INTERVAL)
    lost = 0
    for number in range(FRAMES):
        position = number % INTERVAL
        view = views[min(position, INTERVAL - 1 - position)]
        began = time.process_time()
        lost += mapper.add(replace(view, index=number, timestamp=number / FRAME_RATE)).lost
        milliseconds[number] = 1e3 * (time.process_time() - began)
        if number % REFERENCE_INTERVAL == 0:
            constant[number] = reference.milliseconds()
        if position == INTERVAL - 1:
            visit = number // INTERVAL
            size[visit] = memory().heap
            if visit % 10 == 9:
                print(
                    f"frame {number + 1}: heap {size[visit]:.0f} bytes, map {scene.statistics.bytes} bytes; "
                    f"{scene.table.last_id} instances, "
                    f"{len(scene.table.records)} not removed, {len(scene.instance_ids())} confirmed; "
                    f"{np.nanmedian(milliseconds):.1f} ms, {lost} frames lost",
                    flush=True,
                )
    by_block = np.nanmedian(milliseconds.reshape(-1, INTERVAL), axis=1)
    found = growth_of(size, by_block / np.nanmedian(constant.reshape(-1, INTERVAL), axis=1))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
