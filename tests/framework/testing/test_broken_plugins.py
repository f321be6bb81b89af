"""Tests for the contract tests. Each plugin violates one rule and must be detected."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Mapping
from dataclasses import FrozenInstanceError, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.config import composition
from framework.data import Detections, Frame, PointClusters, Pose
from framework.errors import DataError
from framework.geometry import inverse
from framework.interfaces import ClusterRefiner, PoseTracker, SceneMap, StageTimer, SubmapChange, Viewer, untimed
from framework.testing.contracts import (
    BackEndContract,
    DetectorContract,
    FuserContract,
    OptionContract,
    RefinerContract,
    SequenceContract,
    TrackerContract,
)
from framework.testing.corner_room import CAMERA
from framework.testing.viewer import ViewerContract
from tests.support.scenes.corner_room import CornerRoom, GridFuser, SphereDetector
from tests.support.scenes.given_changes import GivenChanges, RoomTracker

pytestmark = pytest.mark.integration


class Forgetful(SphereDetector):
    """Detector that finds fewer objects in each call."""

    def __init__(self) -> None:
        super().__init__()
        self.left = 2

    def detect(self, frame: Frame) -> Detections:
        found = super().detect(frame)
        self.left -= 1
        kept = slice(max(self.left, 0))
        parts = {name: getattr(found, name)[kept] for name in ("masks", "boxes", "scores", "class_probabilities")}
        return replace(found, **parts)


class Sharing(SphereDetector):
    """Detector that declares concurrent detection, but uses the first frame of another thread."""

    concurrent = True
    shared: Frame | None = None

    def detect(self, frame: Frame) -> Detections:
        if threading.current_thread() is not threading.main_thread():
            self.shared = frame = self.shared or frame
        return super().detect(frame)


class Peeking(SphereDetector):
    """Detector that finds objects only in frames with ground truth."""

    def detect(self, frame: Frame) -> Detections:
        return Detections.none(CAMERA.shape, self.classes) if frame.truth is None else super().detect(frame)


class Whitening(SphereDetector):
    """Detector that normalizes the color image in place."""

    def detect(self, frame: Frame) -> Detections:
        frame.color[:] = frame.color - frame.color.min()
        return super().detect(frame)


@dataclass
class Shifting(ClusterRefiner):
    """Refiner that moves points."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return replace(clusters, points_world=clusters.points_world + np.float32(0.01))


@dataclass
class Dropping(ClusterRefiner):
    """Refiner that drops all points."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return replace(clusters, cluster=np.full_like(clusters.cluster, -1))


@dataclass
class Selecting(ClusterRefiner):
    """Refiner that keeps the points on ground-truth instances."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        assert frame.truth is not None
        u, v = clusters.pixels.T
        right = frame.truth.instance_ids[v, u] == clusters.cluster + 1
        return replace(clusters, cluster=np.where(right, clusters.cluster, -1).astype(np.int32))


@dataclass
class Cheating(PoseTracker):
    """Tracker that moves its pose toward the ground-truth pose."""

    fraction: float = 1.0

    def __post_init__(self) -> None:
        self._first: Pose | None = None

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        assert frame.T_world_camera is not None
        self._first = self._first or Pose(frame.T_world_camera)
        T_world_camera = self._first.T_world_camera.copy()
        T_world_camera[:3, 3] += self.fraction * (frame.T_world_camera - T_world_camera)[:3, 3]
        return Pose(T_world_camera)


class Boasting(Cheating):
    """Tracker that declares ground-truth poses, but returns other poses."""

    pose_source = "ground_truth"


@dataclass
class Following(PoseTracker):
    """Tracker that returns the pose of odometry as the pose in the world frame."""

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        return Pose(np.eye(4) if frame.T_odom_camera is None else frame.T_odom_camera)


@dataclass
class Erasing(PoseTracker):
    """Tracker that removes distant depth readings in place."""

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        frame.depth[frame.depth > 2] = 0
        return Pose(np.eye(4))


@dataclass
class Writing(PoseTracker):
    """Tracker that returns a constant, wrong pose and, if `writes`, changes the map."""

    writes: bool = False

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        if self.writes:
            scene.classes = ("mine",)
        return Pose(np.diag([1.0, -1.0, -1.0, 1.0]))


class Staying(RoomTracker):
    """Tracker that does not follow corrections of the map."""

    def correct(self, change: SubmapChange) -> None:
        pass


class Scaling(GivenChanges):
    """Back end whose motion is not rigid."""

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        return SubmapChange({0: np.diag([1.1, 1.1, 1.1, 1.0])}) if frame.index == 2 else None


class Skipping(GivenChanges):
    """Back end that omits a submap number."""

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        return SubmapChange(submap=2) if frame.index == 2 else None


class Hiding(GivenChanges):
    """Back end that hides the submap of the next frames."""

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        return SubmapChange(hidden=frozenset({0})) if frame.index == 2 else None


class Knowing(GivenChanges):
    """Back end that moves the map to the ground-truth pose."""

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        assert frame.T_world_camera is not None
        return SubmapChange({0: frame.T_world_camera @ inverse(pose.T_world_camera)}) if frame.index == 2 else None


class Careless(GridFuser):
    """Fuser whose map accepts any pose for rendering, even an invalid one."""


class Relocating(GridFuser):
    """Fuser that replaces the tracked pose with the ground-truth pose."""

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        assert frame.T_world_camera is not None
        super().fuse(frame, Pose(frame.T_world_camera), clusters, timer)


class Smoothing(GridFuser):
    """Fuser that changes the depth image in place."""

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        frame.depth[1:-1] = (frame.depth[:-2] + frame.depth[2:]) / 2
        super().fuse(frame, pose, clusters, timer)


class Backwards(CornerRoom):
    """Dataset with frames in reverse order."""

    def __getitem__(self, k: int) -> Frame:
        return super().__getitem__(len(self) - 1 - k)


@pytest.mark.parametrize(
    ("contract", "plugin", "test"),
    [
        (DetectorContract, Forgetful, "test_detector_does_not_depend_on_frame_order"),
        (DetectorContract, Sharing, "test_detector_does_not_depend_on_thread"),
        (DetectorContract, Peeking, "test_detector_uses_ground_truth_only_if_required"),
        (DetectorContract, Whitening, "test_detector_returns_valid_detections"),
        (RefinerContract, Shifting, "test_refiner_returns_only_measured_points"),
        (RefinerContract, Dropping, "test_refiner_returns_only_measured_points"),
        (RefinerContract, Selecting, "test_refiner_does_not_depend_on_ground_truth"),
        (TrackerContract, partial(Writing, writes=True), "test_tracker_returns_poses_without_changing_map"),
        (TrackerContract, Writing, "test_tracker_first_pose_equals_ground_truth"),
        (TrackerContract, Cheating, "test_tracker_pose_source_is_correct"),
        (TrackerContract, partial(Cheating, fraction=1e-4), "test_tracker_pose_source_is_correct"),
        (TrackerContract, partial(Boasting, fraction=0.5), "test_tracker_pose_source_is_correct"),
        (TrackerContract, Following, "test_tracker_does_not_depend_on_odometry_frame"),
        (TrackerContract, Erasing, "test_tracker_returns_poses_without_changing_map"),
        (TrackerContract, Staying, "test_tracker_follows_corrections_of_map"),
        (BackEndContract, partial(Scaling, last=None), "test_backend_changes_only_known_submaps"),
        (BackEndContract, partial(Skipping, last=None), "test_backend_changes_only_known_submaps"),
        (BackEndContract, partial(Hiding, last=None), "test_backend_changes_only_known_submaps"),
        (BackEndContract, partial(Knowing, last=None), "test_backend_does_not_depend_on_ground_truth"),
        (BackEndContract, GivenChanges, "test_backend_without_frames_changes_nothing"),
        (BackEndContract, partial(GivenChanges, {}, None), "test_backend_graph_has_all_submaps"),
        (FuserContract, Careless, "test_fuser_map_rejects_invalid_poses"),
        (FuserContract, Relocating, "test_fuser_does_not_depend_on_ground_truth"),
        (FuserContract, Smoothing, "test_fuser_does_not_depend_on_ground_truth"),
        (SequenceContract, Backwards, "test_dataset_frames_are_in_order"),
    ],
)
def test_contract_detects_broken_plugin(contract: type[Any], plugin: Callable[[], object], test: str) -> None:
    tests = contract()
    tests.plugin = plugin
    with pytest.raises((AssertionError, FrozenInstanceError, DataError)):
        getattr(tests, test)()


class Late(Viewer):
    """Viewer that reads the map after the call, and writes to the working directory."""

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self.scene = scene

    def show(self, *_: object) -> None:
        looking = threading.Timer(0.0, self.scene.mesh)
        self.scene.within_a_call.clear()  # type: ignore[attr-defined]
        looking.start()
        looking.join()
        Path("note").touch()


class Painting(Viewer):
    """Viewer that changes the frame."""

    def show(self, frame: Frame, *_: object) -> None:
        frame.color[0, 0] = 255 - frame.color[0, 0]


class Leveling(Viewer):
    """Viewer that changes the pose."""

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        pose.T_world_camera[1, 3] = 0


class Summing(Viewer):
    """Viewer that adds a total to the stage times."""

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        stage_ms["total"] = sum(stage_ms.values())  # type: ignore[index]


@pytest.mark.parametrize(
    ("viewer", "test"),
    [
        (Painting(), ViewerContract.test_viewer_shows_frames_without_changing_them),
        (Leveling(), ViewerContract.test_viewer_shows_frames_without_changing_them),
        (Summing(), ViewerContract.test_viewer_shows_frames_without_changing_them),
        (Late(), ViewerContract.test_viewer_reads_map_only_in_calls),
        (Late(), ViewerContract.test_viewer_writes_only_to_run_directory),
    ],
)
def test_viewer_contract_detects_broken_viewer(
    viewer: Viewer,
    test: Callable[..., None],
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    tests = ViewerContract()
    tests.plugin = lambda: viewer  # type: ignore[method-assign]
    fixtures = [name for name in inspect.signature(test).parameters if name != "self"]
    with pytest.raises(AssertionError):
        test(tests, *map(request.getfixturevalue, fixtures))


def option(folder: Path, text: str) -> OptionContract:
    """Return the contract test of a refiner option with this YAML."""
    (folder / "refiner").mkdir()
    (folder / "refiner" / "own.yaml").write_text(text)

    class Own(OptionContract, RefinerContract):
        option = "own"

    return Own()


OWN = "_target_: plugins.refiners.largest_component.LargestComponent\nmax_gap: {} # m\ngap_per_depth: 0.02 # m per m\n"


@pytest.mark.parametrize(
    ("text", "listed", "defaults"),
    [
        (OWN.format(0.03) + "connection_radius: 2 # px\n", True, True),
        (OWN.format(0.04) + "connection_radius: 2 # px\n", True, False),
        (OWN.format(0.03) + "connection_radius: 2\n", False, True),
        (OWN.format(0.03), False, True),
    ],
)
def test_option_contract_detects_inconsistent_yaml(
    text: str, listed: bool, defaults: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(composition, "_added", [tmp_path])
    tests = option(tmp_path, text)
    for test, holds in (
        (tests.test_option_lists_every_parameter_with_comment, listed),
        (tests.test_option_values_are_class_defaults, defaults),
    ):
        if holds:
            test()
        else:
            with pytest.raises(AssertionError):
                test()
