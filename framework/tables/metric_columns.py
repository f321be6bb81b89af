"""Columns of metrics: the heading with its unit, and the direction of better values."""

from __future__ import annotations

from enum import IntEnum

from framework.vocabulary.label_spaces import SCENENN_TO_COCO


class Direction(IntEnum):
    """The direction of better values of a metric."""

    LOWER = -1
    NONE = 0  # neither, such as a number of frames
    HIGHER = 1


HEADS = {
    "instances.ap": "AP",
    "instances.ap25": "AP25",
    "instances.ap50": "AP50",
    "instances.ap25_agnostic": "AP25 agnostic",
    "instances.ap50_agnostic": "AP50 agnostic",
    "instances.mean_iou": "mean IoU",
    "instances.count": "instances",
    **{
        f"instances.to_map.{key}": f"{name} to map"
        for key, name in (("ap50", "AP50"), ("ap25", "AP25"), ("ap", "AP"), ("mean_iou", "mean IoU"))
    },
    "instances.to_map.ap50_agnostic": "AP50 agnostic, to map",
    "fps": "Hz",
    "fps_median": "Hz (median)",
    "frames_lost": "frames lost",
    "trajectory.ate_rmse_m": "ATE (m)",
    "trajectory.rpe_rmse_m": "RPE (m)",
    "map.bytes": "map (bytes)",
    "peak_rss_bytes": "peak memory (bytes)",
}
"""Column headings by key. `head` derives those of classes and stages; all other columns have their key."""

CLASS_HEADS = {"ap": ", AP", "ap25": ", AP25", "ap50": "", "true_count": ", ground truth"}
"""End of the headings of a class's metrics, by the second part of the key."""

SCENENN_NAMES = {coco: name for name, coco in SCENENN_TO_COCO.items()}

DIRECTIONS = {
    **dict.fromkeys(("instances.count", "instances.true_count", "instances.ignored_count"), Direction.NONE),
    **dict.fromkeys(("instances", "fps", "fps_median"), Direction.HIGHER),
    **dict.fromkeys(("trajectory", "stage_ms", "latency_ms", "map.bytes", "peak_rss_bytes"), Direction.LOWER),
    **dict.fromkeys(("frames_lost", "frames_skipped", "frames_dropped"), Direction.LOWER),
}
"""Direction by the first parts of a key; the longest match applies. Other metrics have none."""

IN_WORDS = {Direction.HIGHER: " (higher is better)", Direction.LOWER: " (lower is better)", Direction.NONE: ""}


def head(key: str) -> str:
    """Return the heading of a metric's column, with its unit."""
    parts = key.split(".", 2)
    if key in HEADS or len(parts) < 3:
        return HEADS.get(key, key)
    if parts[0] == "stage_ms":
        return f"{parts[1]} (ms{'' if parts[2] == 'median' else f', {parts[2]}'})"
    if parts[0] == "instances" and parts[1] in CLASS_HEADS:
        return SCENENN_NAMES.get(parts[2], parts[2]) + CLASS_HEADS[parts[1]]
    return key


def described(key: str) -> str:
    """Return the heading of a metric with the direction of better values in words."""
    return head(key) + IN_WORDS[direction(key)]


def direction(key: str) -> Direction:
    """Return the direction of better values of a metric."""
    parts = key.split(".")
    prefixes = (".".join(parts[:k]) for k in range(len(parts), 0, -1))
    return next((DIRECTIONS[prefix] for prefix in prefixes if prefix in DIRECTIONS), Direction.NONE)
