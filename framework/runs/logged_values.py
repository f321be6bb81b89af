"""Parameters and metrics of a run, and values of each frame, for experiment trackers.

The names are the keys of config.yaml and metrics.json. Metrics of a run have the prefix `run/`, and values of a frame
have the prefix `frame/`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from framework.data import Pose
from framework.interfaces import SceneMap
from framework.runs.provenance import leaves, relevant
from framework.runs.stored_runs import is_number


def parameter_values(config: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """Return the parameters in a resolved config that affect results, by dotted key.

    Lists and null become JSON text.
    """
    values = leaves(relevant(config))
    return {key: value if isinstance(value, bool | int | float | str) else json.dumps(value) for key, value in values}


def frame_values(pose: Pose, stage_ms: Mapping[str, float], scene: SceneMap) -> dict[str, float]:
    """Return the stage times, the tracking state and the map size after a frame.

    Times are in ms. The tracking state is 1 for a lost pose, otherwise 0.
    """
    times = {f"frame/stage_ms.{stage}": milliseconds for stage, milliseconds in stage_ms.items()}
    return times | {"frame/lost": float(pose.lost), "frame/map.voxels": float(scene.statistics.voxels)}


def run_values(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the numeric metrics of a run."""
    return {f"run/{key}": float(value) for key, value in metrics.items() if is_number(value)}
