"""Detection of loops: guesses of the camera pose relative to hidden submaps, and the agreement of several loops.

Visual words select keyframes of hidden submaps. Matched features with depth give a first guess of the pose by P3P in
RANSAC. The tracked pose is another guess, for views without features and for small drift. Identical rooms look alike,
so that all guesses must be within the plausible drift since the submap was visible. One verified loop does not count.
A second one, from another view, must imply the same correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Float64, Frame
from framework.geometry import inverse, rotation_angle
from framework.interfaces import ClosedLoop
from framework.pose_graph.graph_optimization import GraphEdge
from framework.pose_graph.submap_anchors import Submap
from framework.tracking.features import Features
from framework.tracking.keyframes import Keyframe, Keyframes, similarity

VIEW_OVERLAP = (3.0, 1.2)  # m and rad, maximum difference of two views of one surface
LEAST_DRIFT = (0.2, 0.05)  # m and rad, plausible drift of a short path
TURN = 0.2  # rad per m, ratio of the plausible rotation to the plausible translation
SAME_CORRECTION = (0.1, 0.04)  # m and rad, maximum difference of the corrections that two loops imply
VALID_VIEWS = 10  # number of views after which a loop without a second one is discarded


class Drift(NamedTuple):
    """Bounds of the drift."""

    translation: float  # m
    rotation: float  # rad

    def allows(self, T_world_a: Float64, T_world_b: Float64) -> bool:
        """Return True if the difference of two camera poses (4, 4) is within the bounds."""
        T_a_b = inverse(T_world_a) @ T_world_b
        step, turn = np.linalg.norm(T_a_b[:3, 3]), rotation_angle(T_a_b[:3, :3])
        return bool(step <= self.translation and turn <= self.rotation)

    def plus(self, translation: float, rotation: float) -> Drift:
        """Return larger bounds."""
        return Drift(self.translation + translation, self.rotation + rotation)


class Reach(NamedTuple):
    """A hidden submap that may be in view."""

    submap: Submap
    T_anchor_camera: Float64  # (4, 4) tracked pose in the hidden submap
    path: float  # m, length of the path since the submap was visible
    drift: Drift  # plausible drift since the submap was visible
    coverage: float  # fraction of the depth samples of the frame near points of the submap


@dataclass(frozen=True)
class QueryView:
    """A frame that is compared with hidden submaps."""

    number: int
    frame: Frame
    submap: Submap  # the submap of the frame
    T_anchor_camera: Float64  # (4, 4) in this submap
    is_new: bool  # True = it becomes a keyframe
    reaches: tuple[Reach, ...]

    @property
    def T_world_camera(self) -> Float64:
        """The tracked pose (4, 4), which moves with its submap."""
        return self.submap.T_world_anchor @ self.T_anchor_camera


class Guess(NamedTuple):
    """A guess of the pose of a view relative to a hidden submap."""

    view: QueryView
    reach: Reach
    T_anchor_camera: Float64  # (4, 4) in the hidden submap

    @property
    def T_world_camera(self) -> Float64:
        """The pose (4, 4) in the world frame of the hidden submap."""
        return self.reach.submap.T_world_anchor @ self.T_anchor_camera


class Extracted(NamedTuple):
    """A view with its features."""

    view: QueryView
    keyframe: Keyframe | None  # None = too few features
    guesses: list[Guess]


@dataclass(frozen=True)
class Loop:
    """A verified pose of a frame relative to a hidden submap."""

    frame: int  # Frame.index
    earlier_frame: int  # Frame.index of the nearest view of the hidden submap
    T_earlier_camera: Float64  # (4, 4) pose of the frame relative to the earlier one
    edge: GraphEdge  # from the hidden submap to that of the frame
    shown: frozenset[int]  # hidden submaps in view
    view: int  # QueryView.number of the frame
    path: float  # m, length of the path that the loop closes

    def correction(self, submaps: Sequence[Submap]) -> Float64:
        """Return the motion (4, 4) of the camera's submap in the world frame that closes the loop."""
        T_world_hidden, T_world_camera = (submaps[k].T_world_anchor for k in (self.edge.first, self.edge.second))
        return T_world_hidden @ self.edge.T_first_second @ inverse(T_world_camera)

    def closed(self, submaps: Sequence[Submap]) -> ClosedLoop:
        """Return the loop with its correction, before the submaps move."""
        T_new_old = self.correction(submaps)
        T_world_anchor = submaps[self.edge.second].T_world_anchor
        step = (T_new_old @ T_world_anchor)[:3, 3] - T_world_anchor[:3, 3]
        return ClosedLoop(
            self.earlier_frame, self.frame, (self.edge.first, self.edge.second), self.path,
            1e3 * float(np.linalg.norm(step)), float(np.degrees(rotation_angle(T_new_old[:3, :3]))),
        )  # fmt: skip


@dataclass
class LoopDetection:
    """Detection of loops."""

    # maximum plausible drift, fraction of the path, in [0, 1]; below the distance between identical rooms divided by
    # the path between visits
    max_drift: float = 0.03
    loop_keyframes: int = 4  # maximum number of keyframes that are matched with a frame, in [1, 100]
    seed: int = 0  # seed of RANSAC and of the visual words, >= 0

    def __post_init__(self) -> None:
        check_bounds(self, max_drift=(0.0, 1.0), loop_keyframes=(1, 100))
        self._keyframes = Keyframes(seed=self.seed)
        self._pending: list[Loop] = []

    def drift(self, path: float) -> Drift:
        """Return the plausible drift along a path, m."""
        growth = self.max_drift * path
        return Drift(growth, TURN * growth).plus(*LEAST_DRIFT)

    def extract(self, view: QueryView) -> Extracted:
        """Return a view as a keyframe, and guesses of its pose from features. Called in a thread."""
        features = self._keyframes.extractor.extract(view.frame)
        described = self._keyframes.keyframe(view.frame, features, view.T_anchor_camera)
        if len(described.points_world) < self._keyframes.min_features:
            return Extracted(view, None, [])
        return Extracted(view, described, self._located(view, features, described))

    def _located(self, view: QueryView, features: Features, described: Keyframe) -> list[Guess]:
        """Return the plausible poses of a view from the features of the keyframes that look most similar."""
        near = [
            (reach, keyframe)
            for reach in view.reaches
            for keyframe in reach.submap.keyframes
            if reach.drift.plus(*VIEW_OVERLAP).allows(keyframe.T_world_camera, reach.T_anchor_camera)
        ]
        if not near:
            return []
        alike = similarity(described.bag, np.stack([keyframe.bag for _, keyframe in near]))
        best = [near[k] for k in np.argsort(-alike, kind="stable")[: self.loop_keyframes]]
        guesses = []
        for number in dict.fromkeys(reach.submap.number for reach, _ in best):  # the most similar one first
            reach = next(one for one in view.reaches if one.submap.number == number)
            found = self._keyframes.locate(view.frame, features, [key for one, key in best if one is reach])
            if found is not None and reach.drift.allows(found.T_world_camera, reach.T_anchor_camera):
                guesses.append(Guess(view, reach, found.T_world_camera))
        return guesses

    def agreeing(self, loop: Loop, submaps: Sequence[Submap], T_world_camera: Float64) -> list[Loop]:
        """Add a verified loop, and return it with the earlier ones that imply the same correction.

        The result is empty without another one. Otherwise, all loops so far are removed.
        """
        moved = loop.correction(submaps) @ T_world_camera
        self._pending = [one for one in self._pending if loop.view - one.view <= VALID_VIEWS]
        agreeing = [
            one
            for one in self._pending
            if Drift(*SAME_CORRECTION).allows(one.correction(submaps) @ T_world_camera, moved)
        ]
        if not agreeing:
            self._pending.append(loop)
            return []
        self._pending = []
        return [*agreeing, loop]
