"""Tests of the parts of metric diagrams."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from framework.figures.figure_page import text_width, wrapped
from framework.figures.metric_axes import LINES, Names, draw_labels, spread, styles
from framework.figures.tradeoff_figure import pareto_front
from framework.tables.metric_columns import Direction


@settings(derandomize=True, deadline=None, max_examples=100)
@given(st.lists(st.floats(-5, 5), max_size=8), st.floats(0.01, 1))
def test_spread_keeps_label_order_distance_and_mean(places: list[float], gap: float) -> None:
    found = spread(places, gap)
    order = np.argsort(places, kind="stable")
    assert (np.diff(np.array(found)[order]) >= gap - 1e-9).all()
    if places:
        assert np.mean(found) == pytest.approx(np.mean(places), abs=1e-9)  # least-squares offsets sum to 0
    assert np.abs(np.array(spread(found, gap)) - found).max(initial=0) < 1e-9, "expected distant labels at their places"


def test_spread_moves_overlapping_labels_equally() -> None:
    assert spread([1.0, 5.0, 1.2], 1.0) == pytest.approx([0.6, 5.0, 1.6])


def test_spread_stays_between_limits() -> None:
    assert spread([0.9, 0.95, 1.0], 0.2, 0.1, 0.9) == pytest.approx([0.5, 0.7, 0.9])
    assert spread([0.0, 0.0], 0.3, 0.1, 0.9) == pytest.approx([0.1, 0.4])
    assert spread([], 0.3, 0.1, 0.9) == []


@pytest.mark.parametrize(
    ("better", "front"),
    [
        ((Direction.HIGHER, Direction.HIGHER), [1, 2]),
        ((Direction.LOWER, Direction.HIGHER), [0, 1]),
        ((Direction.HIGHER, Direction.LOWER), [3, 2]),
        ((Direction.NONE, Direction.HIGHER), []),
    ],
)
def test_pareto_front_is_not_dominated(better: tuple[Direction, Direction], front: list[int]) -> None:
    points = [(1.0, 0.5), (2.0, 0.9), (3.0, 0.4), (2.0, 0.3)]
    assert pareto_front(points, better) == front


def test_pareto_front_keeps_equal_points() -> None:
    assert pareto_front([(1.0, 1.0), (1.0, 1.0), (1.0, 0.5)], (Direction.HIGHER, Direction.HIGHER)) == [0, 1]


def test_styles_of_many_groups_are_distinct() -> None:
    assert len(set(styles(28))) == 28
    assert len({style.color for style in styles(7)}) == 7
    assert {style.line for style in styles(28)} == set(LINES)


def test_draw_labels_lines_start_at_points() -> None:
    axes = Figure((3, 2)).add_subplot()
    points = [(0.0, 1.0), (2.0, 8.0), (2.0, 8.5)]
    axes.plot(*zip(*points, strict=True), "o")
    names = Names(["a", "b", "a name of two lines"], 10.0)
    draw_labels(axes, points, names, ["black"] * 3, (40.0, 30.0))
    axes.figure.draw_without_rendering()
    starts = [axes.transAxes.transform(line.get_xydata()[0]) for line in axes.lines[1:]]
    np.testing.assert_allclose(starts, axes.transData.transform(points))
    boxes = [text.get_window_extent() for text in axes.texts]
    assert [text.get_text() for text in axes.texts] == names.texts
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.text("abc_=, .", max_size=60))
def test_wrapped_lines_fit_and_keep_text(text: str) -> None:
    lines = wrapped(text, 12.0, 7.0)
    assert all(text_width(line, 7.0) <= 12.0 for line in lines)
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")


def test_wrapped_breaks_long_words_after_separators() -> None:
    assert wrapped("chain_without_plane_removal", 16.0, 7.0) == ["chain_", "without_", "plane_", "removal"]
