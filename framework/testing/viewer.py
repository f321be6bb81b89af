"""The contract of a viewer."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import Box, Camera, Detections, Float64, Frame, Instance, InstanceMesh, Pose, View
from framework.interfaces import Viewer
from framework.testing.assertions import same
from framework.testing.corner_room import CAMERA, RoomMap, frame_at, pose_at, spheres_in

FRAMES, LOST, SKIPPED, NOTHING_FOUND, BLIND = 8, 2, 3, 4, 5
STAGE_MS = {"read": 1.0, "detect": 20.0, "track": 5.0, "lift": 0.5, "refine": 3.0, "fuse": 10.0}


@dataclass(frozen=True)
class WatchedMap(RoomMap):
    """A map of one chair, a triangle, that notes what is asked of it while nobody may."""

    within_a_call: threading.Event = field(default_factory=threading.Event)
    asked_outside: list[str] = field(default_factory=list)

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        self._asked("render")
        return super().render(camera, T_world_camera)

    def mesh(self) -> InstanceMesh:
        self._asked("mesh")
        return InstanceMesh(
            vertices=np.array([[-0.5, 0.4, 2.2], [-0.3, 0.7, 1.9], [-0.7, 0.7, 1.9]], np.float32),
            triangles=np.array([[0, 1, 2]], np.int32),
            colors=np.full((3, 3), 128, np.uint8),
            instance_ids=np.ones(3, np.int32),
            class_ids=np.zeros(3, np.int32),
            classes=self.classes,
        )

    def instances(self) -> dict[int, Instance]:
        self._asked("instances")
        box = Box(np.array([-0.5, 0.55, 2.05]), np.array([0.4, 0.3, 0.3]), np.eye(3))
        sure = np.array([0.9, 0.1], np.float32)
        return {1: Instance(1, sure, 0.9, FRAMES, 0, FRAMES - 1, np.arange(3, dtype=np.int32), box, box)}

    @contextmanager
    def call(self) -> Iterator[None]:
        """Around a call of a viewer: meanwhile the map may be read."""
        self.within_a_call.set()
        yield
        self.within_a_call.clear()

    def _asked(self, what: str) -> None:
        if not self.within_a_call.is_set():
            self.asked_outside.append(what)


class ViewerContract:
    """What every viewer keeps."""

    stage = "viewer"

    def plugin(self) -> Viewer:
        raise NotImplementedError("the viewer that is tested")

    def test_viewer_takes_all_that_happens_to_frames_and_changes_nothing(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        scene, frames = WatchedMap(), [frame_with_found(k) for k in range(FRAMES)]
        show_run(self.plugin(), scene, frames, tmp_path)
        for k, (frame, found) in enumerate(frames):
            assert same(frame, frame_with_found(k)[0])
            assert same(found, frame_with_found(k)[1])
        assert not warnings(caplog)

    def test_viewer_reads_the_map_within_a_call_only(self, tmp_path: Path) -> None:
        scene = WatchedMap()
        show_run(self.plugin(), scene, [frame_with_found(k) for k in range(FRAMES)], tmp_path)
        assert not scene.asked_outside, "the fuser may be writing it then"

    def test_viewer_takes_an_end_without_a_frame(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        scene, viewer = WatchedMap(), self.plugin()
        with scene.call():
            viewer.begin(scene, "a room", tmp_path)
            viewer.skip("frame 0 cannot be read")
            viewer.end()
        assert not warnings(caplog)

    def test_viewer_shows_one_video_after_another(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        viewer = self.plugin()
        for name in ("one", "other"):
            (tmp_path / name).mkdir()
            show_run(viewer, WatchedMap(), [frame_with_found(0)], tmp_path / name)
        assert not warnings(caplog)

    def test_viewer_leaves_its_files_in_the_runs_directory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "here").mkdir()
        (tmp_path / "run").mkdir()
        monkeypatch.chdir(tmp_path / "here")
        show_run(self.plugin(), WatchedMap(), [frame_with_found(0)], tmp_path / "run")
        assert not [*(tmp_path / "here").iterdir()]


def frame_with_found(k: int) -> tuple[Frame, Detections]:
    """Frame k and its detections: one is without any, one is dark and without depth."""
    frame = frame_at(k)
    found = spheres_in(frame)
    if k == NOTHING_FOUND:
        none = {name: getattr(found, name)[:0] for name in ("masks", "boxes", "scores", "class_probabilities")}
        found = replace(found, **none)
    if k == BLIND:
        frame = replace(frame, color=np.zeros_like(frame.color), depth=np.zeros(CAMERA.shape, np.float32))
    return frame, found


def show_run(viewer: Viewer, scene: WatchedMap, frames: list[tuple[Frame, Detections]], directory: Path) -> None:
    """A run of these frames, as the loop tells of it. One of them is lost, one is skipped."""
    with scene.call():
        viewer.begin(scene, "a room", directory)
    for k, (frame, found) in enumerate(frames):
        with scene.call():
            if k == SKIPPED:
                viewer.skip(f"frame {k} cannot be read")
            elif k == LOST:
                lost = Pose(pose_at(k), lost=True, reason="too dark")
                viewer.show(frame, found, lost, {stage: STAGE_MS[stage] for stage in ("read", "detect", "track")})
            else:
                viewer.show(frame, found, Pose(pose_at(k)), STAGE_MS)
    with scene.call():
        viewer.end()


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What a viewer that fails in a thread of its own says."""
    return [record.message for record in caplog.records if record.levelno >= logging.WARNING]
