"""Tests for the curves of stage times and their labels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.figures.stage_times import COLUMNS, MeanTimes, running_median, stage_times_figure
from framework.runs.timings_file import StageTimes

STAGES = [stage for stages in COLUMNS.values() for stage in stages]


def run(frames: list[int], **milliseconds: list[float]) -> StageTimes:
    return StageTimes(np.array(frames), {stage: np.array(values, float) for stage, values in milliseconds.items()})


@settings(derandomize=True, deadline=None, max_examples=50)
@given(
    st.lists(st.one_of(st.floats(0, 1e4), st.just(np.nan)), min_size=1, max_size=30),
    st.sampled_from([1, 3, 9]),
)
def test_running_median_matches_slow_reference(values: list[float], window: int) -> None:
    slow = []
    for k, value in enumerate(values):
        around = [one for one in values[max(0, k - window // 2) : k + window // 2 + 1] if not np.isnan(one)]
        slow.append(np.nan if np.isnan(value) else float(np.median(around)))
    np.testing.assert_array_equal(running_median(np.array(values), window), slow)


def test_mean_times_end_with_shortest_sequence() -> None:
    short = run([0, 2, 4], detection=[1, 1, 1], update=[4, 4, 4], integration=[6, 6, 6], tracking=[9, 9, 9])
    last = {"update": [5, 5, 5, 99, 99], "integration": [15, 15, 15, 99, 99]}
    long = run([0, 2, 4, 6, 8], detection=[3, 3, 3, 99, 99], **last)
    times = MeanTimes.of([short, long])
    np.testing.assert_array_equal(times.frames, [0, 2, 4])
    np.testing.assert_array_equal(times.mean["map integration"], [15, 15, 15])
    np.testing.assert_array_equal(times.lowest["map integration"], [10, 10, 10])
    np.testing.assert_array_equal(times.highest["map integration"], [20, 20, 20])
    assert (times.count, times.longest, times.columns) == (2, 8, ["Mask R-CNN", "map integration"])


def test_mean_times_skip_missing_frames() -> None:
    full = {stage: [10.0, 10.0, 10.0] for stage in STAGES}
    lost = run([0, 1, 2], **(full | {"association": [10, np.nan, 10]}))
    double = run([0, 2], **{stage: [20.0, 20.0] for stage in STAGES})  # frame 1 could not be read
    times = MeanTimes.of([lost, double])
    np.testing.assert_array_equal(times.frames, [0, 1, 2])
    np.testing.assert_array_equal(times.mean["Mask R-CNN"], [15, 10, 15])
    np.testing.assert_array_equal(times.mean["data association"], [30, np.nan, 30])


def test_mean_times_growth_ignores_single_slow_frames() -> None:
    frames = list(range(90))
    slow = [10.0] * 90
    slow[0], slow[50] = 4000.0, 900.0
    growing = list(np.linspace(10, 40, 90))
    times = MeanTimes.of([run(frames, refinement=slow, detection=growing)])
    assert times.mean["GMM"].max() == 10
    assert times.growth("GMM") == 1
    assert times.growth("Mask R-CNN") == pytest.approx((10 + 30 * 74.5 / 89) / (10 + 30 * 14.5 / 89))
    assert np.isnan(times.growth("map integration"))


def test_stage_times_figure_row_without_runs_is_empty() -> None:
    times = MeanTimes.of([run([0], refinement=[1.0], fusion=[2.0])])
    page = stage_times_figure({"ours": times, "prior": None}, "a note")
    first, second = page.figure.axes
    assert [text.get_text() for text in second.texts] == ["incomplete"]
    assert (len(second.lines), second.get_title(loc="left")) == (0, "prior")
    assert {"GMM", "1.0 ms", "×1.00"} <= {text.get_text() for text in first.texts}
    assert "map integration" not in {text.get_text() for text in first.texts}
