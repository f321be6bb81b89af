"""Fuzz tests of the files of a run. A damaged file must be read, or raise a one-line error that names the file.

The copies have no manifest, so that the readers get the damaged contents. `INSTANCEMAP_FUZZ=2000` tries 2,000 cases for
each file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from framework.api import load_map
from framework.files.manifest import Manifest
from framework.files.tum_trajectory import read_tum
from framework.pose_graph.depth_distortion_file import read_depth_distortion, write_depth_distortion
from framework.pose_graph.graph_file import read_pose_graph, write_pose_graph
from framework.runs.instances_file import read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_runs import read_metrics, read_yaml
from framework.runs.timings_file import read_timings
from framework.sensors.depth_distortion import NODES, DepthDistortion
from framework.tracking.keyframes import Keyframes, read_keyframes, write_keyframes
from tests.support.recordings.damaged_files import EXAMPLES, check, damaged
from tests.support.reported_run import write_run
from tests.support.scenes.corner_room import CornerRoom
from tests.support.scenes.given_changes import GRAPH

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]
TOKENS = (
    b"NaN",
    b"null",
    b"1e999",
    b"{",
    b"]",
    b'"',
    b"\x1b[2J",
    b"\\ud800",
    b"\n",
    b"${oc.env:HOME}",
    b"!!python/name:os",
)
READERS: dict[str, Callable[[Path], object]] = {
    "config.yaml": read_yaml,
    "metrics.json": lambda path: read_metrics(path.parent),
    "instances.json": read_instances,
    "trajectory.txt": read_tum,
    "timings.csv": read_timings,
    "mesh.ply": read_mesh,
    "map.npz": load_map,
    "keyframes.npz": read_keyframes,
    "depth_distortion.json": read_depth_distortion,
    "pose_graph.json": read_pose_graph,
    "manifest.json": lambda path: Manifest.read(path.parent),
}


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a run with keyframes, a correction of depth and a pose graph."""
    directory = write_run(tmp_path_factory.mktemp("runs") / "run", frames=3)
    room, keyframes = CornerRoom(frames=3), Keyframes()
    for k in range(3):
        keyframes.add(room[k], room[k].T_world_camera)
    write_keyframes(directory / "keyframes.npz", keyframes.saved())
    write_depth_distortion(directory / "depth_distortion.json", DepthDistortion(np.full(NODES, 0.01), (72, 96)))
    write_pose_graph(directory / "pose_graph.json", GRAPH)
    return directory


@pytest.mark.parametrize("name", READERS)
def test_fuzzed_run_file_is_read_or_raises_one_line(name: str, stored: Path, tmp_path: Path) -> None:
    content = (stored / name).read_bytes()
    found: list[str] = []

    @settings(max_examples=EXAMPLES, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(damaged(content, TOKENS))
    def fuzz(changed: bytes) -> None:
        found.append(check(READERS[name], tmp_path / name, changed))

    fuzz()
    assert any(found)
