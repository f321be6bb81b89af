"""Our tracker and fuser, run frame by frame, with the time of each step."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from framework.data import Detections, Frame, Pose
from framework.interfaces import MapFuser, PoseTracker
from framework.refinement.lifting import lift

RENDERING = "render for tracking"  # included in track


def seconds(step: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Return the duration of a step, s, and its result."""
    begin = time.perf_counter()
    answer = step(*arguments)
    return time.perf_counter() - begin, answer


class SlamLoop:
    """Loop of tracking, lifting and fusion. Any tracker and fuser can be measured."""

    def __init__(self, tracker: PoseTracker, fuser: MapFuser) -> None:
        self.tracker = tracker
        self.fuser = fuser
        self.seconds: dict[str, float] = {}  # s, of the steps of the last frame
        self.poses: list[Pose] = []
        self._rendering = 0.0
        self._watch_rendering()

    def __call__(self, frame: Frame, detections: Detections) -> Pose:
        self._rendering = 0.0
        track, pose = seconds(self.tracker.track, frame, self.fuser.scene)
        self.poses.append(pose)
        self.seconds = {"track": track, RENDERING: self._rendering, "lift": 0.0, "fuse": 0.0}
        if pose.lost:
            return pose
        self.seconds["lift"], clusters = seconds(lift, detections, frame, pose)
        self.seconds["fuse"], _ = seconds(self.fuser.fuse, frame, pose, clusters)
        return pose

    @property
    def lost(self) -> int:
        return sum(pose.lost for pose in self.poses)

    def render_all(self, frame: Frame) -> None:
        """Render depth, normals, color, instance and class ids of the full image from the last pose."""
        self.fuser.scene.render(frame.camera, self.poses[-1].T_world_camera)

    def _watch_rendering(self) -> None:
        """Measure the time that the tracker spends in the rendering functions of the map."""
        scene = self.fuser.scene
        for name in dir(type(scene)):
            if name.startswith(("render", "cast")) and callable(getattr(scene, name)):
                setattr(scene, name, self._timed(getattr(scene, name)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            try:
                return method(*arguments, **named)
            finally:
                self._rendering += time.perf_counter() - begin

        return timed
