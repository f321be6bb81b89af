"""Objective of a run for sweepers such as Optuna."""

from __future__ import annotations

import json
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from omegaconf import ListConfig

from framework.errors import ConfigError
from framework.runs.stored_runs import METRICS, is_number, read_metrics

OF_GROUND_TRUTH = (
    "instances.ap",
    "instances.scannet.",
    "instances.mean_iou",
    "panoptic.",
    "semantic.",
    "trajectory.",
)  # prefixes of metrics


def objective_keys(objective: Any) -> list[str]:
    """Return the names of the metrics in the config key `objective`, or [] without an objective.

    Raises:
        ConfigError: The value is neither a name nor a list of names.
    """
    if objective is None:
        return []
    keys = list(objective) if isinstance(objective, ListConfig | list) else [objective]
    if not keys or not all(isinstance(key, str) for key in keys):
        raise ConfigError(f"objective: expected a key of {METRICS} or a list of keys, got {objective!r:.60}")
    return keys


def objective_of(directory: Path, objective: Any) -> float | list[float] | None:
    """Return the objective of a completed run.

    Args:
        directory: The run directory.
        objective: The value of the config key `objective`.

    Returns:
        A number for one metric, a list of numbers for a list of metrics, or None without an objective.

    Raises:
        ConfigError: A metric is unknown, undefined or not a number.
        DataError: The metrics cannot be read.
    """
    keys = objective_keys(objective)
    metrics = read_metrics(directory) if keys else {}
    values = [_number(key, metrics) for key in keys]
    if isinstance(objective, ListConfig | list):
        return values
    return values[0] if values else None


def _number(key: str, metrics: Mapping[str, Any]) -> float:
    if key not in metrics:
        close = get_close_matches(key, metrics, n=1)
        fix = f"did you mean {close[0]}?" if close else f"choose a key of {METRICS}"
        if key.startswith(OF_GROUND_TRUTH) and not any(one.startswith(OF_GROUND_TRUTH) for one in metrics):
            fix = "choose a dataset with ground truth"
        raise ConfigError(f"objective: expected a metric of this run, got {key}; {fix}")
    if not is_number(metrics[key]):
        raise ConfigError(
            f"objective: expected a number for {key}, got {json.dumps(metrics[key])}; choose another metric"
        )
    return float(metrics[key])
