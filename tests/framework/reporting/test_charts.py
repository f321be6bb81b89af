"""Diagrams as SVG: what they show, and that nothing makes them fail."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from framework.data import Box
from framework.reporting.time_charts import growth, stage_areas, stage_rows
from framework.reporting.trajectory_chart import (
    HEIGHT,
    WIDTH,
    Footprint,
    Way,
    box_corners,
    error_over_time,
    top_view,
)
from framework.runs.timings_file import StageTimes

UP = np.array([0.0, 0.0, 1.0])


def parsed(picture: str) -> ElementTree.Element:
    """The picture's XML. Fails for numbers that are none."""
    assert "nan" not in picture
    assert "inf" not in picture
    return ElementTree.fromstring(picture)


def paths(picture: str, css: str) -> list[np.ndarray]:
    found = [one.get("d", "") for one in parsed(picture).iter() if one.get("class") == css]
    return [np.array(re.findall(r"-?[\d.]+", d), float).reshape(-1, 2) for d in found]


def circle(radius: float) -> np.ndarray:
    angles = np.linspace(0, 1.9 * np.pi, 60)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), 0.3 * angles], axis=1)


def test_the_view_from_above_keeps_shapes_and_marks_where_the_camera_was_lost() -> None:
    picture, share = top_view([Way(circle(2.0), "mine", [5])], [circle(2.2)], [], UP)
    [mine], [true] = paths(picture, "way mine"), paths(picture, "way truth")
    assert np.ptp(mine, axis=0) == pytest.approx(np.full(2, np.ptp(mine[:, 1])), rel=0.03), "a circle stays one"
    assert np.ptp(true[:, 1]) / np.ptp(mine[:, 1]) == pytest.approx(1.1, rel=0.01)
    assert (true > 0).all()
    assert (true < [WIDTH, HEIGHT]).all()
    [lost] = [one for one in parsed(picture).iter() if one.get("class") == "lost"]
    assert [float(lost.get("cx", 0)), float(lost.get("cy", 0))] == pytest.approx(mine[5], abs=0.02)
    assert 0.5 < share < 1


def test_objects_are_in_the_view_with_their_names_escaped() -> None:
    corners = box_corners(Box(np.array([4.0, 0, 0]), np.array([2.0, 1.0, 0.5]), np.eye(3)))
    picture, share = top_view([Way(circle(0.1), "mine")], [], [Footprint(corners, "<cup>", "#ff0000")], UP)
    [shape] = paths(picture, "footprint")
    sides = np.linalg.norm(shape - np.roll(shape, 1, axis=0), axis=1)  # turned, so that the way is level
    assert sorted(sides / sides.min()) == pytest.approx([1, 1, 2, 2], rel=0.01)
    assert "&lt;cup&gt;" in picture
    assert share < 0.1


@pytest.mark.parametrize(
    "positions", [np.zeros((2, 3)), np.linspace([0, 0, 0], [1, 2, 3], 5), np.array([[0, 0, 0], [0, 0, 9.0]])]
)
def test_ways_without_an_area_can_be_drawn(positions: np.ndarray) -> None:
    flat = Footprint(np.zeros((8, 3)), "line", "#000000")
    for objects in ([], [flat]):
        parsed(top_view([Way(positions, "mine")], [positions], objects, UP)[0])


def test_errors_are_drawn_in_millimetres() -> None:
    picture = error_over_time([0, 50, 100], np.array([0.0, 0.010, 0.005]))
    [line] = paths(picture, "way mine")
    heights = line[0, 1] - line[:, 1]
    assert heights[1] == pytest.approx(2 * heights[2], rel=0.01)
    assert ">10</text>" in picture
    parsed(error_over_time([7], np.zeros(1)))


def times(frames: int) -> StageTimes:
    generator = np.random.default_rng(0)
    fuse = generator.uniform(10, 30, frames)
    fuse[frames // 2] = np.nan  # a lost frame
    return StageTimes(np.arange(frames), {"track": generator.uniform(5, 6, frames), "fuse": fuse})


def test_stage_times_have_medians_and_percentiles() -> None:
    given = times(200)
    track, fuse = stage_rows(given)
    assert (track.stage, fuse.stage) == ("track", "fuse")
    assert fuse.median == pytest.approx(np.nanmedian(given.milliseconds["fuse"]))
    assert fuse.p95 == pytest.approx(np.nanpercentile(given.milliseconds["fuse"], 95))
    picture = stage_areas(given)
    [below], [above] = paths(picture, "area stage-track"), paths(picture, "area stage-fuse")
    count = len(below) // 2
    np.testing.assert_allclose(above[count:], below[:count][::-1])


def test_times_of_one_frame_can_be_drawn() -> None:
    parsed(stage_areas(StageTimes(np.array([3]), {"track": np.array([2.0])})))
    parsed(stage_areas(StageTimes(np.array([3]), {"track": np.array([np.nan])})))


def test_growth_ends_with_all_objects_and_all_of_the_surface() -> None:
    picture = growth([0, 10, 20], np.array([0.2, 0.5, 1.0]), [0, 4, 12], 20)
    [seen], [objects] = paths(picture, "way seen"), paths(picture, "way objects")
    assert seen[-1] == pytest.approx(objects[-1], abs=0.02)
    assert (np.diff(objects[:, 1]) <= 0).all()
    assert len({*objects[:, 1].tolist()}) == 4
    parsed(growth([0], np.array([1.0]), [], 0))
