"""Tests for runs that are killed at random times.

A killed run may leave complete, partial or no outputs, and the next run must succeed. The following command tests 30
kills:

    INSTANCEMAP_KILLS=30 python -m pytest tests/framework/commands/running/test_random_kills.py
"""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.json_file import read_json
from framework.files.tum_trajectory import read_tum
from framework.runs.instances_file import read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.timings_file import read_timings
from tests.framework.commands.running.test_run import begin, end, wait_for
from tests.support.scenes.corner_room import GridMap

pytestmark = pytest.mark.acceptance

KILLS = int(os.environ.get("INSTANCEMAP_KILLS", "6"))
SHORT = ("dataset.frames=20", "fuser.slow_s=0.02", "fuser.slow_save_s=0.3", "fuser.note=note")
LONGEST_WAIT_S = 1.2  # s, maximum time before a kill; mapping and saving take about 0.5 s each


def whole_files(place: Path) -> set[str]:
    """Return the names of the output files in a run directory. Raise DataError if a file is truncated."""
    read = {
        "trajectory.txt": read_tum,
        "timings.csv": read_timings,
        "instances.json": read_instances,
        "mesh.ply": read_mesh,
        "map.npz": GridMap.load,
        "metrics.json": read_json,
        "metrics.partial.json": read_json,
    }
    there = {path.name for path in place.iterdir()} & set(read)
    for name in there:
        read[name](place / name)
    return there


def test_run_truncated_output_file_is_detected(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text('{"frames": 2')
    with pytest.raises(DataError):
        whole_files(tmp_path)


def test_run_killed_at_random_time_leaves_valid_outputs(tmp_path: Path) -> None:
    chosen = random.Random(19)
    place, undisturbed = tmp_path / "run", tmp_path / "undisturbed"
    arguments = (*SHORT, f"hydra.run.dir={place}")
    signals = [(signal.SIGKILL, signal.SIGTERM, signal.SIGINT)[k % 3] for k in range(KILLS)]
    for number in signals:
        (tmp_path / "note").unlink(missing_ok=True)
        (place / "config.yaml").unlink(missing_ok=True)
        moment = chosen.choice(("begun", "config.yaml", "note", "note", "note"))
        wait_s = chosen.uniform(0, LONGEST_WAIT_S)
        process = begin(tmp_path, *arguments)
        if moment != "begun":
            wait_for(tmp_path / "note" if moment == "note" else place / "config.yaml", process)
        time.sleep(wait_s)
        mapped = (tmp_path / "note").exists()
        process.send_signal(number)
        status, stderr = end(process)
        expected = f"{number.name}, {wait_s:.3f} s after {moment}: status {status}\n{stderr}"
        there = whole_files(place) if place.exists() else set()
        if mapped and number != signal.SIGKILL:
            assert there & {"metrics.json", "metrics.partial.json"}, expected
            assert {"trajectory.txt", "timings.csv", "instances.json", "mesh.ply", "map.npz"} <= there, expected
            assert status == 128 + number or "metrics.json" in there, expected
            assert not list(place.glob(".*.partial*")), expected
    assert end(begin(tmp_path, *arguments, "skip_completed=true"))[0] == 0
    assert end(begin(tmp_path, *SHORT, f"hydra.run.dir={undisturbed}"))[0] == 0
    assert whole_files(place) == whole_files(undisturbed)
    assert not list(place.glob(".*.partial*"))
    for name in ("trajectory.txt", "instances.json", "mesh.ply"):
        assert (place / name).read_bytes() == (undisturbed / name).read_bytes()
    with np.load(place / "map.npz") as ours, np.load(undisturbed / "map.npz") as theirs:
        for key in theirs:
            np.testing.assert_array_equal(ours[key], theirs[key])
