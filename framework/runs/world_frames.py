"""World frames of stored runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.datasets.frames.world_offset import stored_origin
from framework.files.atomic_write import path_exists
from framework.runs.stored_runs import (
    EDITED_FROM,
    EXTERNAL,
    MERGED_FROM,
    MERGED_WITH,
    METRICS,
    read_config,
    read_metrics,
)

GIVEN = ("ground_truth", EXTERNAL)  # values of `pose_source` of runs in the world frame of the ground-truth poses


def in_world(run: Path, world: Path) -> bool:
    """Return True if two runs are known to have the same world frame.

    This is the case if `run` was localized in `world`, resumed it, is an edit of it, or was merged into its world
    frame, or if both used ground-truth poses. Imported maps are in the world frame of these poses.
    """
    metrics = _metrics(run)
    worlds = [*_configured(run, "localize_in", "resume_from"), metrics.get(EDITED_FROM), metrics.get(MERGED_FROM)]
    return _is_among(world, worlds) or have_given_poses(run, world)


def contains(run: Path, other: Path) -> bool:
    """Return True if the map of a run contains the map of another run: it is the same, resumed, edited or merged."""
    metrics = _metrics(run)
    parts = [metrics.get(key) for key in (EDITED_FROM, MERGED_FROM, MERGED_WITH)]
    return _is_among(other, [str(run), *_configured(run, "resume_from"), *parts])


def known_transform(a: Path, b: Path) -> Float64 | None:
    """Return the transform T_a_b (4, 4) between the world frames of two runs, or None if it is unknown."""
    T_a_b = np.eye(4)
    if have_given_poses(a, b):
        origin_a, origin_b = (np.array(stored_origin(_metrics(run)) or (0.0, 0.0, 0.0)) for run in (a, b))
        T_a_b[:3, 3] = origin_b - origin_a
        return T_a_b
    return T_a_b if in_world(a, b) or in_world(b, a) else None


def have_given_poses(*runs: Path) -> bool:
    """Return True if all runs are in the world frame of the ground-truth poses."""
    return all(_metrics(run).get("pose_source") in GIVEN for run in runs)


def _metrics(run: Path) -> dict[str, object]:
    return dict(read_metrics(run)) if path_exists(run / METRICS) else {}


def _configured(run: Path, *keys: str) -> list[object]:
    config = read_config(run)
    return [config.get(key) for key in keys]


def _is_among(run: Path, paths: list[object]) -> bool:
    return any(isinstance(path, str) and Path(path).expanduser().resolve() == run.resolve() for path in paths)
