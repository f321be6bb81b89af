"""Loop closure with submaps and a robust pose graph."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Float64, Frame, Pose
from framework.geometry import inverse, rotation_angle
from framework.interfaces import (
    BackEnd,
    ClosedLoop,
    DepthCalibrator,
    GraphAnchor,
    SceneMap,
    SubmapChange,
    SubmapGraph,
    SubmapSurfaces,
)
from framework.pose_graph.delayed_result import DelayedResult
from framework.pose_graph.depth_calibration import DepthCalibration
from framework.pose_graph.drift_covariance import DriftCovariance
from framework.pose_graph.graph_optimization import AnchorGraph, GraphEdge, Optimized, load_optimizer, optimize
from framework.pose_graph.loop_detection import Drift, Extracted, Guess, Loop, LoopDetection, QueryView, Reach
from framework.pose_graph.loop_verification import LoopVerification, match_hidden, overlaps
from framework.pose_graph.object_landmarks import NoLandmarks, ObjectLandmarks
from framework.pose_graph.submap_anchors import DepthSamples, SubmapAnchors, view_separation

log = logging.getLogger(__name__)

REACH = 0.75  # maximum distance of a camera from the views of a submap that it shows, fraction of the hide distance
MIN_COVERAGE = 0.05  # minimum fraction of the depth samples of a frame near the points of a submap in view
TRACKED_COVERAGE = 0.2  # minimum fraction for a guess that is the tracked pose
SAME_PLACE = 8.0  # m, maximum path between hidden submaps that are rendered together
MIN_OVERLAP = 0.05  # minimum fraction of a frame's points on a submap that it shows
EXTENT = 3.0  # m, distance of the surface from the anchor at which motions are compared with min_motion
MIN_LOOPS = 2  # minimum number of loops of a correction that agree with the optimized graph
EXTRACTION_DELAY = 3  # number of frames between a view and the use of its features, which a thread extracts
SAME_GUESS = Drift(0.1, 0.05)  # m and rad, maximum difference of two guesses of which the first one is enough


class Verification(NamedTuple):
    """A verification of the guesses of a view in progress."""

    view: QueryView
    result: DelayedResult[Loop | None]


class Correction(NamedTuple):
    """A correction of the graph in progress."""

    loops: Sequence[Loop]
    added: range  # numbers of the edges of the loops and of their landmarks; later edges are not optimized
    result: DelayedResult[Optimized]


@dataclass
class PoseGraph(BackEnd):
    """Submaps with a robust pose graph, after voxgraph (Reijgwart et al., 2020) and Choi et al. (2015).

    Distant submaps are hidden, so that the tracker does not blend a drifted view with them. When the camera returns,
    loops with hidden submaps are detected, verified and added to the graph. The graph is optimized in a background
    thread. Then, submaps move, and those of the loops become visible.

    Results depend on frame numbers, not on the time that threads take.
    """

    anchors: SubmapAnchors = field(default_factory=SubmapAnchors)
    detection: LoopDetection = field(default_factory=LoopDetection)
    verification: LoopVerification = field(default_factory=LoopVerification)
    calibration: DepthCalibration = field(default_factory=DepthCalibration)
    min_motion: float = 0.01  # minimum motion of a submap's surface, m, in [0, 1]; smaller motions are omitted
    # number of frames until the results of verification and of optimization in other threads are used, in [0, 1000]
    correction_delay: int = 10
    object_landmarks: bool = False  # true = use objects mapped before and after the drift as landmarks of the graph

    def __post_init__(self) -> None:
        check_bounds(self, min_motion=(0.0, 1.0), correction_delay=(0, 1000))
        self.loops: list[Loop] = []  # the loops of all corrections
        self._closed: list[ClosedLoop] = []  # the same loops with their corrections
        self._graph = AnchorGraph()
        self._drift = DriftCovariance()
        self._landmarks = ObjectLandmarks() if self.object_landmarks else NoLandmarks()
        self._frames = 0  # number of frames
        self._views = 0  # number of views
        self._T_world_view: Float64 | None = None  # tracked pose of the last view
        self._extracted: DelayedResult[Extracted] | None = None
        self._guesses: deque[Sequence[Guess]] = deque()  # of one view each, best first
        self._verification: Verification | None = None
        self._correction: Correction | None = None

    @property
    def calibrator(self) -> DepthCalibrator:
        return self.calibration

    def resume(self) -> None:
        self.anchors.resume()

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        self._frames += 1
        if self._frames == 1:
            DelayedResult(load_optimizer, due=0)  # would slow down the frames after the first loop
        unchanged = corrected = SubmapChange(submap=self.anchors.current)
        if self._correction is not None and self._correction.result.due <= self._frames:
            corrected = self._corrected(self._correction)
        if self._extracted is not None and self._extracted.due <= self._frames:
            self._collect(self._extracted.get())
        if self._verification is not None and self._verification.result.due <= self._frames:
            self._collect_loop(self._verification, scene)
        if self._guesses and self._verification is None and self._correction is None and corrected is unchanged:
            self._verify(self._guesses.popleft(), scene)  # not before the scene is corrected, too
        T_world_camera = corrected.moved(self.anchors.current, pose.T_world_camera)
        self._divide(frame, replace(pose, T_world_camera=T_world_camera))
        hidden = self._look(frame, T_world_camera)
        change = SubmapChange(corrected.motions, corrected.shown, hidden, self.anchors.current)
        self._landmarks.observe(change, self.anchors.submaps, frame.camera, scene)
        return None if change == unchanged else change

    def finish(self, scene: SceneMap) -> SubmapChange | None:
        if self._extracted is not None:
            self._collect(self._extracted.get())
        while self._correction is None and (self._verification is not None or self._guesses):
            if self._verification is None:
                self._verify(self._guesses.popleft(), scene)
            else:
                self._collect_loop(self._verification, scene)
        return None if self._correction is None else self._corrected(self._correction)

    def graph(self) -> SubmapGraph:
        edges, submaps = self._graph.edges, self.anchors.submaps
        return SubmapGraph(
            tuple(GraphAnchor(next(iter(one.frames), None), one.T_world_anchor) for one in submaps),
            tuple((edge.first, edge.second) for edge in edges if not edge.is_loop),
            tuple(closed for loop, closed in zip(self.loops, self._closed, strict=True) if loop.edge in edges),
        )

    def _divide(self, frame: Frame, pose: Pose) -> None:
        """Begin a submap, or enter another one, if the camera has left the current one."""
        left, T_world_camera, submaps = self.anchors.current, pose.T_world_camera, self.anchors.submaps
        if submaps:
            self._drift.move(submaps[left].local(T_world_camera), pose.covariance)
        if not self.anchors.divide(frame, T_world_camera):
            return
        entered = self.anchors.current
        T_entered_camera = submaps[entered].local(T_world_camera)
        if entered != left and not self._graph.connected(left, entered):
            T_left_entered = submaps[left].local(submaps[entered].T_world_anchor)
            covariance = self._drift.at(inverse(T_entered_camera))
            self._graph.edges.append(GraphEdge.tracked(left, entered, T_left_entered, covariance))
        self._drift.enter(T_entered_camera)

    def _look(self, frame: Frame, T_world_camera: Float64) -> frozenset[int]:
        """Compare the frame with the hidden submaps if its view is new, and return the submaps to hide."""
        last = self._T_world_view
        if last is not None and view_separation(last[None], T_world_camera)[0] < 1:
            return frozenset()
        self._T_world_view = T_world_camera
        self._views += 1
        current = self.anchors.submaps[self.anchors.current]
        is_new = current.add_view(frame, T_world_camera) or current.frames == [frame.index]
        hidden = self.anchors.hide_distant(T_world_camera)
        if self._extracted is None:
            reaches = self._reaches(frame, T_world_camera) if self._correction is None else ()
            if is_new or reaches:
                view = QueryView(self._views, frame, current, current.local(T_world_camera), is_new, reaches)
                due = self._frames + EXTRACTION_DELAY
                self._extracted = DelayedResult(partial(self.detection.extract, view), due)
        return hidden

    def _reaches(self, frame: Frame, T_world_camera: Float64) -> tuple[Reach, ...]:
        """Return the hidden submaps that may be in view, those that cover most of the frame first."""
        hidden = self.anchors.hidden()
        if not hidden:
            return ()
        samples, paths = DepthSamples.of(frame), self._graph.path_lengths(self.anchors.current)
        found = []
        for submap in hidden:
            T_anchor_camera, drift = submap.local(T_world_camera), self.detection.drift(paths[submap.number])
            if submap.distance(T_world_camera) <= REACH * self.anchors.hide_distance + drift.translation:
                coverage = submap.coverage(samples, T_anchor_camera, drift.translation)
                if coverage >= MIN_COVERAGE:
                    found.append(Reach(submap, T_anchor_camera, paths[submap.number], drift, coverage))
        return tuple(sorted(found, key=lambda reach: -reach.coverage))

    def _collect(self, extracted: Extracted) -> None:
        """Add a keyframe, and the guesses of its pose: those from features, then the tracked pose."""
        self._extracted = None
        view = extracted.view
        if extracted.keyframe is not None and view.is_new:
            view.submap.keyframes.append(extracted.keyframe)
        tracked = [
            Guess(view, reach, reach.submap.local(view.T_world_camera))
            for reach in view.reaches[:1]
            if reach.coverage >= TRACKED_COVERAGE
        ]
        guesses: list[Guess] = []
        for guess in (*extracted.guesses, *tracked):
            if not any(SAME_GUESS.allows(guess.T_world_camera, one.T_world_camera) for one in guesses):
                guesses.append(guess)
        if guesses:
            self._guesses.append(guesses)

    def _verify(self, guesses: Sequence[Guess], scene: SceneMap) -> None:
        """Start the verification of the guesses of a view."""
        view, placed = guesses[0].view, []
        for guess in guesses:
            if guess.reach.submap.hidden:
                paths = self._graph.path_lengths(guess.reach.submap.number)
                reached = (reach.submap for reach in view.reaches)
                placed.append(
                    (guess, [one.number for one in reached if one.hidden and paths[one.number] <= SAME_PLACE])
                )
        call = partial(self._first_loop, placed, scene.hidden_surfaces())
        self._verification = Verification(view, DelayedResult(call, self._frames + self.correction_delay))

    def _first_loop(self, placed: Sequence[tuple[Guess, Sequence[int]]], surfaces: SubmapSurfaces) -> Loop | None:
        """Return the loop of the first correct guess, each with the submaps at the same place; None = no loop."""
        return next((loop for one in placed if (loop := self._loop(*one, surfaces)) is not None), None)

    def _loop(self, guess: Guess, place: Sequence[int], surfaces: SubmapSurfaces) -> Loop | None:
        """Return the loop of a correct guess, or None. Hidden submaps do not change until it is collected."""
        view = guess.view
        match = match_hidden(view.frame, guess.T_world_camera, surfaces, place)
        if match is None or not self.verification.accepts(match):
            return None
        if not guess.reach.drift.allows(match.T_world_camera, view.T_world_camera):
            return None
        near = REACH * self.anchors.hide_distance
        shown = {
            number: overlap
            for number, overlap in overlaps(view.frame, match.T_world_camera, surfaces, place).items()
            if overlap >= MIN_OVERLAP and self.anchors.submaps[number].distance(match.T_world_camera) <= near
        }
        if not shown:
            return None
        best = self.anchors.submaps[max(shown, key=lambda number: shown[number])]
        T_best_camera = best.local(match.T_world_camera)
        earlier = best.nearest_view(T_best_camera)
        T_best_anchor = T_best_camera @ inverse(view.T_anchor_camera)
        return Loop(
            view.frame.index, best.frames[earlier], inverse(best.views[earlier]) @ T_best_camera,
            GraphEdge.loop(best.number, view.submap.number, T_best_anchor),
            frozenset(shown), view.number, guess.reach.path,
        )  # fmt: skip

    def _collect_loop(self, verification: Verification, scene: SceneMap) -> None:
        """Start a correction if another loop agrees with the verified one."""
        self._verification = None
        loop = verification.result.get()
        if loop is not None:
            loops = self.detection.agreeing(loop, self.anchors.submaps, verification.view.T_world_camera)
            if loops:
                camera = verification.view.frame.camera
                self._optimize(loops, self._landmarks.edges(loops, self.anchors, camera, scene))

    def _optimize(self, loops: Sequence[Loop], landmarks: Sequence[GraphEdge]) -> None:
        """Start the optimization of the graph with additional loops and the edges of their landmarks."""
        self._guesses.clear()
        before = len(self._graph.edges)
        self._graph.edges.extend([*(loop.edge for loop in loops), *landmarks])
        poses, edges = [one.T_world_anchor for one in self.anchors.submaps], list(self._graph.edges)
        result = DelayedResult(partial(optimize, poses, edges), self._frames + self.correction_delay)
        self._correction = Correction(loops, range(before, len(edges)), result)

    def _corrected(self, correction: Correction) -> SubmapChange:
        """Move the anchors, and return the motions and the hidden submaps of the loops that agree with the graph.

        Nothing changes if only one loop agrees, because those that confirmed it do not.
        """
        self._correction = None
        optimized = correction.result.get()
        loops = [loop for loop in correction.loops if loop.edge in optimized.edges]
        if len(loops) < MIN_LOOPS:
            del self._graph.edges[correction.added.start : correction.added.stop]
            return SubmapChange(submap=self.anchors.current)
        self._graph.edges = [*optimized.edges, *self._graph.edges[correction.added.stop :]]
        self._report(loops)
        shown = frozenset().union(*(loop.shown for loop in loops))
        motions = {}
        for submap, T_world_new in zip(self.anchors.submaps, self._graph.extended(optimized.poses), strict=True):
            T_new_old = T_world_new @ inverse(submap.T_world_anchor)
            step = np.linalg.norm(T_world_new[:3, 3] - submap.T_world_anchor[:3, 3])
            if step + EXTENT * rotation_angle(T_new_old[:3, :3]) >= self.min_motion:
                motions[submap.number] = T_new_old
                submap.T_world_anchor = T_world_new
        for number in shown:
            self.anchors.submaps[number].hidden = False
        return SubmapChange(motions, shown, submap=self.anchors.current)

    def _report(self, loops: Sequence[Loop]) -> None:
        """Record and log loops before the anchors move."""
        for loop in loops:
            closed = loop.closed(self.anchors.submaps)
            self.loops.append(loop)
            self._closed.append(closed)
            log.info(
                "loop closed between frames %d and %d, %.1f m: correction %.0f mm, %.1f degrees",
                closed.earlier_frame, closed.frame, closed.path, closed.correction_mm, closed.correction_deg,
            )  # fmt: skip
