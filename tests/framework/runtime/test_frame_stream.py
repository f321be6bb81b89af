"""Tests for live video. The newest frame is mapped, and other frames are dropped and counted."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from framework.data import Frame, PointClusters, Pose
from framework.errors import DataError, FrameError
from framework.interfaces import FrameReader, LiveVideo, RGBDVideo, SceneMap, StageTimer, untimed
from framework.runs.metrics import run_metrics
from framework.runs.run_directory import headline
from framework.runtime.frame_stream import LiveFrames, stream_of
from tests.framework.test_pipeline import PREFETCH, PressesCtrlC, mapped, pipeline, working_threads
from tests.support.scenes.corner_room import (
    CornerRoom,
    FaultyDetector,
    GivenPose,
    GridFuser,
    LiveRoom,
    SphereDetector,
    pose_at,
)

PATIENCE_S = 10.0
SLOW_S = 0.03  # s, duration of a stage that is too slow for the video


@dataclass
class Handed(LiveVideo):
    """Live video whose frames are numbers passed to `come`, which waits until they have been received."""

    def __post_init__(self) -> None:
        self.name = "handed"
        self.coming: list[int | FrameError] = []
        self.asked = threading.Semaphore(0)
        self.over = False

    def frames(self) -> Generator[FrameReader | FrameError | None]:
        while not self.over:
            while self.coming:
                one = self.coming.pop(0)
                yield one if isinstance(one, FrameError) else partial(int, one)  # type: ignore[misc]
            self.asked.release()
            time.sleep(0.001)
            yield None

    def come(self, *frames: int | FrameError) -> None:
        self.coming.extend(frames)
        for _ in range(3):  # iterations of the listener; the last one begins after the frames were added
            while self.asked.acquire(blocking=False):
                pass
            assert self.asked.acquire(timeout=PATIENCE_S)
        assert not self.coming


def taken(stream: LiveFrames) -> object:
    found = stream.take()
    return found if found is None or isinstance(found, FrameError) else found()


def test_live_frames_return_newest_and_count_dropped() -> None:
    video = Handed()
    with LiveFrames(video, lambda: False) as stream:
        video.come(0)
        assert (taken(stream), stream.dropped) == (0, 0)
        video.come(1, 2, 3)
        assert (taken(stream), stream.dropped) == (3, 2)
        video.come(4)
        video.come(5)
        video.over = True
        assert (taken(stream), stream.dropped) == (5, 3), "expected the last frame at the end of the video"
        assert taken(stream) is None
        assert taken(stream) is None


def test_live_frames_unusable_frame_does_not_replace_usable_frame() -> None:
    video, errors = Handed(), [FrameError(f"frame {k}") for k in range(3)]
    with LiveFrames(video, lambda: False) as stream:
        video.come(1, *errors[:2])
        assert [taken(stream) for _ in range(3)] == [*errors[:2], 1]
        assert (stream.dropped, stream.dropped_of(frames=3)) == (0, 0)
        stream.reported(errors[0])
        video.come(4, errors[2], 6, 7)
    assert stream.dropped == 2
    assert stream.unreported() == errors[1:], "expected also error 1, which was taken, but not reported"
    assert stream.dropped_of(frames=4) == 3, "expected frame 7, which was not taken, among the dropped frames"


@PREFETCH
@pytest.mark.parametrize("interrupted", [False, True])
def test_live_run_counts_every_frame_once(prefetch: int, interrupted: bool) -> None:
    """Every third frame is unusable; the others come faster than they are mapped."""

    @dataclass
    class Interrupts(GivenPose):
        def track(self, frame: Frame, scene: SceneMap) -> Pose:
            if interrupted:
                os.kill(os.getpid(), signal.SIGINT)
            return super().track(frame, scene)

    @dataclass
    class Unusable(LiveRoom):
        def frames(self) -> Generator[FrameReader | FrameError | None]:
            self.bad = 0
            for reader in super().frames():
                if reader is None or self.sent % 3:
                    yield reader
                else:
                    self.bad += 1
                    yield FrameError(f"frame {self.sent}: unusable")

    video = Unusable(frames_sent=40, period_s=0.003)
    result = pipeline(prefetch, tracker=Interrupts(), fuser=GridFuser(slow_s=SLOW_S)).run(video)
    assert result.live is not None
    assert result.frames_skipped == video.bad
    assert result.frames + result.live.frames_dropped == video.sent
    assert (result.frames - result.frames_skipped == 1) == interrupted


def test_live_frames_take_waits_for_frame_or_end() -> None:
    video, ended = Handed(), threading.Event()
    found: list[object] = []
    with LiveFrames(video, ended.is_set) as stream:
        waiting = threading.Thread(target=lambda: found.extend([taken(stream), taken(stream)]))
        waiting.start()
        video.come(7)
        ended.set()
        waiting.join(PATIENCE_S)
        assert found == [7, None]
        video.come(8)
        assert taken(stream) is None, "expected no frame after the end"


def test_live_frames_raise_video_error_after_last_frame() -> None:
    video = LiveRoom(fails_after=1)
    with LiveFrames(video, lambda: False) as stream:
        assert isinstance(taken(stream), Frame)
        for _ in range(2):
            with pytest.raises(DataError, match="expected a connected camera, got none"):
                stream.take()
    assert video.closed


def test_live_frames_exit_closes_device() -> None:
    video, before = LiveRoom(frames_sent=1000), threading.active_count()
    with LiveFrames(video, lambda: False) as stream:
        taken(stream)
    assert video.closed
    assert threading.active_count() == before


def test_frame_stream_of_unsupported_video_raises() -> None:
    class Neither(RGBDVideo):
        name = "neither"

    with pytest.raises(DataError, match=r"dataset: expected an RGBDSequence or a LiveVideo, got .*Neither"):
        stream_of(Neither(), lambda: False)


@PREFETCH
def test_live_video_at_slow_rate_is_mapped_without_drops(prefetch: int) -> None:
    threads, video = working_threads(), LiveRoom(unreadable=2)
    result = pipeline(prefetch).run(video)
    assert (result.frames, result.frames_skipped, result.stopped_by) == (6, 1, None)
    assert result.live is not None
    assert result.live.frames_dropped == 0
    assert [frame.index for frame in result.tracked] == [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(result.tracked[4].pose.T_world_camera, pose_at(5))
    assert len(result.live.latencies) == 5
    assert all(0 < latency < PATIENCE_S for latency in result.live.latencies)
    assert working_threads() == threads


@PREFETCH
def test_live_video_detects_every_nth_mapped_frame(prefetch: int) -> None:
    video = LiveRoom(frames_sent=60, period_s=SLOW_S / 6)
    result = pipeline(prefetch, detection_interval=2, fuser=GridFuser(slow_s=SLOW_S)).run(video)
    detected = [one.frame for one in result.timings if one.stage == "detection"]
    assert detected == [frame.index for frame in result.tracked][::2]


@PREFETCH
def test_live_video_at_fast_rate_drops_and_counts_frames(prefetch: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("WARNING")
    video = LiveRoom(frames_sent=60, period_s=SLOW_S / 6)
    result = pipeline(prefetch, fuser=GridFuser(slow_s=SLOW_S)).run(video)
    assert result.live is not None
    assert result.frames + result.live.frames_dropped == video.sent == 60
    assert result.frames < 40
    indices = [frame.index for frame in result.tracked]
    assert indices == sorted(set(indices))
    assert indices[-1] == 59, "expected the last frame of the video"
    assert caplog.messages == [
        f"{result.live.frames_dropped} frames dropped because newer frames replaced them or the run ended"
    ]


def test_live_video_frames_are_not_queued() -> None:
    """Each queued frame would increase the latency."""
    video, waiting = LiveRoom(frames_sent=200, period_s=0.002), []

    @dataclass
    class Slow(GridFuser):
        def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
            super().fuse(frame, pose, clusters, timer)
            waiting.append(video.read - len(waiting) - 1)

    pipeline(prefetch=5, fuser=Slow(slow_s=SLOW_S)).run(video)
    assert max(waiting) == 1


def test_live_run_metrics_have_drops_and_latency() -> None:
    result = pipeline(fuser=GridFuser(slow_s=SLOW_S)).run(LiveRoom(frames_sent=30, period_s=0.005))
    assert result.live is not None
    metrics = run_metrics(result)
    assert metrics["frames_dropped"] == result.live.frames_dropped > 0
    assert metrics["latency_ms"] == pytest.approx(1e3 * float(np.median(result.live.latencies)))
    title = headline({"sequence": "live_room", **metrics})
    assert f"{result.live.frames_dropped} dropped" in title
    assert f"latency {metrics['latency_ms']:.0f} ms" in title


def test_recorded_run_has_no_live_metrics(room: CornerRoom) -> None:
    result = pipeline(fuser=GridFuser(slow_s=SLOW_S)).run(room)
    assert (result.frames, result.live) == (6, None)
    assert not {"frames_dropped", "latency_ms"} & run_metrics(result).keys()


@PREFETCH
def test_live_video_ctrl_c_ends_normally(prefetch: int) -> None:
    video, threads = LiveRoom(frames_sent=1000), working_threads()
    result = pipeline(prefetch, tracker=PressesCtrlC(at=0)).run(video)
    assert result.stopped_by is None
    assert len(mapped(result).vertices) == result.frames == 1
    assert video.closed
    assert working_threads() == threads


def test_live_video_second_ctrl_c_interrupts_frame() -> None:
    video = LiveRoom(frames_sent=1000)
    result = pipeline(tracker=PressesCtrlC(at=2, times=2)).run(video)
    assert isinstance(result.stopped_by, KeyboardInterrupt)
    assert len(mapped(result).vertices) == 2
    assert video.closed


def test_live_video_ctrl_c_before_first_frame_raises() -> None:
    """The worker waits for the first frame, which is never sent."""

    @dataclass
    class Silent(LiveRoom):
        def frames(self) -> Generator[FrameReader | None]:
            os.kill(os.getpid(), signal.SIGINT)
            while True:
                time.sleep(0.01)
                yield None

    with pytest.raises(KeyboardInterrupt):
        pipeline().run(Silent())


def test_live_video_failure_keeps_partial_map() -> None:
    result = pipeline().run_to_any_end(LiveRoom(fails_after=3))
    assert isinstance(result.stopped_by, DataError)
    assert result.frames == 3
    with pytest.raises(DataError, match="expected a connected camera, got none"):
        pipeline().run_to_any_end(LiveRoom(fails_after=0))


def test_live_video_without_usable_frame_raises() -> None:
    with pytest.raises(DataError, match="live_room: expected at least one frame, got none"):
        pipeline().run(LiveRoom(frames_sent=0))
    with pytest.raises(DataError, match="expected usable frames, got none among 1"):
        pipeline().run(LiveRoom(frames_sent=1, unreadable=0))
    with pytest.raises(DataError, match="expected ground-truth poses, got none for its frames;"):
        pipeline(tracker=GivenPose()).run(Handed())


@PREFETCH
def test_live_stage_exception_leaves_no_threads(prefetch: int) -> None:
    """When the exception is raised, the worker can be waiting for a frame."""
    video, threads = LiveRoom(frames_sent=1000), working_threads()
    with pytest.raises(OSError, match="Input/output error"):
        pipeline(prefetch, detector=FaultyDetector(at=0)).run(video)
    with pytest.raises(OSError, match="Input/output error"):
        pipeline(prefetch, detector=FaultyDetector(at=2)).run(LiveRoom(frames_sent=1000))
    assert video.closed
    assert working_threads() == threads


def test_live_detector_runs_only_on_mapped_frames() -> None:
    seen: list[int] = []

    @dataclass
    class Noting(SphereDetector):
        def detect(self, frame: Frame):  # type: ignore[no-untyped-def]
            seen.append(frame.index)
            return super().detect(frame)

    result = pipeline(detector=Noting(), fuser=GridFuser(slow_s=SLOW_S)).run(LiveRoom(frames_sent=40, period_s=0.005))
    assert len(seen) == result.frames < 40
