"""Tests for the check of the delay between color and depth."""

from __future__ import annotations

from dataclasses import replace

import pytest

from framework.checking import Verdict
from framework.checking.color_timing import check_color_delay
from framework.checking.matched_pairs import Matcher
from framework.data import Camera, Frame
from framework.interfaces import RGBDSequence
from tests.framework.tracking.test_color_delay import CAMERA, delayed_frames


class Delayed(RGBDSequence):
    """Sequence with poses whose color images are captured `delay` s after the depth images."""

    def __init__(self, delay: float, speed: float = 1.0, constant: float | None = None) -> None:
        self.frames = [replace(frame, T_world_camera=pose) for frame, pose in delayed_frames(delay, 60, speed)]
        self.camera: Camera = CAMERA
        self.name = "delayed"
        self.constant = constant

    def constant_color_delay(self) -> float | None:
        return self.constant

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> Frame:
        return self.frames[k]


@pytest.mark.parametrize(("delay", "corrected"), [(0.03, True), (0.0, False)])
def test_color_delay_check_reports_estimate(delay: float, corrected: bool) -> None:
    sequence = Delayed(delay)
    finding = check_color_delay(Matcher(sequence))
    assert finding.verdict is Verdict.FINE
    words = finding.text.split()
    assert float(words[2]) == pytest.approx(1e3 * delay, abs=2)
    assert ("corrected in the run" in finding.text) is corrected


def test_color_delay_check_of_stationary_camera_is_unknown() -> None:
    sequence = Delayed(0.03, speed=0)
    assert check_color_delay(Matcher(sequence)).verdict is Verdict.UNKNOWN


def test_color_delay_check_reports_given_delay() -> None:
    sequence = Delayed(0.03, speed=0, constant=0.02)
    finding = check_color_delay(Matcher(sequence))
    assert finding.verdict is Verdict.FINE
    assert finding.text.startswith("20 ms, as set")
