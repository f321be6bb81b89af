"""Journal of a run: timings, poses, errors and progress."""

from __future__ import annotations

import logging
import math
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import numpy as np
from tqdm.contrib.logging import logging_redirect_tqdm

from framework.data import MAX_COVERAGE, Array, DelayEstimate, Frame, PointClusters, Pose
from framework.errors import DataError, FrameError, NoPoseError
from framework.interfaces import FusionStage, PoseTracker, SceneMap, StageTimer, SubmapChange, SubmapGraph
from framework.runtime.corrected_frames import CorrectedFrames, TrackedFrame
from framework.runtime.digests import StageDigest, digest_of
from framework.runtime.frame_stream import steady_time
from framework.runtime.progress import Progress
from framework.runtime.spooled_list import Item, Spool, SpooledList
from framework.sensors.depth_distortion import DepthDistortion
from framework.sensors.noise_models import SensorKind

log = logging.getLogger(__name__)

MAX_APART = 3  # frames in a row without overlap with the map, for a warning
SKIPS_LOGGED = 10  # maximum number of logged unusable frames, so that a broken disk does not flood the log
FUSION_STAGES: tuple[str, ...] = get_args(FusionStage)
STAGES = ("reading", "detection", "tracking", "lifting", "refinement", *FUSION_STAGES, "backend")
FUSION = "fusion"  # total time of FUSION_STAGES, if the fuser does not time them separately
STAGE_ORDER = (*STAGES[:-1], FUSION, STAGES[-1])  # all stages of a frame, in the order of the pipeline
COUNT_INTERVAL_S = 1.0  # s, update interval of the number of instances in the progress bar


@dataclass(frozen=True)
class StageTime:
    """The run time of one stage for one frame."""

    frame: int  # Frame.index
    stage: str  # one of STAGES, or FUSION
    milliseconds: float


@dataclass(frozen=True)
class LiveFigures:
    """Statistics of a live video."""

    frames_dropped: int  # number of usable frames that were not mapped: a newer frame replaced them, or the run ended
    latencies: tuple[float, ...]  # s, from capture to map, of each fused frame


@dataclass(frozen=True)
class RunResult:
    """The result of a run. The data of the frames are in a temporary file if there are many."""

    scene: SceneMap
    frames: int  # number of mapped, lost and skipped frames
    frames_skipped: int  # number of frames that are unreadable, inconsistent or without a required pose
    tracked: Sequence[TrackedFrame]  # including lost frames; poses corrected by the back end
    timings: Sequence[StageTime]
    seconds: float  # wall-clock time of the whole loop
    stopped_by: BaseException | None = None  # reason for an early end; None = completed
    intervals: tuple[float, ...] = ()  # wall-clock time between frames, s
    pose_source: str = PoseTracker.pose_source
    live: LiveFigures | None = None  # None = a recording
    keyframes: Mapping[str, Array] = field(default_factory=dict)  # of the tracker
    color_delay: DelayEstimate | None = None  # None = given, not estimated
    digests: Sequence[StageDigest] = ()  # of each stage and frame
    disagreeing: tuple[int, ...] | None = None  # Frame.index of the frames that contradict the map; None = not compared
    masks_omitted: int = 0  # number of masks that exceeded the limit of points of a frame
    as_tracked: Sequence[TrackedFrame] | None = None  # poses before any correction; None = no back end
    graph: SubmapGraph | None = None  # pose graph of the back end; None = none
    depth_distortion: DepthDistortion | None = None  # correction of depth; None = none

    @property
    def frames_lost(self) -> int:
        """Number of frames without an estimated pose. These frames are not fused."""
        return sum(frame.pose.lost for frame in self.tracked)

    @property
    def fps(self) -> float:
        """Frames per second of wall-clock time, including reading and detection."""
        return self.frames / self.seconds

    @property
    def fps_median(self) -> float:
        """Frames per second of the median frame, which excludes outliers such as kernel compilation."""
        return 1 / float(np.median(self.intervals)) if self.intervals else self.fps


@dataclass
class Journal:
    """Journal and progress display of a run.

    The data of the frames are in a temporary file, except for those of the last frames.
    """

    scene: SceneMap
    frames_expected: int | None  # None = a live video
    pose_source: str
    folder: Path | None = None  # folder of the temporary file, which has no name; None = the folder for temporary files
    frames: int = 0
    frames_skipped: int = 0
    without_pose: int = 0  # skipped frames without a pose
    first_without_pose: str = ""  # message of the first frame without a pose
    frames_in_map: int = 0  # number of frames that are at least partly fused
    frames_masked: int = 0  # number of frames with masked objects
    stopped_by: BaseException | None = None
    last_index: int = -1  # Frame.index of the last tracked frame; -1 = none
    unordered: bool = False  # True once a timestamp did not increase
    last_time: float = -math.inf  # s, latest timestamp of the tracked frames
    lost_for: int = 0  # number of consecutive lost frames
    frames_dropped: int = 0
    masks_omitted: int = 0  # number of masks that exceeded the limit of points of a frame
    sensor: SensorKind | None = None  # of the last frame
    compared: int = 0  # number of frames whose depth is compared with the map at a given pose
    apart: int = 0  # number of compared frames in a row that see nothing of the map

    def __post_init__(self) -> None:
        spool = Spool(self.folder)
        self.tracked = CorrectedFrames(spool)
        self.timings: SpooledList[StageTime] = SpooledList(spool)
        self.digests: SpooledList[StageDigest] = SpooledList(spool)
        self.frames_began: SpooledList[float] = SpooledList(spool)  # start of each frame, s
        self.latencies: SpooledList[float] = SpooledList(spool)  # s
        self.disagreeing: SpooledList[int] = SpooledList(spool)  # Frame.index of those that contradict the map
        self._stage_ms: dict[str, float] = {}  # stage times of the last timed frame, ms
        self._timed = -1  # Frame.index of the last timed frame

    def __enter__(self) -> Journal:
        self._screen = ExitStack()
        self._bar = self._screen.enter_context(Progress(self.frames_expected, " frames"))
        if not self._bar.disable:
            self._screen.enter_context(logging_redirect_tqdm())
        self._counted_at = self._started = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self._started
        self._screen.close()
        if 0 < self.without_pose < self.frames:
            counts = (self.without_pose, self.frames, self.first_without_pose)
            log.warning("%d of %d frames skipped because they have no pose; the first: %s", *counts)
        if self._errors > SKIPS_LOGGED:
            log.warning("%d frames skipped in total", self.frames_skipped)
        if self.disagreeing:
            log.warning(
                "%d of %d frames disagree with the map at their given poses: frames %s; run `instancemap check`, or "
                "estimate the poses with tracker=voxel_hashing_icp",
                len(self.disagreeing), self.frames, frame_ranges(self._read(self.disagreeing)),
            )  # fmt: skip
        if self.masks_omitted:
            log.warning("%d masks omitted in total because their frames had too many points", self.masks_omitted)
        if self.frames_masked:
            log.info("%d of %d frames with masked objects", self.frames_masked, self.frames)
        if self.frames_dropped:
            log.warning("%d frames dropped because newer frames replaced them or the run ended", self.frames_dropped)

    @contextmanager
    def timed(self, frame: int, stage: str) -> Iterator[None]:
        """Record the run time of the `with` body as the time of a stage, unless the body raises."""
        started = time.perf_counter()
        yield
        self.record([StageTime(frame, stage, 1e3 * (time.perf_counter() - started))])

    @contextmanager
    def fusing(self, frame: int) -> Iterator[StageTimer]:
        """Record the stage times that the fuser measures with the yielded timer.

        Without measured times, the run time of the `with` body is recorded as FUSION. Nothing is recorded if the body
        raises.
        """
        seconds: defaultdict[str, float] = defaultdict(float)

        @contextmanager
        def timer(stage: FusionStage) -> Iterator[None]:
            started = time.perf_counter()
            yield
            seconds[stage] += time.perf_counter() - started

        started = time.perf_counter()
        yield timer
        of_stages = seconds or {FUSION: time.perf_counter() - started}
        self.record(StageTime(frame, stage, 1e3 * spent) for stage, spent in of_stages.items())

    def count_omitted(self, frame: Frame, clusters: PointClusters) -> None:
        """Count the masks of a frame that exceed the limit of points, and log those of the first such frame."""
        if clusters.omitted and not self.masks_omitted:
            log.warning(
                "frame %d: masks: expected at most %d points per pixel, got more in %d masks; %d masks with low scores "
                "are omitted; reduce detector.max_detections",
                frame.index, MAX_COVERAGE, len(clusters), clusters.omitted,
            )  # fmt: skip
        self.masks_omitted += clusters.omitted

    def record(self, times: Iterable[StageTime]) -> None:
        """Record the run times of stages."""
        for one in times:
            if one.frame != self._timed:
                self._timed, self._stage_ms = one.frame, {}
            self._stage_ms[one.stage] = one.milliseconds
            self.timings.append(one)

    def digest(self, frame: int, **results: object) -> None:
        """Record the digests of stage results for the frame with index `frame`."""
        self.digests.extend(StageDigest(frame, stage, digest_of(result)) for stage, result in results.items())

    def stage_ms(self, frame: int) -> dict[str, float]:
        """Return the stage times of the last frame, ms, given its index."""
        return dict(self._stage_ms) if frame == self._timed else {}

    def forget_frames(self) -> None:
        """Discard the data of the frames, which only the outputs of a run need."""
        for rows in (self.tracked, self.timings, self.digests, self.latencies):
            rows.clear()

    def frame_begins(self) -> None:
        """Count a frame of the sequence."""
        self.frames += 1
        self._bar.update()
        now = time.perf_counter()
        self.frames_began.append(now)
        if not self._bar.disable and now - self._counted_at > COUNT_INTERVAL_S:
            counts = {"instances": len(self.scene.instance_ids())}
            if self.frames_expected is None:
                counts["dropped"] = self.frames_dropped
            self._bar.set_postfix(counts, refresh=False)
            self._counted_at = time.perf_counter()
        if self._bar.line_is_due():
            of_all = "" if self.frames_expected is None else f" of {self.frames_expected}"
            log.info("frame %d%s, %d instances", self.frames, of_all, len(self.scene.instance_ids()))

    def frame_skipped(self, error: FrameError) -> None:
        """Count an unusable frame."""
        self.frames_skipped += 1
        if isinstance(error, NoPoseError):
            self.without_pose += 1
            self.first_without_pose = self.first_without_pose or str(error)
            return
        if self._errors <= SKIPS_LOGGED:
            log.warning("frame skipped: %s", error)
        if self._errors == SKIPS_LOGGED:
            log.warning("further skipped frames are counted but not logged")

    @property
    def _errors(self) -> int:
        """Number of skipped frames that have a pose."""
        return self.frames_skipped - self.without_pose

    def check_order(self, frame: Frame) -> None:
        """Raise DataError unless the index of a frame exceeds those of the tracked frames.

        Observations of an instance are counted by index, so an instance in frames of one index is never confirmed.
        """
        if frame.index <= self.last_index:
            raise DataError(
                f"frame {frame.index}: index: expected at least {self.last_index + 1} after frame {self.last_index}, "
                f"got {frame.index}; number the frames in their order, and map another recording with resume_from"
            )

    def frame_tracked(self, frame: Frame, pose: Pose, is_masked: bool = False) -> None:
        """Record a pose and whether the frame is masked. Log a change of the depth sensor, and loss and recovery."""
        self.last_index = int(frame.index)
        self.frames_masked += is_masked
        if frame.timestamp <= self.last_time and not self.unordered:
            self.unordered = True
            log.warning(
                "frame %d: expected a timestamp after %.6f s, got %.6f s; the color delay is estimated only from "
                "frames in temporal order",
                frame.index, self.last_time, frame.timestamp,
            )  # fmt: skip
        self.last_time = max(self.last_time, float(frame.timestamp))
        if frame.sensor is not self.sensor:
            self.sensor = frame.sensor
            log.info("depth sensor: %s", frame.sensor)
        self.digest(frame.index, tracking=pose)
        # without the attributes of a subclass, which may not be picklable
        plain = Pose(pose.T_world_camera, pose.lost, pose.reason, pose.covariance)
        self.tracked.append(TrackedFrame(frame.index, self.frames - 1, frame.timestamp, plain, frame.T_world_camera))
        if pose.lost:
            if not self.lost_for:
                log.warning("frame %d: lost: %s", frame.index, pose.reason or "no reason given by the tracker")
            self.lost_for += 1
        elif self.lost_for:
            log.warning("frame %d: tracked again after %d lost frames", frame.index, self.lost_for)
            self.lost_for = 0

    def frame_compared(self, frame: Frame, is_apart: bool, disagrees: bool, fraction: float) -> None:
        """Record the comparison of a frame with the map. Log the first frames that disagree or see nothing of the map.

        Frames of a video overlap with the frames before. Several frames without overlap have poses in another unit or
        convention.

        Args:
            frame: The frame.
            is_apart: True if hardly any depth of the frame is on the map.
            disagrees: True if the given pose contradicts the map.
            fraction: Fraction of the pixels whose depth differs from the map.
        """
        self.compared += 1
        self.apart = self.apart + 1 if is_apart else 0
        if self.apart == MAX_APART and not self.disagreeing:
            text = (
                "frames up to %d: depth is nowhere on the map of the frames before at %d given poses; expected "
                "T_world_camera in m, with x right, y down, z forward"
            )
            log.warning(text, frame.index, MAX_APART)
        if not disagrees:
            return
        if not self.disagreeing:
            text = "frame %d: depth differs from the map at %.0f%% of the pixels; its given pose may be wrong"
            log.warning(text, frame.index, 100 * fraction)
        self.disagreeing.append(frame.index)

    def frame_fused(self, frame: Frame) -> None:
        """Record the latency of a frame if the video is live."""
        if self.frames_expected is None:
            self.latencies.append(steady_time() - frame.timestamp)

    def corrected(self, change: SubmapChange, merged: Mapping[int, int]) -> None:
        """Correct the poses of the tracked frames, and log the motion of submaps and the merged instances.

        Args:
            change: The change of the map after the last tracked frame.
            merged: The remaining instance by merged instance.
        """
        motion_m = self.tracked.correct(change)
        if change.motions:
            log.info(
                "frame %d: submaps moved: %d, by at most %.0f mm", self.last_index, len(change.motions), 1e3 * motion_m
            )
        if merged:
            pairs = ", ".join(f"{one} into {remaining}" for one, remaining in sorted(merged.items()))
            log.info("frame %d: instances merged: %s", self.last_index, pairs)
        self.digest(self.last_index, backend=self.scene)

    def result(self) -> RunResult:
        """Return the result after the loop."""
        intervals = np.diff(self._read(self.frames_began)).tolist()
        disagreeing, latencies = self._read(self.disagreeing), self._read(self.latencies)
        return RunResult(
            scene=self.scene,
            frames=self.frames,
            frames_skipped=self.frames_skipped,
            tracked=self.tracked,
            timings=self.timings,
            digests=self.digests,
            seconds=self.seconds,
            stopped_by=self.stopped_by,
            intervals=tuple(intervals),
            pose_source=self.pose_source,
            disagreeing=disagreeing if self.compared else None,
            masks_omitted=self.masks_omitted,
            live=LiveFigures(self.frames_dropped, latencies) if self.frames_expected is None else None,
        )

    def _read(self, items: SpooledList[Item]) -> tuple[Item, ...]:
        """Return the items of a list, or () after an error of the disk, which is stored in `stopped_by`."""
        try:
            return tuple(items)
        except (OSError, EOFError) as error:
            self.stopped_by = self.stopped_by or error
            return ()


def frame_ranges(indices: Sequence[int]) -> str:
    """Return increasing frame numbers as text, such as "3, 7 to 9"."""
    parts: list[list[int]] = []
    for index in indices:
        if parts and index == parts[-1][1] + 1:
            parts[-1][1] = index
        else:
            parts.append([index, index])
    return ", ".join(f"{first}" if first == last else f"{first} to {last}" for first, last in parts)
