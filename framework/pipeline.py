"""The mapping loop: detection, masking, tracking, lifting, refinement, fusion and correction."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import cast

from framework.checking.changed_sequences import FirstFrames
from framework.data import Array, Detections, Float64, Frame, Int32, Pose, check_label_space
from framework.detection.domain import warn_outside_domain
from framework.errors import ConfigError, DataError, FrameError, MapFullError, in_one_line
from framework.files.storage import check_storage
from framework.interfaces import (
    BackEnd,
    ClusterRefiner,
    Detector,
    FrameMasking,
    LiveVideo,
    MapFuser,
    PoseTracker,
    RGBDSequence,
    RGBDVideo,
    SceneMap,
    SubmapChange,
    SubmapGraph,
    Viewer,
)
from framework.live_view.guarded_viewer import GuardedViewer, watched_run
from framework.pose_graph.calibration_stages import CalibratingBackEnd, DepthOnly, NoObjects
from framework.refinement.lifting import lift
from framework.refinement.refine import refine
from framework.registry import rebuilt
from framework.runtime.cpu_budget import CpuBudget, parallel_kernels_are_thread_safe
from framework.runtime.forked_process import check_not_forked
from framework.runtime.frame_stream import FrameStream, Turns, prefetched_map, stream_of
from framework.runtime.run_log import Journal, RunResult, StageTime
from framework.runtime.signals import Interruption, signals_deferred
from framework.sensors.depth_distortion import DepthDistortion
from framework.tracking.color_to_depth import ColorToDepth
from framework.tracking.map_agreement import check_distance, check_resumed, map_agreement

log = logging.getLogger(__name__)

WITHOUT_POSES = "add the poses of the sequence, or estimate them with tracker=voxel_hashing_icp"
WITHOUT_THREADS = (
    "numba's threading layer is not thread-safe; detection runs in the calling thread; for parallel detection, call "
    "instancemap.configure_process() before numba is imported"
)


@dataclass
class Pipeline:
    """The stages and the mapping loop.

    Example: `Pipeline(detector, tracker, refiner, fuser).run(video)`.

    Raises:
        ConfigError: A parameter is out of range.
        DataError: The detector has too many classes, or a class name is too long.
    """

    detector: Detector
    tracker: PoseTracker
    refiner: ClusterRefiner
    fuser: MapFuser
    prefetch: int = 2  # number of frames prefetched by other threads, >= 0 (live video: at most 1); 0 = none
    viewer: Viewer = field(default_factory=Viewer)
    detection_interval: int = 1  # interval between detections, in frames, >= 1; all frames are tracked and mapped
    masking: FrameMasking = field(default_factory=FrameMasking)
    backend: BackEnd = field(default_factory=BackEnd)

    def __post_init__(self) -> None:
        if self.detection_interval < 1:
            raise ConfigError(
                f"Pipeline.detection_interval: expected at least 1 frame, got {self.detection_interval}; set it to 1"
            )
        if self.prefetch < 0:
            raise ConfigError(f"Pipeline.prefetch: expected at least 0 frames, got {self.prefetch}; set it to 0")
        check_label_space(self.detector.classes)
        self.fuser.scene.calibrate(self.detector.calibration)
        self.viewer = GuardedViewer(self.viewer)
        self.backend = usable_back_end(self.backend, self.tracker, self.fuser)
        self.color_to_depth = ColorToDepth(delay=None)
        self.depth_distortion: DepthDistortion | None = None  # of the sensor; None = depth is not corrected
        self.resumed = False  # True until a frame is compared with the map of `resume_from`
        self.T_world_color: Float64 | None = None  # (4, 4) pose of the color camera in the last tracked frame

    def run(self, video: RGBDVideo) -> RunResult:
        """Map a sequence or live video, frame by frame.

        Frames that raise FrameError are skipped, and lost frames are not fused. Both are counted. Ctrl-C ends the loop
        after the current frame. A full map also ends the loop early. Other errors of stages are raised.

        Ctrl-C is the normal end of a live video. If mapping falls behind, frames of a live video are dropped and
        counted.

        Args:
            video: The sequence or live video.

        Returns:
            The map and the statistics of the run. `stopped_by` is the reason for an early end; None = normal end.

        Raises:
            DataError: No frame was mapped.
        """
        with watched_run(self.viewer, Path(), {}) as outcome:
            result = self.run_to_any_end(video)
            if result.stopped_by is None:
                return result
            outcome.error = in_one_line(result.stopped_by)
            if isinstance(result.stopped_by, KeyboardInterrupt | MapFullError):
                return result
            raise result.stopped_by

    def run_to_any_end(self, video: RGBDVideo, directory: Path | None = None) -> RunResult:
        """Map a sequence or live video. After the first mapped frame, errors are returned in `stopped_by`.

        Args:
            video: The sequence or live video.
            directory: Output folder of the viewer, and folder of an unnamed temporary file with the data of the frames;
                None = the working directory, and the folder for temporary files.
        """
        check_not_forked()
        if not isinstance(cast(object, video), RGBDVideo):
            raise DataError(f"dataset: expected an RGBDSequence or a LiveVideo, got {type(video).__name__}")
        frames_expected = len(video) if isinstance(video, RGBDSequence) else None
        if frames_expected == 0:
            raise DataError(f"{video.name}: expected at least 1 frame, got 0; change start, stop or stride")
        if self.tracker.pose_source == "ground_truth" and not video.has_poses():
            frames = "its frames" if frames_expected is None else f"the {frames_expected} frames"
            raise DataError(f"{video.name}: expected ground-truth poses, got none for {frames}; {WITHOUT_POSES}")
        warn_outside_domain(self.detector, video)
        if isinstance(video, RGBDSequence):
            self.detector.check_sequence(video)
            self.calibrate_depth(video)
        self.color_to_depth = ColorToDepth(video.constant_color_delay())
        journal = Journal(self.fuser.scene, frames_expected, self.tracker.pose_source, directory)
        with (
            watched(self.viewer, self.fuser.scene, video.name, directory or Path()),
            journal,
            signals_deferred(signal.SIGINT) as interruption,
        ):
            try:
                with interruption.second_ends_at_once("after this frame"):
                    self.map_all(video, journal, interruption)
            except BaseException as stop:
                journal.stopped_by = stop
            graph = self.finish(journal)
            keyframes = self.keyframes(journal)
        if journal.stopped_by is not None:
            if journal.frames_in_map == 0:
                raise journal.stopped_by
            if isinstance(video, LiveVideo) and journal.stopped_by is interruption.received:
                journal.stopped_by = None  # the normal end; a second signal raises another Interrupted
        elif journal.frames_in_map == 0 or self.fuser.scene.statistics.voxels == 0:
            raise DataError(f"{video.name}: {self.empty_map_reason(journal)}")
        return replace(
            journal.result(),
            keyframes=keyframes,
            color_delay=self.color_to_depth.estimate,
            as_tracked=journal.tracked.as_tracked if changes_map(self.backend) else None,
            graph=graph,
            depth_distortion=self.depth_distortion,
        )

    def calibrate_depth(self, video: RGBDSequence) -> None:
        """Calibrate depth with the first frames of a sequence, which are mapped without objects before the run.

        A known correction is used instead. A stored map without correction is resumed without correction.

        Raises:
            BaseException: A signal was received, or a stage raised an error.
        """
        calibrator = self.backend.calibrator
        if calibrator is None or self.depth_distortion is not None or self.fuser.scene.statistics.voxels:
            return
        count = calibrator.frames(len(video))
        if count == 0:
            return
        log.info("calibration of depth: mapping the first %d frames", count)
        trial = Pipeline(NoObjects(), rebuilt(self.tracker), self.refiner, rebuilt(self.fuser), self.prefetch)
        trial.backend = CalibratingBackEnd(calibrator)  # also if the map cannot be corrected
        try:
            stopped_by = trial.run_to_any_end(FirstFrames(video, count)).stopped_by
        except DataError:  # no frame was mapped; the run reports the reason
            return
        if stopped_by is not None and not isinstance(stopped_by, MapFullError):
            raise stopped_by
        self.depth_distortion = calibrator.distortion()

    def corrected(self, frame: Frame) -> Frame:
        """Return a frame with corrected depth."""
        if self.depth_distortion is None:
            return frame
        return replace(frame, depth=self.depth_distortion.corrected(frame.depth))

    def keyframes(self, journal: Journal) -> Mapping[str, Array]:
        """Return the keyframes of the tracker by array name.

        An error of the tracker thread is stored in `journal.stopped_by`.
        """
        try:
            return self.tracker.keyframes()
        except Exception as error:
            journal.stopped_by = journal.stopped_by or error
        try:
            return self.tracker.keyframes()
        except Exception:  # the map is saved without keyframes
            return {}

    def empty_map_reason(self, journal: Journal) -> str:
        """Return the reason for an empty map, for an error message."""
        result = journal.result()
        if result.frames == 0:
            return "expected at least one frame, got none"
        if journal.without_pose == result.frames:
            first = journal.first_without_pose
            return f"expected poses, got none for the {result.frames} frames (first: {first}); {WITHOUT_POSES}"
        if result.frames_skipped == result.frames:
            return f"expected usable frames, got none among {result.frames}; the log lists the reasons"
        lost = next((frame.pose.reason for frame in result.tracked if frame.pose.lost), "")
        nearest, farthest = self.fuser.scene.depth_range
        rest = result.frames - result.frames_skipped - result.frames_lost
        parts = [
            (result.frames_skipped, "unusable"),
            (result.frames_lost, f"lost (first reason: {lost or 'none given'})"),
            (rest, f"without depth within {nearest:g} to {farthest:g} m"),
        ]
        return f"expected mapped frames, got none among {result.frames}: " + "; ".join(
            f"{count} {what}" for count, what in parts if count
        )

    def map_all(self, video: RGBDVideo, journal: Journal, interruption: Interruption) -> None:
        """Map all frames of a video.

        Raises:
            Interrupted: A signal was received. It is raised between two frames.
        """
        prefetch = self.prefetch
        if prefetch > 0 and not parallel_kernels_are_thread_safe():
            log.info(WITHOUT_THREADS)
            prefetch = 0
        budget = CpuBudget(with_prefetch=prefetch > 0)
        with closing(self.detect_prefetched(video, journal, interruption, budget, prefetch)) as detected:
            for frame, detections in detected:
                with budget.mapping():
                    try:
                        self.map_frame(frame, detections, journal)
                    except FrameError as error:
                        self.skip(error, journal)
                interruption.check()

    def skip(self, error: FrameError, journal: Journal) -> None:
        journal.frame_skipped(error)
        self.viewer.skip(str(error))

    def detect_prefetched(
        self, video: RGBDVideo, journal: Journal, interruption: Interruption, budget: CpuBudget, prefetch: int
    ) -> Generator[tuple[Frame, Detections]]:
        """Yield the usable frames with their detections, in the order of the video.

        While the caller maps a frame, other threads process up to `prefetch` later frames. They run in parallel if the
        detector supports this. The results of a stored sequence do not depend on `prefetch`.
        """
        stream = stream_of(video, lambda: interruption.received is not None)
        prefetch = prefetch if stream.max_prefetched is None else min(prefetch, stream.max_prefetched)
        workers = max(1, min(prefetch, budget.cores)) if self.detector.concurrent else 1
        turns = Turns()

        def work(number: int) -> tuple[Frame, Detections, list[StageTime]] | FrameError | None:
            with budget.prefetching(workers):
                return self.read_and_detect(stream, turns.turn(number), number)

        try:
            # close the stream first: a worker may be waiting for a frame
            with closing(prefetched_map(work, count(), prefetch, workers)) as outcomes, stream:
                for outcome in outcomes:
                    interruption.check()  # after a possibly long wait
                    journal.frames_dropped = stream.dropped
                    if outcome is None:
                        return
                    journal.frame_begins()
                    if isinstance(outcome, FrameError):
                        self.skip(outcome, journal)
                        stream.reported(outcome)
                        continue
                    frame, detections, timings = outcome
                    journal.record(timings)
                    yield frame, detections
        finally:
            for error in stream.unreported():
                journal.frame_begins()
                self.skip(error, journal)
            journal.frames_dropped = stream.dropped_of(journal.frames)

    def read_and_detect(
        self, stream: FrameStream, turn: AbstractContextManager[None], number: int
    ) -> tuple[Frame, Detections, list[StageTime]] | FrameError | None:
        """Read a frame in its turn, and detect its objects.

        Args:
            stream: Frames of the video.
            turn: Context in which the frame is read.
            number: Frame number, starting at 0.

        Returns:
            The frame with its detections and stage times, or the error of the frame; None = end of the video.

        Raises:
            StorageError: The storage of the video is no longer available.
        """
        try:
            with turn:
                read_frame = stream.take()
                if read_frame is None or isinstance(read_frame, FrameError):
                    return read_frame
                began = time.perf_counter()
                frame = self.corrected(read_frame())
                reading = StageTime(frame.index, "reading", 1e3 * (time.perf_counter() - began))
            detections, times = self.detect(frame, number)
        except FrameError as error:
            check_storage(error)
            return error
        return frame, detections, [reading, *times]

    def detect(self, frame: Frame, number: int) -> tuple[Detections, list[StageTime]]:
        """Return the detections of a frame and the detection time.

        Both are empty for frames between two detections. `number` is the frame number, starting at 0.
        """
        if number % self.detection_interval:
            return Detections.none(frame.depth.shape, self.detector.classes, detected=False), []
        began = time.perf_counter()
        detections = self.detector.detect(frame)
        return detections, [StageTime(frame.index, "detection", 1e3 * (time.perf_counter() - began))]

    def map_frame(self, frame: Frame, detections: Detections, journal: Journal) -> Pose:
        """Mask and track a frame, lift, refine and fuse its detections, correct the map, and show the frame.

        A lost frame is only masked, tracked and shown.

        Returns:
            The corrected pose.

        Raises:
            FrameError: The frame is unusable.
            DataError: The frame has the index of an earlier frame.
        """
        journal.check_order(frame)
        with journal.timed(frame.index, "tracking"):
            masked, detections = self.masking.mask(frame, detections)
            pose = self.tracker.track(self.color_to_depth.predicted(masked), self.fuser.scene)
            if not isinstance(cast(object, pose), Pose):
                raise DataError(
                    f"frame {frame.index}: expected a Pose from the tracker, got {type(pose).__name__}; return a Pose "
                    "from track()"
                )
            check_distance(masked, pose)
            registered, self.T_world_color, color_pixels = self.color_to_depth.tracked(masked, pose)
            if self.color_to_depth.displaced_before:
                self.tracker.renew_colors()
                self.fuser.renew_colors()
            if self.tracker.poses_given and not pose.lost and self.fuser.scene.statistics.voxels:
                self.compare_with_map(registered, pose, journal)
        journal.frame_tracked(masked, pose, is_masked=masked is not frame)
        if not pose.lost:
            self.fuse_frame(registered, pose, detections, color_pixels, journal)
            pose = self.correct_map(registered, pose, journal)
        self.viewer.show(masked, detections, pose, journal.stage_ms(frame.index))
        return pose

    def fuse_frame(
        self, frame: Frame, pose: Pose, detections: Detections, color_pixels: Int32 | None, journal: Journal
    ) -> None:
        """Lift, refine and fuse the detections of a tracked frame, whose color is registered to depth.

        `color_pixels` is explained at `lift`.
        """
        with journal.timed(frame.index, "lifting"):
            lifted = lift(detections, frame, pose, color_pixels)
        journal.count_omitted(frame, lifted)
        with journal.timed(frame.index, "refinement"):
            clusters = refine(self.refiner, lifted, frame)
        journal.frames_in_map += 1
        with journal.fusing(frame.index) as timer:
            self.fuser.fuse(frame, pose, clusters, timer)
        journal.frame_fused(frame)
        journal.digest(frame.index, detection=detections, lifting=lifted, refinement=clusters, fusion=self.fuser.scene)

    def correct_map(self, frame: Frame, pose: Pose, journal: Journal) -> Pose:
        """Apply the change of the map after a fused frame, and return the corrected pose of the frame."""
        with journal.timed(frame.index, "backend"):
            change = self.backend.update(frame, pose, self.fuser.scene)
            if change is None:
                return pose
            corrected = replace(pose, T_world_camera=change.moved(journal.tracked.submap, pose.T_world_camera))
            self.apply(change, journal)
            return corrected

    def finish(self, journal: Journal) -> SubmapGraph | None:
        """Apply the last change of the map, and return the pose graph. An error is stored in `journal.stopped_by`."""
        try:
            change = self.backend.finish(self.fuser.scene)
            if change is not None:
                self.apply(change, journal)
            return self.backend.graph()
        except Exception as error:
            journal.stopped_by = journal.stopped_by or error
            return None

    def apply(self, change: SubmapChange, journal: Journal) -> None:
        """Change the map, and move the poses of earlier frames with it."""
        merged: Mapping[int, int] = {}
        full: MapFullError | None = None
        try:
            merged = self.fuser.correct(change)
        except MapFullError as error:  # the submaps have moved
            full = error
        self.tracker.correct(change)
        self.color_to_depth.correct(change, journal.tracked.submap)
        if self.T_world_color is not None:
            self.T_world_color = change.moved(journal.tracked.submap, self.T_world_color)
        journal.corrected(change, merged)
        if full is not None:
            raise full
        self.viewer.correct(change, self.backend.graph())

    def compare_with_map(self, frame: Frame, pose: Pose, journal: Journal) -> None:
        """Compare the depth of a frame with the map at its given pose, and record the result.

        Raises:
            DataError: The first frame contradicts the map of `resume_from`.
        """
        agreement = map_agreement(frame, pose.T_world_camera, self.fuser.scene)
        if self.resumed and (warning := check_resumed(frame, agreement)):
            log.warning("%s", warning)
        self.resumed = False
        journal.frame_compared(frame, agreement.is_apart, agreement.disagrees, agreement.disagreeing)


def usable_back_end(backend: BackEnd, tracker: PoseTracker, fuser: MapFuser) -> BackEnd:
    """Return the back end, or one that does not change the map if the poses or the map cannot be corrected.

    With given poses, depth is not calibrated either.
    """
    if not changes_map(backend):
        return backend
    if tracker.poses_given or tracker.pose_source == "ground_truth":
        return BackEnd()
    if type(tracker).correct is PoseTracker.correct:
        reason = f"{type(tracker).__name__} cannot correct its poses"
    elif not fuser.has_submaps:
        reason = f"the map of {type(fuser).__name__} has no submaps"
    else:
        return backend
    log.info("back end: no corrections of the map by %s, because %s", type(backend).__name__, reason)
    return DepthOnly(backend.calibrator)


def changes_map(backend: BackEnd) -> bool:
    """Return True if the back end may change the map."""
    return type(backend).update is not BackEnd.update or type(backend).finish is not BackEnd.finish


@contextmanager
def watched(viewer: Viewer, scene: SceneMap, video: str, directory: Path) -> Iterator[None]:
    """Begin the viewer, and end it after the `with` body, also after an error."""
    viewer.begin(scene, video, directory)
    try:
        yield
    finally:
        viewer.end()
