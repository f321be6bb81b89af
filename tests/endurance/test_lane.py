"""Tests for the endurance run as a whole, with few frames."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import pytest

from framework.errors import ConfigError
from tests.endurance import lane
from tests.endurance.growth import BOUNDS, Measured, Verdict

PLACES = ("redkitchen", "freiburg1_rpy", "standing", "room")


@pytest.mark.acceptance
@pytest.mark.usefixtures("shared_data")
def test_short_run_writes_page_and_figure(tmp_path: Path) -> None:
    found = lane.run(lane.MIN_FRAMES, tmp_path)
    assert [(one.bound, one.place) for one in found] == [(bound, place) for bound in BOUNDS for place in PLACES]
    page = (tmp_path / "endurance.md").read_text()
    assert "maps 112 frames of 4 sequences" in page
    assert f"|growth|bound|{'|'.join(PLACES)}|" in page
    assert "\n|lost frames|0 frames|0|0|0|0|" in page
    assert cv2.imread(str(tmp_path / "endurance.png")).shape[1] > 1000


def test_run_of_too_few_frames_raises(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--frames: expected at least 112, got 111"):
        lane.run(111, tmp_path)


@pytest.mark.parametrize(("value", "status"), [(499.0, 0), (501.0, 1)])
def test_command_status_is_nonzero_if_bound_is_missed(
    value: float, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["endurance"])
    monkeypatch.setattr(lane, "run", lambda frames, folder: [Verdict("room", BOUNDS[0], Measured(value, None))])
    with pytest.raises(SystemExit) as caught:
        lane.main()
    assert caught.value.code == status
    expected = "room: heap: expected at most 500 bytes per frame, got 501\n" if status else ""
    assert capsys.readouterr().err == expected
