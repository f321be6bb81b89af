"""Report section about the back end: submaps, loops, the corrected trajectory and the correction of depth."""

from __future__ import annotations

from typing import Any

import numpy as np

from framework.data import Float64
from framework.interfaces import SubmapGraph
from framework.reporting.charts import PlottedGraph, PlottedPath, depth_corrections, motions, top_view
from framework.reporting.run_contents import RunContents
from framework.sensors.depth_distortion import DepthDistortion

SHOWN_DEPTH = 2.0  # m, depth at which the correction of depth is shown
MOTIONS_TEXT = (
    "Distance between the tracked and the corrected camera position. After a correction, frames are tracked in the "
    "corrected map."
)
TRACKED_COLOR, TRACKED_WIDTH = "association", 4.5  # key of COLORS, and px; wider than the corrected path on top of it


def back_end_section(contents: RunContents, up: Float64) -> dict[str, Any] | None:
    """Return the variables of the back-end section in run.html, or None without a pose graph and correction of depth.

    Args:
        contents: Outputs of the run.
        up: Up direction (3,) in the world frame, a unit vector.
    """
    graph, distortion = contents.graph, contents.depth_distortion
    if graph is None and distortion is None:
        return None
    details = []
    if graph is not None and graph.loops and contents.tracked_positions is not None:
        distances = np.linalg.norm(contents.poses[:, :3, 3] - contents.tracked_positions, axis=1)
        details.append((motions(contents.frame_numbers, distances), MOTIONS_TEXT))
    if distortion is not None:
        details.append((depth_corrections(distortion, SHOWN_DEPTH), _distortion_text(distortion)))
    return {
        "lead": _lead(graph),
        "view": "" if graph is None else _view(contents, graph, up),
        "legend": _legend(contents, graph),
        "loops": [] if graph is None else graph.loops,
        "details": details,
    }


def _lead(graph: SubmapGraph | None) -> str:
    if graph is None:
        return ""
    submaps, loops = len(graph.anchors), len(graph.loops)
    counts = f"{submaps} submap{'' if submaps == 1 else 's'}, {loops or 'no'} loop{'' if loops == 1 else 's'}."
    return f"{counts} The map and the trajectory are corrected by the loops." if loops else counts


def _view(contents: RunContents, graph: SubmapGraph, up: Float64) -> str:
    """Return the top view of the graph and both trajectories as SVG, or "" for a run with a single submap."""
    if len(graph.anchors) < 2 or len(contents.poses) < 2:
        return ""
    paths = [PlottedPath(contents.poses[:, :3, 3])]
    if contents.tracked_positions is not None:
        paths.insert(0, PlottedPath(contents.tracked_positions, color=TRACKED_COLOR, width=TRACKED_WIDTH))
    anchors = np.array([one.T_world_anchor[:3, 3] for one in graph.anchors])
    return top_view(paths, [], [], up, graph=PlottedGraph(anchors, [loop.submaps for loop in graph.loops]))[0]


def _legend(contents: RunContents, graph: SubmapGraph | None) -> list[tuple[str, str]]:
    tracked = [("tracked", "tracked")] if contents.tracked_positions is not None else []
    loops = [("loop", "loop")] if graph is not None and graph.loops else []
    return [*tracked, ("mine", "corrected"), ("end", "end"), ("anchor", "anchor of a submap"), *loops]


def _distortion_text(distortion: DepthDistortion) -> str:
    mm = 1e3 * SHOWN_DEPTH**2 * distortion.nodes
    return (
        f"Correction of depth by self-calibration, for readings of {SHOWN_DEPTH:g} m: {mm.min():+.1f} to "
        f"{mm.max():+.1f} mm. Positive values increase depth. The correction grows with the square of depth."
    )
