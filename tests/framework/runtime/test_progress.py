"""Tests for the progress display, with and without a terminal."""

from __future__ import annotations

import io
import logging
import sys

import numpy as np
import pytest

from framework.runtime import progress
from framework.runtime.progress import MAX_INTERVAL, MIN_INTERVAL, Progress
from framework.runtime.run_log import Journal
from tests.support.scenes.corner_room import GridFuser
from tests.support.terminals import terminal_stderr


class Clock:
    """Clock whose time, s, is set by the test."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def test_progress_line_interval_grows_with_time(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    lines = []
    with Progress(None, " frames") as bar:
        for second in np.arange(0, 3600, 0.5):
            clock.now = 100 + float(second)
            if bar.line_is_due():
                lines.append(second)
    assert lines[:4] == [MIN_INTERVAL * k for k in (1, 2, 3, 4)]
    assert np.diff([line for line in lines if line < 30]).max() == MIN_INTERVAL
    assert np.diff(lines)[-1] == MAX_INTERVAL
    assert len(lines) == pytest.approx(10 + 10 * np.log(600 / 30) + 3000 / MAX_INTERVAL, abs=5)


@pytest.mark.parametrize("columns", [80, 0])
def test_progress_bar_is_shown_in_terminal_of_any_width(
    columns: int, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    with terminal_stderr(columns, monkeypatch) as shown, Progress(7, " frames") as bar:
        clock.now += 100
        assert not bar.line_is_due()
    assert "0/7" in shown[0]


def test_progress_with_tqdm_disable_has_no_lines(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TQDM_DISABLE", "1")
    with Progress(7, " frames") as bar:
        clock.now += 100
        assert not bar.line_is_due()


def test_mapping_progress_without_terminal_is_logged(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with caplog.at_level(logging.INFO), Journal(GridFuser().scene, 3, "tracked") as journal:
        for _ in range(3):
            clock.now += 2
            journal.frame_begins()
    assert [record.message for record in caplog.records] == ["frame 2 of 3, 0 instances"]
