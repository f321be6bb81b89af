"""Column headings of metrics, and the direction in which each metric improves."""

from __future__ import annotations

from enum import IntEnum

from framework.vocabulary.label_spaces import SCENENN_TO_COCO


class Direction(IntEnum):
    """The direction in which a metric improves."""

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
    **{
        f"instances.scannet.{key}": f"{name} (ScanNet)"
        for key, name in (("ap", "AP"), ("ap50", "AP50"), ("ap25", "AP25"))
    },
    "panoptic.pq": "PQ",
    "panoptic.pq_things": "PQ (things)",
    "panoptic.pq_stuff": "PQ (stuff)",
    "semantic.miou": "mIoU",
    "fps": "Hz",
    "fps_median": "Hz (median)",
    "frames_lost": "frames lost",
    "trajectory.ate_rmse_m": "ATE (m)",
    "trajectory.tracked_ate_rmse_m": "ATE before correction (m)",
    "trajectory.rpe_rmse_m": "RPE (m)",
    "map.bytes": "map (bytes)",
    "map.doubled_instances": "doubled instances",
    "peak_rss_bytes": "peak memory (bytes)",
}
"""Column headings by key. The function `head` also returns headings of classes and stages."""

CLASS_HEADS = {"ap": ", AP", "ap25": ", AP25", "ap50": "", "true_count": ", ground truth"}
"""Ends of the headings of the metrics of one class, by the second part of the key."""

OF_CLASS = {
    "instances.scannet.ap.": "AP (ScanNet)",
    "instances.scannet.ap50.": "AP50 (ScanNet)",
    "instances.scannet.ap25.": "AP25 (ScanNet)",
    "semantic.iou.": "IoU",
}
"""Ends of the headings of benchmark metrics of one class, by prefix of the key."""

SCENENN_NAMES = {coco: name for name, coco in SCENENN_TO_COCO.items()}

DIRECTIONS = {
    **dict.fromkeys(("instances.count", "instances.true_count", "instances.ignored_count"), Direction.NONE),
    **dict.fromkeys(("instances", "panoptic", "semantic", "coverage", "fps", "fps_median"), Direction.HIGHER),
    **dict.fromkeys(("trajectory", "stage_ms", "latency_ms", "map.bytes", "map.doubled_instances"), Direction.LOWER),
    **dict.fromkeys(("frames_lost", "frames_skipped", "frames_dropped", "frames_disagreeing"), Direction.LOWER),
    **dict.fromkeys(("masks_omitted", "peak_rss_bytes"), Direction.LOWER),
}
"""Directions by prefix of the key. The longest prefix applies. Other metrics have no direction."""

IN_WORDS = {Direction.HIGHER: " (higher is better)", Direction.LOWER: " (lower is better)", Direction.NONE: ""}


def head(key: str) -> str:
    """Return the column heading of a metric, with its unit."""
    parts = key.split(".", 2)
    if key in HEADS or len(parts) < 3:
        return HEADS.get(key, key)
    if parts[0] == "stage_ms":
        return f"{parts[1]} (ms{'' if parts[2] == 'median' else f', {parts[2]}'})"
    if prefix := next((prefix for prefix in OF_CLASS if key.startswith(prefix)), None):
        return f"{key.removeprefix(prefix)}, {OF_CLASS[prefix]}"
    if parts[0] == "instances" and parts[1] in CLASS_HEADS:
        return SCENENN_NAMES.get(parts[2], parts[2]) + CLASS_HEADS[parts[1]]
    return key


def described(key: str) -> str:
    """Return the heading of a metric with the direction of better values in words."""
    return head(key) + IN_WORDS[direction(key)]


def direction(key: str) -> Direction:
    """Return the direction in which a metric improves."""
    parts = key.split(".")
    prefixes = (".".join(parts[:k]) for k in range(len(parts), 0, -1))
    return next((DIRECTIONS[prefix] for prefix in prefixes if prefix in DIRECTIONS), Direction.NONE)
