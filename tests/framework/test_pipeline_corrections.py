"""Tests for the corrections of the map by a back end in the main loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from framework.data import Detections, Frame, Pose
from framework.errors import MapFullError
from framework.interfaces import BackEnd, PoseTracker, SceneMap, SubmapChange, SubmapGraph, Viewer
from framework.pipeline import Pipeline
from framework.runtime.digests import digest_of
from plugins.backends.none import NoBackEnd
from tests.support.scenes.corner_room import CornerRoom, GivenPose, GridFuser, KeepAll, SphereDetector, pose_at
from tests.support.scenes.given_changes import (
    AS_TRACKED,
    CHANGES,
    CORRECTED,
    GRAPH,
    LAST,
    A,
    C,
    D,
    GivenChanges,
    RoomTracker,
    SubmapFuser,
)


def pipeline(
    tracker: PoseTracker | None = None, fuser: GridFuser | None = None, backend: BackEnd | None = None,
    viewer: Viewer | None = None,
) -> Pipeline:  # fmt: skip
    return Pipeline(
        SphereDetector(), tracker or RoomTracker(), KeepAll(), fuser or SubmapFuser(),
        viewer=viewer or Viewer(), backend=backend or GivenChanges(),
    )  # fmt: skip


def test_pipeline_corrects_poses_of_all_frames(room: CornerRoom) -> None:
    result = pipeline().run(room)
    assert result.as_tracked is not None
    for k, (frame, tracked) in enumerate(zip(result.tracked, result.as_tracked, strict=True)):
        np.testing.assert_array_equal(tracked.pose.T_world_camera, AS_TRACKED[k] @ pose_at(k))
        np.testing.assert_allclose(frame.pose.T_world_camera, CORRECTED[k] @ pose_at(k), atol=1e-14)
        assert (frame.index, frame.timestamp) == (tracked.index, tracked.timestamp)


def test_pipeline_passes_changes_to_fuser_and_tracker(room: CornerRoom) -> None:
    fuser = SubmapFuser()
    result = pipeline(fuser=fuser).run(room)
    assert fuser.corrected == [CHANGES[2], CHANGES[4], LAST]
    np.testing.assert_allclose(result.keyframes["T_world_room"], D @ C @ A, atol=1e-14)


def test_pipeline_shows_corrected_pose_and_back_end_time(room: CornerRoom) -> None:
    @dataclass
    class Shows(Viewer):
        def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
            shown.append(pose.T_world_camera)
            assert list(stage_ms)[-1] == "backend"

    shown: list[np.ndarray] = []
    mapping = pipeline(viewer=Shows())
    result = mapping.run(room)
    for k, T_world_room in enumerate((np.eye(4), np.eye(4), A, A, C @ A, C @ A)):
        np.testing.assert_allclose(shown[k], T_world_room @ pose_at(k), atol=1e-14)
    assert mapping.T_world_color is not None
    np.testing.assert_allclose(mapping.T_world_color, D @ C @ A @ pose_at(5), atol=1e-14)
    assert [one.frame for one in result.timings if one.stage == "backend"] == list(range(6))


def test_pipeline_logs_motions_and_merged_instances(room: CornerRoom, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    moved = np.eye(4)
    moved[:3, 3] = 0.03, 0.0, 0.04
    changes = {1: SubmapChange(submap=1), 3: SubmapChange({0: moved}, submap=1)}
    fuser = SubmapFuser(merged={40: 12, 7: 3})
    pipeline(fuser=fuser, backend=GivenChanges(changes, last=None)).run(room)
    logged = [record.message for record in caplog.records if record.message.startswith("frame ")]
    merged = "instances merged: 7 into 3, 40 into 12"
    assert logged == [f"frame 1: {merged}", "frame 3: submaps moved: 1, by at most 50 mm", f"frame 3: {merged}"]


def test_pipeline_records_digest_of_changed_map(room: CornerRoom) -> None:
    result = pipeline(backend=GivenChanges(CHANGES, last=None)).run(room)
    digests = [(one.frame, one.digest) for one in result.digests if one.stage == "backend"]
    assert [frame for frame, _ in digests] == [2, 4]
    after_frame_4 = [one.digest for one in result.digests if (one.frame, one.stage) == (4, "fusion")]
    assert [digests[1][1]] == after_frame_4
    assert digests[1][1] != digest_of(result.scene)


def test_pipeline_returns_graph_and_passes_it_to_viewer(room: CornerRoom) -> None:
    class Corrects(Viewer):
        def correct(self, change: SubmapChange, graph: SubmapGraph | None) -> None:
            seen.append((change, graph))

    seen: list[tuple[SubmapChange, SubmapGraph | None]] = []
    assert pipeline(viewer=Corrects()).run(room).graph is GRAPH
    assert seen == [(CHANGES[2], GRAPH), (CHANGES[4], GRAPH), (LAST, GRAPH)]


def test_pipeline_without_change_keeps_poses(room: CornerRoom) -> None:
    result = pipeline(backend=GivenChanges({}, last=None)).run(room)
    assert result.as_tracked is not None
    for frame, tracked in zip(result.tracked, result.as_tracked, strict=True):
        assert frame.pose.T_world_camera.tobytes() == tracked.pose.T_world_camera.tobytes()


class _CannotCorrect(RoomTracker):
    correct = PoseTracker.correct


@pytest.mark.parametrize(
    ("tracker", "fuser", "reason"),
    [
        (_CannotCorrect(), SubmapFuser(), "_CannotCorrect cannot correct its poses"),
        (RoomTracker(), GridFuser(), "the map of GridFuser has no submaps"),
    ],
)
def test_pipeline_without_correctable_stages_logs_reason(
    tracker: PoseTracker, fuser: GridFuser, reason: str, room: CornerRoom, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    result = pipeline(tracker, fuser).run(room)
    assert [record.message for record in caplog.records if "back end" in record.message] == [
        f"back end: no corrections of the map by GivenChanges, because {reason}"
    ]
    assert result.as_tracked is None
    np.testing.assert_array_equal(result.tracked[5].pose.T_world_camera, pose_at(5))


@pytest.mark.parametrize(
    ("fuser", "backend"), [(SubmapFuser(), None), (GridFuser(), NoBackEnd())], ids=["given poses", "no back end"]
)
def test_pipeline_without_need_of_corrections_logs_nothing(
    fuser: GridFuser, backend: BackEnd | None, room: CornerRoom, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    assert pipeline(GivenPose(), fuser, backend).run(room).as_tracked is None
    assert not [record for record in caplog.records if "back end" in record.message]


def test_pipeline_full_map_moves_poses_with_submaps(room: CornerRoom) -> None:
    class Full(SubmapFuser):
        def correct(self, change: SubmapChange) -> Mapping[int, int]:
            super().correct(change)
            raise MapFullError("expected fewer blocks")

    fuser = Full()
    result = pipeline(fuser=fuser).run_to_any_end(room)
    assert isinstance(result.stopped_by, MapFullError)
    assert fuser.corrected == [CHANGES[2], LAST]
    np.testing.assert_allclose(result.tracked[0].pose.T_world_camera, LAST.moved(0, CHANGES[2].moved(0, pose_at(0))))


def test_pipeline_back_end_error_at_the_end_keeps_map(room: CornerRoom) -> None:
    class Fails(GivenChanges):
        def finish(self, scene: SceneMap) -> SubmapChange | None:
            raise ValueError("no solution")

    result = pipeline(backend=Fails()).run_to_any_end(room)
    assert str(result.stopped_by) == "no solution"
    assert len(result.tracked) == 6
