"""Tests for the drawing thread. The thread must not block mapping, and logs each failure once."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from framework.data import Pose
from framework.live_view import drawing_thread
from framework.live_view.drawing_thread import DrawingThread, FrameNote, FrameUpdate, MapSnapshot, Pace
from framework.pipeline import Pipeline
from tests.support.scenes.corner_room import CornerRoom, GivenPose, GridFuser, GridMap, KeepAll, SphereDetector

EXACT = SphereDetector()


@dataclass
class RecordedDrawing:
    """Drawing that records its input. On request, `draw_frames` waits for an event or fails."""

    waits_for: threading.Event | None = None
    fails: bool = False
    fails_to_close: bool = False
    notes: list[FrameNote] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    pictures: list[FrameUpdate] = field(default_factory=list)
    maps: list[MapSnapshot] = field(default_factory=list)
    threads: set[str] = field(default_factory=set)
    closed: bool = False

    def draw_frames(self, notes: Sequence[FrameNote], skipped: Sequence[str], picture: FrameUpdate | None) -> None:
        self.threads.add(threading.current_thread().name)
        if self.fails:
            raise OSError(28, "No space left on device")
        if self.waits_for is not None:
            assert self.waits_for.wait(30)
        self.notes += notes
        self.faults += skipped
        self.pictures += [picture] if picture else []

    def draw_map(self, snapshot: MapSnapshot) -> None:
        self.maps.append(snapshot)

    def close(self) -> None:
        self.closed = True
        if self.fails_to_close:
            raise RuntimeError("the writer's thread has ended")


def mapped(room: CornerRoom) -> GridMap:
    result = Pipeline(EXACT, GivenPose(), KeepAll(), GridFuser()).run(room)
    assert isinstance(result.scene, GridMap)
    return result.scene


def test_drawing_thread_draws_all_frames_and_final_map(room: CornerRoom) -> None:
    scene, book = mapped(room), RecordedDrawing()
    background = DrawingThread(scene, book, frame_interval=1, map_interval=3600)
    for frame in room:
        background.show(frame, EXACT.detect(frame), Pose(frame.T_world_camera, frame.index == 3), {"fusion": 1.5})
        background.skip(f"after {frame.index}")
    background.end()
    assert [note.index for note in book.notes] == list(range(6))
    assert [note.pose.lost for note in book.notes] == [index == 3 for index in range(6)]
    assert book.notes[2].stage_ms == {"fusion": 1.5}
    assert book.faults == [f"after {index}" for index in range(6)]
    assert book.pictures[-1].frame.index == 5
    assert book.maps[-1].index == 5
    np.testing.assert_array_equal(book.maps[-1].mesh.vertices, scene.mesh().vertices)
    assert book.maps[-1].objects == {1: (0, pytest.approx(0.9)), 2: (1, pytest.approx(0.8))}
    assert book.threads == {"viewer"}
    assert book.closed


def test_drawing_thread_after_delay_draws_newest_image(room: CornerRoom) -> None:
    going_on, book = threading.Event(), RecordedDrawing()
    book.waits_for = going_on
    background = DrawingThread(mapped(room), book, frame_interval=1, map_interval=3600)
    background.show(room[0], EXACT.detect(room[0]), Pose(room[0].T_world_camera), {})
    while not book.threads:  # until the thread draws and blocks
        time.sleep(0.001)
    for frame in list(room)[1:]:
        background.show(frame, EXACT.detect(frame), Pose(frame.T_world_camera), {})
    assert not book.notes, "expected all frames in the queue and none drawn"
    going_on.set()
    background.end()
    assert [picture.frame.index for picture in book.pictures] == [0, 5]
    assert [note.index for note in book.notes] == list(range(6))


@pytest.mark.parametrize("every", [2, 4])
def test_drawing_thread_draws_images_at_frame_interval(room: CornerRoom, every: int) -> None:
    book = RecordedDrawing()
    background = DrawingThread(mapped(room), book, every, map_interval=3600)
    for frame in room:
        background.show(frame, EXACT.detect(frame), Pose(frame.T_world_camera), {})
    background.end()
    assert {picture.frame.index % every for picture in book.pictures} == {0}


def test_drawing_thread_draw_error_is_logged_once(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    book = RecordedDrawing(fails=True)
    background = DrawingThread(mapped(room), book, frame_interval=1, map_interval=3600)
    for frame in room:
        background.show(frame, EXACT.detect(frame), Pose(frame.T_world_camera), {})
        background.skip("a fault")
        time.sleep(0.02)
    background.end()
    logged = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert logged == ["viewer: disabled after an error; the run continues: [Errno 28] No space left on device"]
    assert book.closed


@pytest.mark.parametrize("fails", [False, True])
def test_drawing_thread_close_error_is_logged_once(
    fails: bool, room: CornerRoom, caplog: pytest.LogCaptureFixture
) -> None:
    background = DrawingThread(
        mapped(room), RecordedDrawing(fails=fails, fails_to_close=True), frame_interval=1, map_interval=3600
    )
    background.show(room[0], EXACT.detect(room[0]), Pose(room[0].T_world_camera), {})
    background.end()
    [logged] = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert ("No space left" if fails else "the writer's thread has ended") in logged


def test_drawing_thread_map_error_does_not_end_run(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    class Broken(GridMap):
        def mesh(self) -> None:  # type: ignore[override]
            raise MemoryError("Unable to allocate 40 GiB")

    book = RecordedDrawing()
    background = DrawingThread(Broken(vertices=[np.zeros((1, 3))]), book, frame_interval=1, map_interval=3600)
    background.show(room[0], EXACT.detect(room[0]), Pose(room[0].T_world_camera), {})
    background.end()
    assert "viewer: disabled after an error; the run continues: Unable to allocate 40 GiB" in caplog.text
    assert not book.maps


def test_drawing_thread_draws_last_frame_without_successor(room: CornerRoom) -> None:
    """The last frame must be drawn even if no other frame follows, like in a live stream."""
    book = RecordedDrawing()
    background = DrawingThread(mapped(room), book, frame_interval=1, map_interval=3600)
    for frame in room:
        background.show(frame, EXACT.detect(frame), Pose(frame.T_world_camera), {})
    deadline = time.monotonic() + 20
    while len(book.notes) < 6 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert [note.index for note in book.notes] == list(range(6))
    background.end()


class Clock:
    now = 100.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(drawing_thread.time, "perf_counter", lambda: clock.now)
    return clock


def did(paced: Pace, clock: Clock, seconds: float) -> None:
    with paced.kept():
        clock.now += seconds


@pytest.mark.parametrize(("seconds", "next_after"), [(0.001, 1.0), (0.2, 4.0)])
def test_pace_waits_for_interval_and_time_fraction(clock: Clock, seconds: float, next_after: float) -> None:
    paced = Pace(1.0, 0.05, lambda: clock.now)
    assert paced.due()
    did(paced, clock, 10.0)  # loads kernels
    assert paced.due()
    start = clock.now
    did(paced, clock, seconds)
    clock.now = start + next_after - 0.01
    assert not paced.due()
    clock.now += 0.02
    assert paced.due()


def test_pace_is_not_due_during_work(clock: Clock) -> None:
    paced = Pace(1.0, 0.05, lambda: clock.now)
    with paced.kept():
        assert not paced.due()
