"""Tests for pose_graph.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.pose_graph.graph_file import read_pose_graph, write_pose_graph
from tests.support.scenes.given_changes import GRAPH


def test_pose_graph_file_is_read_as_written(tmp_path: Path) -> None:
    write_pose_graph(tmp_path / "g.json", GRAPH)
    read = read_pose_graph(tmp_path / "g.json")
    assert read is not None
    assert (read.odometry, read.loops) == (GRAPH.odometry, GRAPH.loops)
    assert [one.first_frame for one in read.anchors] == [None, 2]
    for one, other in zip(read.anchors, GRAPH.anchors, strict=True):
        np.testing.assert_array_equal(one.T_world_anchor, other.T_world_anchor)


def test_pose_graph_file_is_optional(tmp_path: Path) -> None:
    assert read_pose_graph(tmp_path / "g.json") is None


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("submaps", {"first_frame": -1}, "expected at least 0, got -1"),
        ("submaps", {"T_world_anchor": [[2.0] * 4] * 4}, "expected a rigid transform"),
        ("submaps", {"T_world_anchor": [1, [2]]}, "expected submaps, odometry_edges and loops"),
        ("loops", {"submaps": [0, 2]}, r"between submaps 0 to 1, got one between \(0, 2\)"),
        ("loops", {"submaps": [0, 1, 1]}, "expected submaps, odometry_edges and loops"),
        ("loops", {"path_m": 1e999}, "path: expected a finite value >= 0, got inf"),
        ("loops", {"correction_mm": None}, "expected submaps, odometry_edges and loops"),
        ("loops", {"earlier_frame": 5}, "expected 0 <= earlier_frame <= frame, got 5 and 4"),
    ],
)
def test_pose_graph_file_invalid_raises_error_with_name(
    tmp_path: Path, part: str, changes: dict[str, object], message: str
) -> None:
    path = tmp_path / "g.json"
    write_pose_graph(path, GRAPH)
    content = json.loads(path.read_text())
    content[part][-1] |= changes
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=rf"g\.json: .*{message}"):
        read_pose_graph(path)
