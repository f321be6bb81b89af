"""Contract tests of a viewer."""

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
from framework.interfaces import SubmapChange, Viewer
from framework.testing.contracts import same
from framework.testing.corner_room import CAMERA, RoomMap, frame_at, pose_at, spheres_in

FRAMES = 8  # number of frames of a test run
LOST, SKIPPED, NOTHING_FOUND, BLIND = 2, 3, 4, 5  # indices of the special frames; see `show_run`, `frame_with_found`
CORRECTED = 6  # index of the frame after which the map is corrected
CHANGE = SubmapChange({0: pose_at(1)}, submap=1)
STAGE_MS = {  # stage times of a frame, ms
    "reading": 1.0,
    "detection": 20.0,
    "tracking": 5.0,
    "lifting": 0.5,
    "refinement": 3.0,
    "association": 2.0,
    "update": 3.0,
    "integration": 5.0,
    "backend": 0.2,
}
CONFIG = {"seed": 0, "fuser": {"voxel_size": 0.01, "max_blocks": None}, "viewer": {}}  # config of a test run
METRICS = {"sequence": "a room", "frames": FRAMES, "instances.ap50": 0.5, "instances.ap50.bed": None, "git_dirty": True}


@dataclass(frozen=True)
class WatchedMap(RoomMap):
    """A map of one chair (a triangle) that records reads outside of viewer calls."""

    within_a_call: threading.Event = field(default_factory=threading.Event)
    reads_outside: list[str] = field(default_factory=list)

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        self._note_read("render")
        return super().render(camera, T_world_camera)

    def mesh(self) -> InstanceMesh:
        self._note_read("mesh")
        return InstanceMesh(
            vertices=np.array([[-0.5, 0.4, 2.2], [-0.3, 0.7, 1.9], [-0.7, 0.7, 1.9]], np.float32),
            triangles=np.array([[0, 1, 2]], np.int32),
            colors=np.full((3, 3), 128, np.uint8),
            instance_ids=np.ones(3, np.int32),
            class_ids=np.zeros(3, np.int32),
            classes=self.classes,
        )

    def instances(self) -> dict[int, Instance]:
        self._note_read("instances")
        box = Box(np.array([-0.5, 0.55, 2.05]), np.array([0.4, 0.3, 0.3]), np.eye(3))
        sure = np.array([0.9, 0.1], np.float32)
        return {1: Instance(1, sure, 0.9, FRAMES, 0, FRAMES - 1, np.arange(3, dtype=np.int32), box, box)}

    @contextmanager
    def call(self) -> Iterator[None]:
        """Allow reads of the map in the `with` body."""
        self.within_a_call.set()
        yield
        self.within_a_call.clear()

    def _note_read(self, what: str) -> None:
        if not self.within_a_call.is_set():
            self.reads_outside.append(what)


class ViewerContract:
    """Tests of a viewer."""

    stage = "viewer"

    def plugin(self) -> Viewer:
        raise NotImplementedError(
            "ViewerContract.plugin: expected an override, got none; return the viewer under test from plugin()"
        )

    def test_viewer_shows_frames_without_changing_them(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        scene, frames = WatchedMap(), [frame_with_found(k) for k in range(FRAMES)]
        show_run(self.plugin(), scene, frames, tmp_path)
        for k, (frame, found) in enumerate(frames):
            assert same(frame, frame_with_found(k)[0])
            assert same(found, frame_with_found(k)[1])
        assert not warnings(caplog)

    def test_viewer_reads_map_only_in_calls(self, tmp_path: Path) -> None:
        scene = WatchedMap()
        show_run(self.plugin(), scene, [frame_with_found(k) for k in range(FRAMES)], tmp_path)
        assert not scene.reads_outside, "the fuser may write the map outside of viewer calls"

    def test_viewer_accepts_run_without_frames(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        scene, viewer = WatchedMap(), self.plugin()
        viewer.begin_run(tmp_path, {})
        with scene.call():
            viewer.begin(scene, "a room", tmp_path)
            viewer.skip("frame 0 cannot be read")
            viewer.end()
        viewer.end_run({}, "no frame was mapped")
        assert not warnings(caplog)

    def test_viewer_accepts_several_runs(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        viewer = self.plugin()
        for name in ("one", "other"):
            (tmp_path / name).mkdir()
            show_run(viewer, WatchedMap(), [frame_with_found(0)], tmp_path / name)
        assert not warnings(caplog)

    def test_viewer_writes_only_to_run_directory(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "here").mkdir()
        (tmp_path / "run").mkdir()
        monkeypatch.chdir(tmp_path / "here")
        show_run(self.plugin(), WatchedMap(), [frame_with_found(0)], tmp_path / "run")
        assert not [*(tmp_path / "here").iterdir()]


def frame_with_found(k: int) -> tuple[Frame, Detections]:
    """Return frame k and its detections.

    Frame NOTHING_FOUND has no detections. Frame BLIND is black and has no depth.
    """
    frame = frame_at(k)
    found = spheres_in(frame)
    if k == NOTHING_FOUND:
        none = {name: getattr(found, name)[:0] for name in ("masks", "boxes", "scores", "class_probabilities")}
        found = replace(found, **none)
    if k == BLIND:
        frame = replace(frame, color=np.zeros_like(frame.color), depth=np.zeros(CAMERA.shape, np.float32))
    return frame, found


def show_run(viewer: Viewer, scene: WatchedMap, frames: list[tuple[Frame, Detections]], directory: Path) -> None:
    """Show frames and their detections, as in a run. Frame LOST is lost, frame SKIPPED is skipped."""
    viewer.begin_run(directory, CONFIG)
    with scene.call():
        viewer.begin(scene, "a room", directory)
    shown = [shown_with(k) for k in range(len(frames))]
    for k, ((frame, found), (pose, stage_ms)) in enumerate(zip(frames, shown, strict=True)):
        with scene.call():
            if k == SKIPPED:
                viewer.skip(f"frame {k} cannot be read")
            else:
                if k == CORRECTED:
                    viewer.correct(CHANGE, None)
                viewer.show(frame, found, pose, stage_ms)
    with scene.call():
        viewer.end()
    viewer.end_run(METRICS, "")
    for k, (pose, stage_ms) in enumerate(shown):
        assert same(pose, shown_with(k)[0]), "the pose was changed"
        assert stage_ms == shown_with(k)[1], "the stage times were changed"


def shown_with(k: int) -> tuple[Pose, dict[str, float]]:
    """Return the pose and the stage times of frame k."""
    if k == LOST:
        timed = ("reading", "detection", "tracking")
        return Pose(pose_at(k), lost=True, reason="too dark"), {stage: STAGE_MS[stage] for stage in timed}
    return Pose(pose_at(k)), dict(STAGE_MS)


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the messages of all log records with a level of at least WARNING."""
    return [record.message for record in caplog.records if record.levelno >= logging.WARNING]
