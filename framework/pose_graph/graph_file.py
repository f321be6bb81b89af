"""The pose graph of a run: pose_graph.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from framework.errors import DataError
from framework.files.json_file import read_json, write_json
from framework.files.manifest import verified
from framework.interfaces import ClosedLoop, GraphAnchor, SubmapGraph


def write_pose_graph(path: Path, graph: SubmapGraph) -> None:
    """Write a pose graph."""
    content = {
        "submaps": [
            {"first_frame": one.first_frame, "T_world_anchor": one.T_world_anchor.tolist()} for one in graph.anchors
        ],
        "odometry_edges": [list(pair) for pair in graph.odometry],
        "loops": [
            {
                "earlier_frame": loop.earlier_frame,
                "frame": loop.frame,
                "submaps": list(loop.submaps),
                "path_m": loop.path,
                "correction_mm": loop.correction_mm,
                "correction_deg": loop.correction_deg,
            }
            for loop in graph.loops
        ],
    }
    write_json(path, content)


def read_pose_graph(path: Path) -> SubmapGraph | None:
    """Read a pose graph; None = the file does not exist.

    Raises:
        DataError: The file is invalid, or has changed since the run.
    """
    if not path.exists():
        return None
    with verified(path):
        content = read_json(path)
    try:
        anchors = tuple(
            GraphAnchor(
                None if one["first_frame"] is None else int(one["first_frame"]),
                np.array(one["T_world_anchor"], np.float64),
            )
            for one in content["submaps"]
        )
        loops = tuple(
            ClosedLoop(
                int(one["earlier_frame"]), int(one["frame"]), _pair(one["submaps"]), float(one["path_m"]),
                float(one["correction_mm"]), float(one["correction_deg"]),
            )
            for one in content["loops"]
        )  # fmt: skip
        return SubmapGraph(anchors, tuple(_pair(pair) for pair in content["odometry_edges"]), loops)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: expected submaps, odometry_edges and loops, got an error ({error})") from error


def _pair(numbers: list[int]) -> tuple[int, int]:
    first, second = numbers
    return int(first), int(second)
