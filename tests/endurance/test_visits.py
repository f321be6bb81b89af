"""Tests for the measurements of the endurance run, with a small mapper."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from framework.api import FrameResult, Mapper
from framework.data import Camera, Frame
from framework.interfaces import MapStatistics
from framework.runtime.run_log import STAGES
from tests.endurance.growth import verdicts
from tests.endurance.places import Moment, Place
from tests.endurance.visits import visit_all
from tests.support.reference_time import Reference

CAMERA = Camera(16, 16, 16.0, 16.0, 7.5, 7.5)
VIEWS, VISITS = 10, 5


class SmallMapper:
    """Mapper that allocates `leak` bytes in each frame. Each tenth frame is lost."""

    def __init__(self, leak: int) -> None:
        self.pipeline = SimpleNamespace(viewer=None)
        table = SimpleNamespace(records=range(5))
        self.scene = SimpleNamespace(
            table=table, statistics=MapStatistics(100, 2000), instance_ids=lambda: frozenset({1, 2, 3})
        )
        self._leak, self._kept = leak, [b""] * 2 * VIEWS * VISITS

    def add(self, frame: Frame) -> FrameResult:
        self._kept[frame.index] = bytes(self._leak)
        self.pipeline.viewer.show(frame, None, None, {"tracking": 3.0})
        T = np.eye(4)
        T[0, 3] = 0.004
        return FrameResult(T, lost=frame.index % 10 == 9)


class SmallPlace(Place):
    """Place of small images."""

    name = "small"

    def __init__(self, leak: int) -> None:
        super().__init__(VIEWS)
        self._leak = leak

    def mapper(self) -> Mapper:
        return cast(Mapper, SmallMapper(self._leak))

    def frame_at(self, moment: Moment) -> Frame:
        color, depth = np.zeros((16, 16, 3), np.uint8), np.full((16, 16), moment.view + 1, np.float32)
        return Frame(moment.number, moment.time, color, depth, CAMERA, np.eye(4))


def visited(*places: Place) -> list[Any]:
    reference = cast(Reference, SimpleNamespace(milliseconds=lambda: 1.0))
    return list(visit_all(places, VISITS, reference))


def test_place_visit_passes_views_forward_and_backward() -> None:
    place = SmallPlace(0)
    frames = [place.frame(number) for number in range(2 * place.visit_frames)]
    views = [frame.depth[0, 0] - 1 for frame in frames]
    assert views == 2 * [*range(VIEWS), *reversed(range(VIEWS))]
    assert [frame.index for frame in frames] == list(range(len(frames)))
    steps = np.diff([frame.timestamp for frame in frames])
    np.testing.assert_allclose(np.delete(steps, place.visit_frames - 1), 1 / 30)
    assert steps[place.visit_frames - 1] > 5, "expected a pause between two visits"


def test_visits_alternate_between_places() -> None:
    blocks = visited(SmallPlace(0), SmallPlace(0))
    assert [block.visit for block in blocks] == [visit for visit in range(VISITS) for _ in range(8)]
    assert [block.position for block in blocks] == 2 * VISITS * [0, 1, 2, 3]
    assert [block.all_frames for block in blocks] == list(range(5, 2 * VISITS * 20 + 1, 5))


def test_block_contains_measurements_of_its_frames() -> None:
    block = visited(SmallPlace(0))[1]  # frames 5 to 9
    assert (block.lost, block.confirmed, block.tentative, block.map_bytes) == (1, 3, 2, 2000)
    np.testing.assert_allclose(block.errors_mm, [4, 4, 4, 4, np.nan])
    assert (block.stage_ms[:, STAGES.index("tracking")] == 3).all()
    assert np.isnan(block.stage_ms[:, STAGES.index("lifting")]).all()
    assert len(block.cpu_ms) == 5
    assert np.isfinite(block.cpu_ms).all()


@pytest.mark.parametrize(("leak", "met"), [(0, True), (1000, False)])
def test_heap_bound_detects_leak(leak: int, met: bool) -> None:
    [verdict] = [one for one in verdicts(visited(SmallPlace(leak))) if one.bound.quantity == "heap"]
    assert verdict.is_met == met
    if leak:
        assert verdict.measured.value == pytest.approx(leak, rel=0.1)
