"""Tests for the main loop. Worker threads must not change the results."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numba
import numpy as np
import pytest
from tqdm import TMonitor

from framework.data import MAX_CLASSES, MAX_COVERAGE, Array, Detections, Frame, InstanceMesh, PointClusters, Pose
from framework.errors import ConfigError, DataError, FrameError, MapFullError
from framework.interfaces import FrameMasking, RGBDSequence, SceneMap, StageTimer, Viewer, untimed
from framework.pipeline import Pipeline
from framework.registry import assemble
from framework.runs.metrics import run_metrics
from framework.runtime.run_log import RunResult
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.masking.people import People
from tests.support.scenes.corner_room import (
    CAMERA,
    CLASSES,
    CornerRoom,
    FaultyDetector,
    GivenPose,
    GridFuser,
    GridMap,
    KeepAll,
    SphereDetector,
    pose_at,
)

PATIENCE_S = 60.0  # kernels may have to be compiled
PREFETCH = pytest.mark.parametrize("prefetch", [0, 1, 3])


def pipeline(prefetch: int = 2, detection_interval: int = 1, **stages: object) -> Pipeline:
    chosen = {"detector": SphereDetector(), "tracker": GivenPose(), "refiner": KeepAll(), "fuser": GridFuser()} | stages
    return Pipeline(**chosen, prefetch=prefetch, detection_interval=detection_interval)  # type: ignore[arg-type]


def mapped(result: RunResult) -> GridMap:
    assert isinstance(result.scene, GridMap)
    return result.scene


@pytest.mark.parametrize(
    ("classes", "expected"),
    [
        (tuple(map(str, range(MAX_CLASSES + 1))), "detector: expected at most 65535 classes, got 65536"),
        (("chair", 201 * "x"), "detector: expected class names of at most 200 characters, got 201"),
    ],
)
def test_pipeline_unsupported_label_space_raises(classes: tuple[str, ...], expected: str) -> None:
    detector = SphereDetector()
    detector.classes = classes
    with pytest.raises(DataError, match=expected):
        pipeline(detector=detector)


@PREFETCH
def test_pipeline_maps_all_frames_in_order(room: CornerRoom, prefetch: int) -> None:
    result = pipeline(prefetch).run(room)
    assert (result.frames, result.frames_lost, result.frames_skipped, result.stopped_by) == (6, 0, 0, None)
    assert [frame.index for frame in result.tracked] == list(range(6))
    np.testing.assert_array_equal(result.tracked[5].pose.T_world_camera, pose_at(5))
    assert set(mapped(result).instances()) == {1, 2}
    assert result.fps == pytest.approx(6 / result.seconds)
    assert len(result.intervals) == 5
    assert sum(result.intervals) <= result.seconds
    assert result.fps_median == pytest.approx(1 / sorted(result.intervals)[2])
    for stage in ("reading", "detection", "tracking", "lifting", "refinement", "fusion"):
        assert [time.frame for time in result.timings if time.stage == stage] == list(range(6))
    assert all(time.milliseconds >= 0 for time in result.timings)


def test_pipeline_sums_fuser_stage_times(room: CornerRoom) -> None:
    @dataclass
    class Timed(GridFuser):
        def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
            with timer("association"):
                time.sleep(0.003)
            with timer("integration"):
                super().fuse(frame, pose, clusters)
            with timer("association"):
                time.sleep(0.003)

    timings = pipeline(fuser=Timed()).run(room).timings
    assert [one.stage for one in timings if one.frame == 4][-3:] == ["association", "integration", "backend"]
    assert all(one.milliseconds >= 6 for one in timings if one.stage == "association")
    assert "fusion" not in {one.stage for one in timings}


@PREFETCH
def test_pipeline_detection_interval_detects_every_nth_frame(prefetch: int) -> None:
    @dataclass
    class Keeps(GridFuser):
        def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
            super().fuse(frame, pose, clusters)
            kept.append((frame.index, clusters.detected, len(clusters)))

    kept: list[tuple[int, bool, int]] = []
    result = pipeline(prefetch, fuser=Keeps(), detection_interval=3).run(CornerRoom(frames=8, unreadable=1))
    assert kept == [(k, k % 3 == 0, 2 * (k % 3 == 0)) for k in (0, 2, 3, 4, 5, 6, 7)]
    assert [one.frame for one in result.timings if one.stage == "detection"] == [0, 3, 6]
    assert len(result.tracked) == len(mapped(result).vertices) == 7


def test_pipeline_map_is_independent_of_prefetch(room: CornerRoom) -> None:
    meshes = [mapped(pipeline(prefetch, fuser=GridFuser(slow_s=0.002)).run(room)).mesh() for prefetch in (0, 1, 4)]
    for mesh in meshes[1:]:
        for name in ("vertices", "triangles", "colors", "instance_ids"):
            np.testing.assert_array_equal(getattr(mesh, name), getattr(meshes[0], name))


class _HiddenLeftHalf(FrameMasking):
    """Masking that removes the left half of the depth image, and the first detection."""

    def mask(self, frame: Frame, detections: Detections) -> tuple[Frame, Detections]:
        depth = frame.depth.copy()
        depth[:, : frame.camera.width // 2] = 0
        rows = {name: getattr(detections, name)[1:] for name in ("masks", "boxes", "scores", "class_probabilities")}
        return replace(frame, depth=depth), replace(detections, **rows)


def test_pipeline_tracks_and_fuses_masked_frames(room: CornerRoom) -> None:
    @dataclass
    class Keeps(GivenPose):
        def track(self, frame: Frame, scene: SceneMap) -> Pose:
            tracked.append(frame)
            return super().track(frame, scene)

    @dataclass
    class Shows(Viewer):
        def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
            shown.append((frame, len(detections)))

    tracked: list[Frame] = []
    shown: list[tuple[Frame, int]] = []
    scene = mapped(pipeline(tracker=Keeps(), viewer=Shows(), masking=_HiddenLeftHalf()).run(room))
    assert len(tracked) == len(shown) == 6
    for frame, (seen, detections) in zip(tracked, shown, strict=True):
        assert not frame.depth[:, : frame.camera.width // 2].any()
        assert frame.depth[:, frame.camera.width // 2 :].any()
        np.testing.assert_array_equal(seen.depth, frame.depth)
        assert detections == 1
    assert set(scene.instances()) == {1}


def test_pipeline_map_without_people_ignores_masking(room: CornerRoom) -> None:
    plain, masked = (mapped(pipeline(**stages).run(room)).mesh() for stages in ({}, {"masking": People()}))
    for name in ("vertices", "triangles", "colors", "instance_ids"):
        np.testing.assert_array_equal(getattr(masked, name), getattr(plain, name))


@PREFETCH
def test_pipeline_masked_map_is_independent_of_prefetch(prefetch: int) -> None:
    def mesh(prefetch: int) -> InstanceMesh:
        stages = {"masking": People(classes=CLASSES[0], min_score=0.0), "detection_interval": 3}
        return mapped(pipeline(prefetch, **stages).run(CornerRoom(frames=8))).mesh()  # type: ignore[arg-type]

    one, other = mesh(0), mesh(prefetch)
    for name in ("vertices", "triangles", "colors", "instance_ids"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


class _OfOtherSequence(SphereDetector):
    def check_sequence(self, sequence: RGBDSequence) -> None:
        raise DataError(f"{len(sequence)} frames of another sequence")


def test_pipeline_detector_rejects_sequence_before_first_frame(room: CornerRoom) -> None:
    with pytest.raises(DataError, match=f"{len(room)} frames of another sequence"):
        pipeline(detector=_OfOtherSequence()).run(room)


def test_pipeline_keeps_sequence_frame_indices() -> None:
    result = pipeline().run(CornerRoom(frames=9, start=1, stop=8, stride=3))
    assert [frame.index for frame in result.tracked] == [1, 4, 7]


@PREFETCH
def test_pipeline_skips_unreadable_frame(prefetch: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("WARNING")
    result = pipeline(prefetch).run(CornerRoom(unreadable=2))
    assert (result.frames, result.frames_skipped) == (6, 1)
    assert [frame.index for frame in result.tracked] == [0, 1, 3, 4, 5]
    assert [record.message for record in caplog.records] == ["frame skipped: frame 2: depth/000002.png is truncated"]


@PREFETCH
def test_pipeline_skips_frame_on_detector_frame_error(room: CornerRoom, prefetch: int) -> None:
    result = pipeline(prefetch, detector=SphereDetector(broken_at=0)).run(room)
    assert (result.frames_skipped, len(result.tracked)) == (1, 5)


def test_pipeline_skips_frame_on_refiner_frame_error(room: CornerRoom) -> None:
    @dataclass
    class Refuses(KeepAll):
        def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
            if frame.index == 3:
                raise FrameError("frame 3: no points")
            return clusters

    result = pipeline(refiner=Refuses()).run(room)
    assert (result.frames, result.frames_skipped, len(mapped(result).vertices)) == (6, 1, 5)


@dataclass
class _InvalidPixels(KeepAll):
    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return replace(clusters, pixels=clusters.pixels - 99)


def test_pipeline_refined_pixels_outside_image_raise(room: CornerRoom) -> None:
    with pytest.raises(
        DataError, match=r"clusters: expected pixels in the image of .*x.*, got u in \[.*, .*\], v in \[.*, .*\]"
    ):
        pipeline(refiner=_InvalidPixels()).run(room)


def test_pipeline_exact_masks_are_not_refined(room: CornerRoom) -> None:
    @dataclass
    class Exact(SphereDetector):
        def detect(self, frame: Frame) -> Detections:
            return replace(super().detect(frame), exact=True)

    assert pipeline(detector=Exact(), refiner=_InvalidPixels()).run(room).frames_skipped == 0


@pytest.mark.parametrize(
    ("stage", "verb", "output"),
    [
        ("detector", "detect", "expected Detections from the detector"),
        ("tracker", "track", "expected a Pose from the tracker"),
        ("refiner", "refine", "expected PointClusters from the refiner"),
    ],
)
def test_pipeline_stage_returning_none_raises(
    room: CornerRoom, monkeypatch: pytest.MonkeyPatch, stage: str, verb: str, output: str
) -> None:
    stages = pipeline(prefetch=0)
    monkeypatch.setattr(getattr(stages, stage), verb, lambda *_: None)
    with pytest.raises(DataError, match=f"frame 0: {output}, got NoneType"):
        stages.run(room)


def test_pipeline_limits_log_of_skipped_frames(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("WARNING")

    @dataclass
    class MostlyBroken(CornerRoom):
        def __getitem__(self, k: int) -> Frame:
            if k:
                raise FrameError(f"frame {k}: broken")
            return super().__getitem__(k)

    result = pipeline().run(MostlyBroken(frames=40))
    assert result.frames_skipped == 39
    assert len(caplog.records) == 12
    assert caplog.records[-1].message == "39 frames skipped in total"


def test_pipeline_without_usable_frame_raises() -> None:
    with pytest.raises(DataError, match="expected usable frames, got none among 1"):
        pipeline().run(CornerRoom(frames=1, unreadable=0))
    with pytest.raises(DataError, match="expected at least 1 frame, got 0"):
        pipeline().run(CornerRoom(start=6))


def test_pipeline_counts_lost_frames_without_fusion(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("WARNING")
    result = pipeline(tracker=GivenPose(lost_from=2, lost_to=5)).run(room)
    assert (result.frames, result.frames_lost, len(mapped(result).vertices)) == (6, 3, 3)
    assert [frame.pose.lost for frame in result.tracked] == [False, False, True, True, True, False]
    assert [record.message for record in caplog.records] == [
        "frame 2: lost: too few points associate",
        "frame 5: tracked again after 3 lost frames",
    ]
    assert {time.frame for time in result.timings if time.stage == "fusion"} == {0, 1, 5}


def test_pipeline_empty_map_raises_with_frame_summary() -> None:
    fuser = assemble(BayesianTsdf, min_depth=50.0, max_depth=60.0)
    with pytest.raises(DataError) as caught:
        pipeline(tracker=GivenPose(lost_from=0, lost_to=3), fuser=fuser).run(CornerRoom(unreadable=5))
    assert str(caught.value) == (
        "corner_room: expected mapped frames, got none among 6: 1 unusable; 3 lost (first reason: too few points "
        "associate); 2 without depth within 50 to 60 m"
    )


@PREFETCH
def test_pipeline_error_leaves_no_threads(prefetch: int) -> None:
    before = working_threads()
    with pytest.raises(DataError, match="expected a ground-truth pose"):
        pipeline(prefetch, detector=_Blind()).run(CornerRoom(truth=False))
    with pytest.raises(DataError, match="expected ground-truth instances"):  # raised in the worker
        pipeline(prefetch).run(CornerRoom(truth=False))
    assert working_threads() == before


@dataclass
class _Blind(SphereDetector):
    def detect(self, frame: Frame) -> Detections:
        return Detections.none(frame.camera.shape, self.classes)


def test_pipeline_without_detections_maps_no_instances(room: CornerRoom) -> None:
    assert not mapped(pipeline(detector=_Blind()).run(room)).instances()


def test_pipeline_overlapping_masks_are_separate_instances(room: CornerRoom) -> None:
    @dataclass
    class Doubled(SphereDetector):
        def detect(self, frame: Frame) -> Detections:
            once = super().detect(frame)
            parts = (once.masks, once.boxes, once.scores, once.class_probabilities)
            return Detections(*(np.concatenate([part, part]) for part in parts), classes=once.classes)

    assert set(mapped(pipeline(detector=Doubled()).run(room)).instances()) == {3, 4}


def test_pipeline_full_map_returns_partial_result(room: CornerRoom) -> None:
    result = pipeline(fuser=GridFuser(capacity=4)).run(room)
    assert isinstance(result.stopped_by, MapFullError)
    assert (result.frames, len(mapped(result).vertices)) == (5, 4)


class _CoversImage(SphereDetector):
    """Detector of 100 objects, each with a mask of the whole image."""

    def detect(self, frame: Frame) -> Detections:
        return Detections(
            np.ones((100, *frame.depth.shape), np.bool_),
            np.zeros((100, 4), np.float32),
            np.linspace(0, 1, 100, dtype=np.float32),
            np.tile(np.eye(len(self.classes), dtype=np.float32)[0], (100, 1)),
            self.classes,
        )


class _NotesCounts(KeepAll):
    noted: tuple[list[int], ...] = ()

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        self.noted += (np.bincount(clusters.cluster, minlength=len(clusters)).tolist(),)
        return clusters


def test_pipeline_limits_points_of_frame(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    refiner, readings = _NotesCounts(), [np.count_nonzero(frame.depth) for frame in room]
    result = pipeline(detector=_CoversImage(), refiner=refiner).run(room)
    fitting = [MAX_COVERAGE * CAMERA.width * CAMERA.height // count for count in readings]
    assert refiner.noted == tuple([0] * (100 - n) + [count] * n for n, count in zip(fitting, readings, strict=True))
    assert result.masks_omitted == run_metrics(result)["masks_omitted"] == sum(100 - n for n in fitting)
    logged = [record.getMessage() for record in caplog.records if "masks" in record.getMessage()]
    assert len(logged) == 2
    assert logged[0].startswith("frame 0: masks: expected at most 8 points per pixel, got more in 100 masks; ")
    assert logged[1].startswith(f"{result.masks_omitted} masks omitted in total")
    assert "masks_omitted" not in run_metrics(pipeline().run(room))


@dataclass
class _Fails(GridFuser):
    at: int = 3

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        if frame.index == self.at:
            raise MemoryError("Unable to allocate 40 GiB")
        super().fuse(frame, pose, clusters, timer)


def test_run_to_any_end_returns_partial_result_after_error(room: CornerRoom) -> None:
    with pytest.raises(MemoryError, match="40 GiB"):
        pipeline(fuser=_Fails()).run(room)
    result = pipeline(fuser=_Fails()).run_to_any_end(room)
    assert isinstance(result.stopped_by, MemoryError)
    assert (result.frames, len(result.tracked), len(mapped(result).vertices)) == (4, 4, 3)


@dataclass
class FailsOnceOnKeyframes(GivenPose):
    """Tracker whose keyframes raise an error when they are read for the first time, after the last frame."""

    asked: int = 0

    def keyframes(self) -> Mapping[str, Array]:
        self.asked += 1
        if self.asked == 1:
            raise MemoryError("no memory for features")
        return {}


class FailsOnKeyframes(GivenPose):
    def keyframes(self) -> Mapping[str, Array]:
        raise MemoryError("no memory for features")


def test_run_to_any_end_keeps_map_after_keyframes_error(room: CornerRoom) -> None:
    result = pipeline(tracker=FailsOnceOnKeyframes()).run_to_any_end(room)
    assert isinstance(result.stopped_by, MemoryError)
    assert (result.frames, len(result.tracked)) == (6, 6)
    assert len(mapped(result).vertices) > 0
    result = pipeline(tracker=FailsOnKeyframes()).run_to_any_end(room)
    assert isinstance(result.stopped_by, MemoryError)
    assert (result.keyframes, len(result.tracked)) == ({}, 6)
    result = pipeline(tracker=FailsOnceOnKeyframes(), fuser=_Fails()).run_to_any_end(room)
    assert "40 GiB" in str(result.stopped_by), "expected the first error"


@PREFETCH
def test_run_to_any_end_with_empty_map_raises(room: CornerRoom, prefetch: int) -> None:
    for stages in (
        {"detector": FaultyDetector(at=0)},
        {"tracker": GivenPose(lost_to=3), "detector": FaultyDetector(at=3)},
    ):
        with pytest.raises(OSError, match="Input/output error"):
            pipeline(prefetch, **stages).run_to_any_end(room)


@dataclass
class PressesCtrlC(GivenPose):
    times: int = 1
    at: int = 3
    noted: list[int] = field(default_factory=list)

    def track(self, frame: Frame, scene: object) -> Pose:
        self.noted.append(frame.index)
        if frame.index == self.at:
            for _ in range(self.times):
                os.kill(os.getpid(), signal.SIGINT)
        return super().track(frame, scene)  # type: ignore[arg-type]


def working_threads() -> int:
    """Return the number of threads. The monitor thread that tqdm starts once per process is not counted."""
    return sum(not isinstance(thread, TMonitor) for thread in threading.enumerate())


@PREFETCH
def test_pipeline_ctrl_c_ends_after_current_frame(room: CornerRoom, prefetch: int) -> None:
    handler, threads = signal.getsignal(signal.SIGINT), working_threads()
    result = pipeline(prefetch, tracker=PressesCtrlC()).run(room)
    assert isinstance(result.stopped_by, KeyboardInterrupt)
    assert (result.frames, len(mapped(result).vertices)) == (4, 4)
    assert signal.getsignal(signal.SIGINT) is handler
    assert working_threads() == threads


def test_pipeline_second_ctrl_c_ends_immediately(room: CornerRoom) -> None:
    result = pipeline(tracker=PressesCtrlC(times=2)).run(room)
    assert isinstance(result.stopped_by, KeyboardInterrupt)
    assert len(mapped(result).vertices) == 3


def test_pipeline_runs_outside_main_thread(room: CornerRoom) -> None:
    results: list[RunResult] = []
    thread = threading.Thread(target=lambda: results.append(pipeline().run(room)))
    thread.start()
    thread.join()
    assert results[0].frames == 6


@dataclass
class _InPairs(SphereDetector):
    """Detector that needs two concurrent calls. The total number of calls must be even."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._pair = threading.Barrier(2)

    def detect(self, frame: Frame) -> Detections:
        self._pair.wait(PATIENCE_S)
        return super().detect(frame)


@dataclass
class _OneReader(CornerRoom):
    """Dataset that checks that frames are read one at a time and in order."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.slow_s, self._next, self._reading = 0.005, 0, threading.Lock()

    def __getitem__(self, k: int) -> Frame:
        assert self._reading.acquire(blocking=False), "expected one read at a time"
        assert k == self._next, "expected reads in order"
        self._next += 1
        try:
            return super().__getitem__(k)
        finally:
            self._reading.release()


def pretend_cores(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the core count that Numba reports, without changing its threads."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: count)
    monkeypatch.setattr(numba, "set_num_threads", lambda number: None)


@pytest.mark.parametrize("prefetch", [2, 3])
def test_concurrent_detector_receives_two_frames_in_order(prefetch: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_cores(2, monkeypatch)
    threads = working_threads()
    result = pipeline(prefetch, detector=_InPairs()).run(_OneReader())
    assert [frame.index for frame in result.tracked] == list(range(6))
    np.testing.assert_array_equal(mapped(result).mesh().vertices, mapped(pipeline().run(CornerRoom())).mesh().vertices)
    result = pipeline(prefetch, detector=_InPairs()).run(_OneReader(frames=7, unreadable=3))
    assert [frame.index for frame in result.tracked] == [0, 1, 2, 4, 5, 6]
    assert working_threads() == threads


def test_concurrent_detector_is_serial_on_one_core(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @dataclass
    class Alone(SphereDetector):
        def detect(self, frame: Frame) -> Detections:
            found.append([thread.name for thread in threading.enumerate() if thread.name.startswith("prefetch")])
            return super().detect(frame)

    found: list[list[str]] = []
    for cores, prefetch in ((1, 2), (2, 1), (2, 0)):
        pretend_cores(cores, monkeypatch)
        pipeline(prefetch, detector=Alone()).run(CornerRoom())
        assert max(map(len, found)) == min(prefetch, 1)
        found.clear()


def test_pipeline_parameter_out_of_range_raises() -> None:
    with pytest.raises(ConfigError, match="prefetch"):
        pipeline(prefetch=-1)
    with pytest.raises(ConfigError, match="detection_interval"):
        pipeline(detection_interval=0)


def test_pipeline_prints_no_output_without_terminal(room: CornerRoom, capfd: pytest.CaptureFixture[str]) -> None:
    logging.getLogger("framework").setLevel(logging.INFO)
    pipeline().run(room)
    assert capfd.readouterr() == ("", "")


def test_pipeline_runs_without_stderr(room: CornerRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", None)  # like under pythonw
    assert pipeline().run(room).frames == len(room)


@dataclass
class Listener(Viewer):
    """Viewer that records its calls."""

    calls: list[str] = field(default_factory=list)
    stages: list[set[str]] = field(default_factory=list)

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self.calls.append(f"begin {video} in {directory.name}")

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        self.calls.append(f"{'lost' if pose.lost else 'mapped'} {frame.index} with {len(detections)}")
        self.stages.append(set(stage_ms))

    def skip(self, reason: str) -> None:
        self.calls.append(f"skipped {reason}")

    def end(self) -> None:
        self.calls.append("end")

    def end_run(self, metrics: Mapping[str, object], error: str) -> None:
        self.calls.append(f"end_run {error.partition(':')[0]}")


@PREFETCH
def test_viewer_receives_all_frames_in_order(prefetch: int, tmp_path: Path) -> None:
    @dataclass
    class GetsLost(GivenPose):
        def track(self, frame: Frame, scene: SceneMap) -> Pose:
            return replace(super().track(frame, scene), lost=frame.index == 3)

    listener = Listener()
    pipeline(prefetch, tracker=GetsLost(), viewer=listener).run_to_any_end(CornerRoom(unreadable=1), tmp_path)
    skipped = "skipped frame 1: depth/000001.png is truncated"
    assert listener.calls == [
        f"begin corner_room in {tmp_path.name}",
        *("mapped 0 with 2", skipped, "mapped 2 with 2", "lost 3 with 2", "mapped 4 with 2", "mapped 5 with 2"),
        "end",
    ]
    every = {"reading", "detection", "tracking", "lifting", "refinement", "fusion", "backend"}
    assert listener.stages == [every, every, {"reading", "detection", "tracking"}, every, every]


@pytest.mark.parametrize("stages", [{"fuser": GridFuser(capacity=2)}, {"detector": SphereDetector(broken_at=0)}])
def test_viewer_end_is_called_once_for_any_end(room: CornerRoom, stages: dict[str, object]) -> None:
    listener = Listener()
    pipeline(viewer=listener, **stages).run_to_any_end(room)
    assert listener.calls[-1] == "end"
    assert listener.calls.count("end") == 1


@PREFETCH
@pytest.mark.parametrize("verb", ["show", "skip", "end"])
def test_viewer_failure_does_not_affect_run(
    verb: str, prefetch: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        calls.append(verb)
        raise RuntimeError("no screen\nany more")

    calls: list[str] = []
    listener = Listener()
    monkeypatch.setattr(listener, verb, fails)
    result = pipeline(prefetch, viewer=listener).run_to_any_end(CornerRoom(unreadable=1))
    assert (result.frames, result.frames_skipped, result.stopped_by) == (6, 1, None)
    logged = [record.message for record in caplog.records if "viewer" in record.message]
    assert logged == ["viewer: disabled after an error; the run continues: no screen any more"]
    assert calls == [verb], "expected no second call"
    assert verb == "end" or listener.calls[-1] == "end"


def test_viewer_end_is_called_after_unusable_sequence() -> None:
    listener = Listener()
    with pytest.raises(DataError):
        pipeline(viewer=listener).run(CornerRoom(frames=1, unreadable=0))
    assert listener.calls[-2:] == ["end", "end_run corner_room"]


def test_viewer_end_run_receives_reason_for_early_end(room: CornerRoom) -> None:
    for fuser, reason in ((GridFuser(), ""), (GridFuser(capacity=2), "fuser.capacity")):
        listener = Listener()
        pipeline(viewer=listener, fuser=fuser).run(room)
        assert listener.calls[-2:] == ["end", f"end_run {reason}"]
