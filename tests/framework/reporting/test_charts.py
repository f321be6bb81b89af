"""Tests for the SVG charts."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from framework.data import Box
from framework.evaluation.calibration import Forecasts
from framework.reporting.charts import (
    HEIGHT,
    WIDTH,
    Footprint,
    PlottedGraph,
    PlottedPath,
    box_corners,
    depth_corrections,
    growth,
    motions,
    position_errors,
    reliability,
    round_length,
    stage_areas,
    stage_rows,
    top_view,
)
from framework.runs.timings_file import StageTimes
from framework.sensors.depth_distortion import NODES, DepthDistortion

UP = np.array([0.0, 0.0, 1.0])


def parsed(picture: str) -> ElementTree.Element:
    """Return the XML tree of an SVG image after checking that all numbers are finite."""
    assert "nan" not in picture
    assert "inf" not in picture
    return ElementTree.fromstring(picture)


def group(picture: str, gid: str) -> list[ElementTree.Element]:
    return [one for one in parsed(picture).iter() if one.get("id") == gid]


def paths(picture: str, gid: str) -> list[np.ndarray]:
    found = [one.get("d", "") for owner in group(picture, gid) for one in owner.iter() if one.get("d")]
    return [np.array(re.findall(r"-?[\d.]+", d), float).reshape(-1, 2) for d in found]


def circle(radius: float) -> np.ndarray:
    angles = np.linspace(0, 1.9 * np.pi, 60)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), 0.3 * angles], axis=1)


def test_top_view_projects_paths_and_lost_poses() -> None:
    picture, share = top_view([PlottedPath(circle(2.0), [5])], [circle(2.2)], [], UP)
    [mine], [true] = paths(picture, "chart-path"), paths(picture, "chart-true")
    assert np.ptp(mine, axis=0) == pytest.approx(np.full(2, np.ptp(mine[:, 1])), rel=0.03), (
        "expected equal scales of both axes"
    )
    assert np.ptp(true[:, 1]) / np.ptp(mine[:, 1]) == pytest.approx(1.1, rel=0.01)
    assert (true > 0).all()
    assert (true < [WIDTH, HEIGHT]).all()
    [owner] = group(picture, "chart-lost")
    [lost] = [one for one in owner.iter() if one.get("x")]
    assert [float(lost.get("x", 0)), float(lost.get("y", 0))] == pytest.approx(mine[5], abs=0.02)
    assert 0.5 < share < 1


def test_top_view_draws_anchors_and_each_loop_once() -> None:
    positions = circle(2.0)
    graph = PlottedGraph(positions[[0, 20, 40]], [(0, 2), (0, 2), (1, 2)])
    picture, _ = top_view([PlottedPath(positions)], [], [], UP, graph=graph)
    [mine] = paths(picture, "chart-path")
    assert [line.tolist() for line in paths(picture, "chart-loop")] == [
        pytest.approx(mine[[0, 40]], abs=0.02), pytest.approx(mine[[20, 40]], abs=0.02)
    ]  # fmt: skip
    [owner] = group(picture, "chart-anchors")
    anchors = [(float(one.get("x", 0)), float(one.get("y", 0))) for one in owner.iter() if one.get("x")]
    np.testing.assert_allclose(anchors, mine[[0, 20, 40]], atol=0.02)


def test_motions_are_drawn_by_frame() -> None:
    [line] = paths(motions([0, 1, 2], np.array([0.0, 0.01, 0.02])), "chart-motions")
    assert np.diff(line, axis=0) == pytest.approx(np.repeat(line[1:2] - line[:1], 2, axis=0), abs=0.02)


def test_reliability_shows_count_of_each_bin() -> None:
    picture = reliability({"Exists": Forecasts.of([(0.05, False), (0.55, True), (0.58, False), (1.0, True)])})
    assert picture.startswith("<svg")
    assert "Exists: n = 4, ECE" in picture
    assert [picture.count(f">{number}</text>") for number in (1, 2)] == [2, 1], "number of events of the three bins"


def test_depth_corrections_have_symmetric_scale() -> None:
    picture = depth_corrections(DepthDistortion(np.linspace(-0.002, 0.001, 63).reshape(NODES), (48, 64)), 2.0)
    texts = {one.text for one in parsed(picture).iter() if one.text}
    assert {"-8.0 mm", "0", "+8.0 mm"} <= texts
    assert picture.count("data:image/png") == 2
    assert " style=" not in picture


def test_top_view_escapes_object_names() -> None:
    corners = box_corners(Box(np.array([4.0, 0, 0]), np.array([2.0, 1.0, 0.5]), np.eye(3)))
    picture, share = top_view([PlottedPath(circle(0.1))], [], [Footprint(corners, "<cup>", "#ff0000")], UP)
    [shape] = paths(picture, "chart-object-0")
    shape = shape[:4]
    sides = np.linalg.norm(shape - np.roll(shape, 1, axis=0), axis=1)  # rotated until the path is horizontal
    assert sorted(sides / sides.min()) == pytest.approx([1, 1, 2, 2], rel=0.01)
    assert picture.count("&lt;cup&gt;") == 2, "expected the name in the tooltip and in the label"
    assert share < 0.1


@pytest.mark.parametrize(
    "positions", [np.zeros((2, 3)), np.linspace([0, 0, 0], [1, 2, 3], 5), np.array([[0, 0, 0], [0, 0, 9.0]])]
)
def test_top_view_of_degenerate_path_is_valid(positions: np.ndarray) -> None:
    flat = Footprint(np.zeros((8, 3)), "line", "#000000")
    for objects in ([], [flat]):
        parsed(top_view([PlottedPath(positions)], [positions], objects, UP)[0])


def test_chart_position_errors_are_in_millimeters() -> None:
    picture = position_errors([0, 50, 100], np.array([0.0, 0.010, 0.005]))
    [line] = paths(picture, "chart-errors")
    heights = line[0, 1] - line[:, 1]
    assert heights[1] == pytest.approx(2 * heights[2], rel=0.01)
    assert ">10</text>" in picture
    parsed(position_errors([7], np.zeros(1)))


def times(frames: int) -> StageTimes:
    generator = np.random.default_rng(0)
    fuse = generator.uniform(10, 30, frames)
    fuse[frames // 2] = np.nan  # a lost frame
    return StageTimes(np.arange(frames), {"tracking": generator.uniform(5, 6, frames), "integration": fuse})


def test_stage_rows_have_median_and_percentile() -> None:
    given = times(200)
    tracking, integration = stage_rows(given)
    assert (tracking.stage, integration.stage) == ("tracking", "integration")
    assert integration.median == pytest.approx(np.nanmedian(given.milliseconds["integration"]))
    assert integration.p95 == pytest.approx(np.nanpercentile(given.milliseconds["integration"], 95))
    picture = stage_areas(given)
    for stage in ("tracking", "integration"):
        [area] = paths(picture, f"chart-stage-{stage}")
        assert len(area) > 300
    assert "var(--tracking)" in picture


def test_svg_of_chart_is_deterministic_and_has_no_styles() -> None:
    picture = stage_areas(times(50))
    assert picture == stage_areas(times(50))
    assert "style" not in picture
    assert "var(--faint)" in picture


def test_scale_bar_length_is_round() -> None:
    assert [round_length(value) for value in (0.9, 1.0, 4.0, 70.0)] == pytest.approx([0.5, 1.0, 2.0, 50.0])


def test_stage_areas_of_one_frame_is_valid() -> None:
    parsed(stage_areas(StageTimes(np.array([3]), {"tracking": np.array([2.0])})))
    parsed(stage_areas(StageTimes(np.array([3]), {"tracking": np.array([np.nan])})))


def test_chart_growth_ends_with_all_objects_and_surface() -> None:
    picture = growth([0, 10, 20], np.array([0.2, 0.5, 1.0]), [0, 4, 12], 20)
    [seen], [objects] = paths(picture, "chart-seen"), paths(picture, "chart-objects")
    assert seen[-1] == pytest.approx(objects[-1], abs=0.02)
    assert (np.diff(objects[:, 1]) <= 0).all()
    assert len({*objects[:, 1].tolist()}) == 4
    parsed(growth([0], np.array([1.0]), [], 0))
