"""Tests for the selection of frames by start, stop, stride and frame_fraction."""

import pytest

from framework.datasets.frames.sequence_reader import check_selection, choose_frames
from framework.errors import ConfigError


def test_frame_selection_matches_slice():
    assert list(choose_frames(10, 0, -1, 1)) == list(range(10))
    assert list(choose_frames(10, 2, 9, 3)) == [2, 5, 8]
    assert list(choose_frames(10, 8, 99, 1)) == [8, 9]


@pytest.mark.parametrize(
    ("start", "stop", "stride", "name"),
    [(-1, -1, 1, "start"), (0, -2, 1, "stop"), (5, 5, 1, "stop"), (0, -1, 0, "stride")],
)
def test_frame_selection_invalid_value_error_names_parameter(start, stop, stride, name):
    with pytest.raises(ConfigError, match=f"dataset.{name}"):
        check_selection(start, stop, stride)


def test_frame_selection_past_end_error_gives_frame_count():
    with pytest.raises(ConfigError, match=r"dataset\.start: expected a frame from 0 to 2, got 3"):
        choose_frames(3, 3, -1, 1)


def test_frame_fraction_is_seeded_ordered_subset():
    first = choose_frames(100, 10, 90, 2, frame_fraction=0.85, seed=3)
    assert len(first) == 34  # 85 % of 40
    assert list(first) == sorted(set(first))
    assert set(first) < set(range(10, 90, 2))
    assert first == choose_frames(100, 10, 90, 2, frame_fraction=0.85, seed=3)
    assert first != choose_frames(100, 10, 90, 2, frame_fraction=0.85, seed=4)
    assert all(type(index) is int for index in first)  # frame numbers are written to JSON


def test_frame_fraction_sampling_is_uniform():
    """In 1000 subsets, each of the 20 frames occurs 500 ± 80 times (5 standard deviations)."""
    taken = [index for seed in range(1000) for index in choose_frames(20, 0, -1, 1, frame_fraction=0.5, seed=seed)]
    counts = [taken.count(index) for index in range(20)]
    assert min(counts) > 420
    assert max(counts) < 580


def test_frame_fraction_one_keeps_all_frames():
    assert list(choose_frames(7, 1, -1, 2, frame_fraction=1.0, seed=9)) == [1, 3, 5]


def test_frame_fraction_minimum_keeps_one_frame():
    assert len(choose_frames(7, 0, -1, 1, frame_fraction=1e-9)) == 1


@pytest.mark.parametrize("share", [0.0, -0.1, 1.001, float("nan")])
def test_frame_fraction_invalid_value_error_names_parameter(share):
    with pytest.raises(ConfigError, match=r"dataset.frame_fraction: expected a value in \(0, 1\]"):
        check_selection(0, -1, 1, share)


def test_frame_fraction_negative_seed_raises():
    with pytest.raises(ConfigError, match="seed: expected at least 0, got -1"):
        choose_frames(7, 0, -1, 1, frame_fraction=0.5, seed=-1)
