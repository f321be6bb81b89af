"""A back end with given changes, and a tracker and a fuser that follow them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from framework.data import Array, Frame, Pose
from framework.geometry import exp_se3
from framework.interfaces import (
    BackEnd,
    ClosedLoop,
    GraphAnchor,
    PoseTracker,
    SceneMap,
    SubmapChange,
    SubmapGraph,
)
from tests.support.scenes.corner_room import GridFuser

A, B, C, D = (exp_se3(np.array(xi)) for xi in 0.1 * np.random.default_rng(0).normal(size=(4, 6)))
CHANGES = {2: SubmapChange({0: A}, submap=1), 4: SubmapChange({0: B, 1: C}, submap=1)}
LAST = SubmapChange({1: D}, submap=1)
AS_TRACKED = (np.eye(4), np.eye(4), np.eye(4), A, A, C @ A)
"""T_world_room at each frame of a run with CHANGES."""
CORRECTED = (B @ A, B @ A, B @ A, D @ C @ A, D @ C @ A, D @ C @ A)
"""T_world_room at each frame after CHANGES and LAST."""


GRAPH = SubmapGraph(
    (GraphAnchor(None, np.eye(4)), GraphAnchor(2, A)), ((0, 1),), (ClosedLoop(1, 4, (0, 1), 20.5, 283.0, 0.7),)
)


@dataclass
class GivenChanges(BackEnd):
    """Back end with given changes and a given pose graph."""

    changes: Mapping[int, SubmapChange] = field(default_factory=lambda: CHANGES)  # by Frame.index
    last: SubmapChange | None = field(default_factory=lambda: LAST)

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        return self.changes.get(frame.index)

    def finish(self, scene: SceneMap) -> SubmapChange | None:
        return self.last

    def graph(self) -> SubmapGraph:
        return GRAPH


@dataclass
class RoomTracker(PoseTracker):
    """Tracker with the ground-truth poses in the corrected world."""

    def __post_init__(self) -> None:
        self.T_world_room, self.submap = np.eye(4), 0

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        assert frame.T_world_camera is not None
        return Pose(self.T_world_room @ frame.T_world_camera)

    def correct(self, change: SubmapChange) -> None:
        self.T_world_room = change.moved(self.submap, self.T_world_room)
        self.submap = change.submap

    def keyframes(self) -> Mapping[str, Array]:
        return {"T_world_room": self.T_world_room}


@dataclass
class SubmapFuser(GridFuser):
    """Fuser that records the changes of its submaps, and merges given instances."""

    has_submaps = True
    merged: Mapping[int, int] = field(default_factory=dict)  # result of each correction

    def __post_init__(self) -> None:
        super().__post_init__()
        self.corrected: list[SubmapChange] = []

    def correct(self, change: SubmapChange) -> Mapping[int, int]:
        self.corrected.append(change)
        return self.merged
