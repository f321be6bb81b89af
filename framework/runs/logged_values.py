"""Values that experiment trackers receive: parameters and metrics of a run, and values of each frame.

The names are the keys of config.yaml and metrics.json, with the prefixes `run/` and `frame/`.
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
    """Return the parameters that change results by dotted key, from a resolved config. Other types become JSON text."""
    values = leaves(relevant(config))
    return {key: value if isinstance(value, bool | int | float | str) else json.dumps(value) for key, value in values}


def frame_values(pose: Pose, stage_ms: Mapping[str, float], scene: SceneMap) -> dict[str, float]:
    """Return the stage times, ms, the tracking state (1 = lost) and the size of the map after a frame."""
    times = {f"frame/stage_ms.{stage}": milliseconds for stage, milliseconds in stage_ms.items()}
    return times | {"frame/lost": float(pose.lost), "frame/map.voxels": float(scene.statistics.voxels)}


def run_values(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the metrics of a run that are numbers."""
    return {f"run/{key}": float(value) for key, value in metrics.items() if is_number(value)}
