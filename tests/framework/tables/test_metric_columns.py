"""Tests for the headings and directions of metrics."""

from __future__ import annotations

import pytest

from framework.tables.metric_columns import Direction, direction, head


@pytest.mark.parametrize(
    ("key", "heading"),
    [
        ("instances.ap50", "AP50"),
        ("instances.ap50_agnostic", "AP50 agnostic"),
        ("instances.ap50.sink", "sink"),
        ("instances.ap50.couch", "sofa"),
        ("instances.ap25.couch", "sofa, AP25"),
        ("instances.ap.traffic light", "traffic light, AP"),
        ("instances.true_count.sink", "sink, ground truth"),
        ("instances.to_map.ap50", "AP50 to map"),
        ("stage_ms.update.median", "update (ms)"),
        ("stage_ms.update.p95", "update (ms, p95)"),
        ("trajectory.ate_rmse_m", "ATE (m)"),
        ("x.y", "x.y"),
        ("x.y.z", "x.y.z"),
    ],
)
def test_head_names_metric_and_unit(key: str, heading: str) -> None:
    assert head(key) == heading


@pytest.mark.parametrize(
    ("better", "keys"),
    [
        (Direction.HIGHER, "instances.ap50 instances.ap50.sink instances.to_map.ap instances.recall50 fps fps_median"),
        (
            Direction.LOWER,
            "stage_ms.fusion.median trajectory.ate_rmse_m frames_lost map.bytes peak_rss_bytes latency_ms.p95",
        ),
        (
            Direction.NONE,
            "instances.count instances.true_count.sink frames map.voxels map.up.x color_delay_s my_metric",
        ),
    ],
)
def test_direction_of_metric_is_higher_or_lower_or_none(better: Direction, keys: str) -> None:
    assert {key: direction(key) for key in keys.split()} == dict.fromkeys(keys.split(), better)
