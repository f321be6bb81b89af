"""Tests for the report section about the back end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.interfaces import SubmapGraph
from framework.reporting.back_end_section import back_end_section
from framework.reporting.run_contents import RunContents
from framework.runs.stored_runs import Record
from framework.sensors.depth_distortion import NODES, DepthDistortion
from tests.support.scenes.given_changes import GRAPH

UP = np.array([0.0, 0.0, 1.0])
NODE_VALUES = np.full(NODES, 0.001)
NODE_VALUES[0, 0] = -0.002


def poses(drift: float = 0.0) -> np.ndarray:
    """Return five poses at intervals of 1 m, with a drift in m per frame."""
    T_world_camera = np.tile(np.eye(4), (5, 1, 1))
    T_world_camera[:, 0, 3] = np.arange(5)
    T_world_camera[:, 1, 3] = drift * np.arange(5)
    return T_world_camera


CONTENTS = RunContents(
    record=Record(Path(), {}, {}, 0.0), partial="", mesh=None, objects=(), timestamps=np.arange(5.0), poses=poses(),
    times=None, tracked_positions=poses(0.01)[:, :3, 3], graph=GRAPH,
    depth_distortion=DepthDistortion(NODE_VALUES, (48, 64)),
)  # fmt: skip


def test_back_end_section_has_graph_loops_and_corrections() -> None:
    section = back_end_section(CONTENTS, UP)
    assert section is not None
    assert section["lead"].startswith("2 submaps, 1 loop. The map and the trajectory are corrected")
    assert section["loops"] == GRAPH.loops
    assert section["view"].count('id="chart-path"') == 2
    assert {css for css, _ in section["legend"]} == {"tracked", "mine", "end", "anchor", "loop"}
    (motions, _), (depth, text) = section["details"]
    assert "chart-motions" in motions
    assert "chart-depth" in depth
    assert "readings of 2 m: -8.0 to +4.0 mm" in text


def test_back_end_section_of_one_submap_has_no_view() -> None:
    graph = SubmapGraph(GRAPH.anchors[:1], (), ())
    section = back_end_section(replace(CONTENTS, graph=graph, depth_distortion=None), UP)
    assert section is not None
    assert (section["lead"], section["view"], section["details"]) == ("1 submap, no loops.", "", [])


@pytest.mark.parametrize("with_depth", [True, False])
def test_back_end_section_without_graph_has_only_depth(with_depth: bool) -> None:
    distortion = CONTENTS.depth_distortion if with_depth else None
    section = back_end_section(replace(CONTENTS, graph=None, depth_distortion=distortion), UP)
    assert (section is not None) == with_depth
    if section is not None:
        assert (section["view"], len(section["details"])) == ("", 1)
