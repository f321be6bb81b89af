"""Renamed config keys: deprecated names, which still work for one minor version, and removed names."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

log = logging.getLogger(__name__)

DEPRECATED: dict[str, str] = {}
"""New name of each key renamed since the previous minor version, in the same group. Move it to RENAMED afterward."""

RENAMED = {
    "ahead": "prefetch",
    "map": "resume_from",
    "resume": "skip_completed",
    "world": "localize_in",
    "dataset.frame_truth": "dataset.frame_ground_truth",
    "dataset.max_difference": "dataset.max_time_difference",
    "dataset.share": "dataset.frame_fraction",
    "dataset.truth_voxel": "dataset.ground_truth_spacing",
    "detector.agnostic_nms": "detector.agnostic_nms_iou",
    "detector.batch": "detector.batch_size",
    "detector.black": "detector.black_level",
    "detector.boxes": "detector.box_format",
    "detector.every": "detector.frame_interval",
    "detector.ghost_share": "detector.recurring_fraction",
    "detector.half": "detector.half_precision",
    "detector.labels": "detector.label_space",
    "detector.masks": "detector.mask_model",
    "detector.masks_revision": "detector.mask_model_revision",
    "detector.nms": "detector.nms_iou",
    "detector.of": "detector.detector",
    "detector.significance": "detector.min_foreground_fraction",
    "detector.small_side": "detector.miss_size_scale",
    "detector.spread": "detector.class_spread",
    "detector.surroundings": "detector.background_contrast",
    "detector.white": "detector.white_level",
    "detector.words": "detector.text_queries",
    "fuser.absence": "fuser.absence_likelihood",
    "fuser.class_gate": "fuser.min_class_agreement",
    "fuser.lying_on": "fuser.support_overlap",
    "fuser.missed": "fuser.absence_likelihood_ratio",
    "fuser.on_top": "fuser.occlusion_area_ratio",
    "fuser.overlap": "fuser.min_overlap",
    "fuser.same_class": "fuser.require_same_class",
    "fuser.split": "fuser.split_instances",
    "refiner.cell": "refiner.cell_size",
    "refiner.closing": "refiner.closing_radius",
    "refiner.distance": "refiner.plane_distance",
    "refiner.gap": "refiner.max_gap",
    "refiner.max_behind": "refiner.max_behind_ratio",
    "refiner.max_own": "refiner.max_cluster_fraction",
    "refiner.min_node": "refiner.min_split_points",
    "refiner.min_share": "refiner.min_frame_fraction (plane_removal) or refiner.min_piece_ratio (connected)",
    "refiner.noise": "refiner.inverse_depth_noise",
    "refiner.reach": "refiner.connection_radius",
    "refiner.steepest": "refiner.max_depth_slope",
    "refiner.whole_segments": "refiner.grow_to_segments",
    "refiner.window": "refiner.window_radius",
    "table.across": "table.columns_by",
    "table.baseline": "table.base",
    "table.by": "table.group_by",
    "table.over": "table.average_over",
    "tracker.finest": "tracker.finest_scale",
    "tracker.max_behind": "tracker.max_occluded",
    "tracker.max_step": "tracker.max_translation",
    "tracker.max_turn": "tracker.max_rotation",
    "tracker.world": "tracker.world_frame",
    "viewer.every": "viewer.frame_interval",
    "viewer.mesh_every": "viewer.mesh_interval",
    "viewer.region": "viewer.region_size",
}
"""New name of each removed key. Keys of a refiner in a chain (`refiner.links.NAME.KEY`) are listed as `refiner.KEY`."""


def _current(key: str) -> str:
    """Return the current name of a dotted config key, which may be deprecated."""
    found = _listed(DEPRECATED, key)
    return f"{key[: key.rfind('.') + 1]}{found.rpartition('.')[2]}" if found else key


def replace_deprecated(key: str) -> str:
    """Return the current name of a dotted config key. Log a warning if it is deprecated, once per process."""
    if (new := _current(key)) != key:
        _warn(key, new)
    return new


@cache
def _warn(key: str, new: str) -> None:
    log.warning("%s: deprecated, removed in the next minor version; set %s instead", key, new)


def replace_in_overrides(overrides: Sequence[str]) -> list[str]:
    """Return overrides with the current names of deprecated keys, and log warnings."""
    return [re.sub(r"^([+~]*)([^=]+)", lambda found: found[1] + replace_deprecated(found[2]), one) for one in overrides]


def replace_in_config(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the config of a stored run with the current names of deprecated keys."""
    return {
        _current(f"{prefix}{key}").removeprefix(prefix): replace_in_config(value, f"{prefix}{key}.")
        if isinstance(value, Mapping)
        else value
        for key, value in config.items()
    }


def new_name(key: str) -> str | None:
    """Return the new name of a dotted config key, or None if it was not renamed."""
    return _listed(RENAMED | DEPRECATED, key)


def _listed(names: Mapping[str, str], key: str) -> str | None:
    parts = key.split(".")
    return names.get(key) or (names.get(f"{parts[0]}.{parts[-1]}") if len(parts) > 2 else None)


def rename_hint(key: str) -> str:
    """Return the fix for a renamed key, such as "set resume_from (new name of map)", or "" for other keys."""
    found = new_name(key)
    return f"set {found} (new name of {key})" if found else ""
