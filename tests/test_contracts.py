"""The contracts of `framework.interfaces`, on every plugin that a config registers. A new plugin needs no line here."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import is_dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.data import Detections, Frame, FrameTruth, PointClusters, Pose
from framework.errors import DataError
from framework.geometry import lift
from framework.interfaces import ClusterRefiner, Detector, LiveVideo, MapFuser, PoseTracker, RGBDSequence
from tests import option_files, registered
from tests.scenes.corner_room import CAMERA, CLASSES, CornerRoom, GridMap, SphereDetector, pose_at
from tests.thread_counts import by_one_thread_and_two

Ready = Callable[[str, str], Any]


def same(a: object, b: object) -> bool:
    """Whether two of the pipeline's data hold the same arrays."""
    return all(
        same(x, y) if is_dataclass(x) else np.array_equal(x, y)
        for x, y in zip(vars(a).values(), vars(b).values(), strict=True)
    )


# Datasets


@pytest.fixture(params=registered.names("dataset", RGBDSequence), scope="module")
def sequence(request: pytest.FixtureRequest, ready: Ready) -> RGBDSequence:
    sequence: RGBDSequence = ready("dataset", request.param)
    return sequence


def test_dataset_gives_frames_of_its_camera(sequence: RGBDSequence) -> None:
    assert sequence.name
    assert len(sequence) > 0
    frame = sequence[0]
    assert frame.T_world_camera is not None, "the tests' recordings have poses"
    assert frame.camera == sequence.camera
    assert (frame.depth > 0).any()
    assert same(frame, sequence[0])


def test_dataset_is_in_order(sequence: RGBDSequence) -> None:
    first, last = sequence[0], sequence[len(sequence) - 1]
    assert len(sequence) == 1 or (last.index > first.index and last.timestamp > first.timestamp)


@pytest.fixture(params=registered.names("dataset", LiveVideo))
def video(request: pytest.FixtureRequest, ready: Ready, monkeypatch: pytest.MonkeyPatch) -> LiveVideo:
    for name, module in option_files.modules("dataset", request.param).items():
        monkeypatch.setitem(sys.modules, name, module)
    video: LiveVideo = ready("dataset", request.param)
    return video


def come(video: LiveVideo) -> Iterator[Frame]:
    """The frames, which can be read; something is said while none comes."""
    with closing(video.frames()) as readers:
        said = time.monotonic()
        for reader in readers:
            assert time.monotonic() - said < 1, "ten times a second, but for a busy machine"
            if reader is not None:
                yield reader()
            said = time.monotonic()


def test_live_video_gives_frames_of_this_moment_in_order(video: LiveVideo) -> None:
    began = time.time()
    frames = list(islice(come(video), 2))
    assert video.name
    assert len(frames) == 2
    assert all((frame.depth > 0).any() for frame in frames)
    assert frames[0].camera == frames[1].camera
    assert frames[0].index < frames[1].index
    assert began <= frames[0].timestamp < frames[1].timestamp <= time.time()


def test_live_video_is_given_back_and_can_be_opened_again(video: LiveVideo) -> None:
    for _ in range(2):
        assert len(list(islice(come(video), 1))) == 1


# Detectors


@pytest.fixture(params=registered.names("detector"))
def detector(request: pytest.FixtureRequest, ready: Ready) -> Detector:
    detector: Detector = ready("detector", request.param)
    return detector


def assert_keeps_the_contract(found: Detections, detector: Detector, frame: Frame) -> None:
    assert found.classes == detector.classes
    assert found.masks.shape == (len(found), *frame.camera.shape)
    assert found.class_probabilities.shape == (len(found), len(detector.classes))
    np.testing.assert_allclose(found.class_probabilities.sum(axis=1), 1, atol=1e-4)
    assert (np.diff(found.scores) <= 0).all(), "best first"
    for mask, (x1, y1, x2, y2) in zip(found.masks, found.boxes, strict=True):
        assert -1 <= x1 <= x2 <= frame.camera.width + 1
        assert -1 <= y1 <= y2 <= frame.camera.height + 1
        v, u = np.nonzero(mask)
        if len(u):
            slack = 2  # px: boxes are regressed, masks are resampled
            assert u.min() >= x1 - slack
            assert u.max() <= x2 + slack
            assert v.min() >= y1 - slack
            assert v.max() <= y2 + slack


def test_detector_returns_distributions_and_masks_in_the_image(detector: Detector, room: CornerRoom) -> None:
    frame = room[0]
    found = detector.detect(frame)
    assert_keeps_the_contract(found, detector, frame)


def test_detector_gives_the_same_for_the_same_frame_in_any_order(detector: Detector, room: CornerRoom) -> None:
    forwards = [detector.detect(room[k]) for k in (0, 1)]
    backwards = [detector.detect(room[k]) for k in (1, 0)]
    assert same(forwards[0], backwards[1])
    assert same(forwards[1], backwards[0])


def test_detector_takes_a_blank_image(detector: Detector) -> None:
    nothing = FrameTruth(np.zeros(CAMERA.shape, np.int32), {})
    blank = Frame(
        0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32), CAMERA, truth=nothing
    )
    assert_keeps_the_contract(detector.detect(blank), detector, blank)


def test_detector_needs_no_truth_or_says_so(detector: Detector) -> None:
    frame = CornerRoom(truth=False)[0]
    try:
        assert_keeps_the_contract(detector.detect(frame), detector, frame)
    except DataError as error:
        assert "\n" not in str(error)


# Trackers


@pytest.fixture(params=registered.names("tracker"))
def tracker(request: pytest.FixtureRequest, ready: Ready) -> PoseTracker:
    tracker: PoseTracker = ready("tracker", request.param)
    return tracker


class ReadOnlyMap(GridMap):
    """A map of the corner room that refuses to be written."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in self.__dict__:
            raise AssertionError(f"a tracker wrote scene.{name}")
        super().__setattr__(name, value)


def test_tracker_returns_a_pose_and_leaves_the_map_alone(tracker: PoseTracker, room: CornerRoom) -> None:
    scene = ReadOnlyMap()
    for frame in room:
        pose = tracker.track(frame, scene)
        assert isinstance(pose, Pose)  # rigid, as every Pose
        assert not pose.lost or pose.reason
    assert (scene.vertices, scene.colors, scene.ids, scene.triangles) == ([], [], [], [])


def test_trackers_world_is_the_first_frames_true_pose(tracker: PoseTracker) -> None:
    moved = CornerRoom(start=4)
    np.testing.assert_allclose(tracker.track(moved[0], GridMap()).T_world_camera, pose_at(4), atol=1e-12)


def test_tracker_without_true_poses_starts_at_the_identity_or_says_so(tracker: PoseTracker) -> None:
    try:
        pose = tracker.track(CornerRoom(truth=False)[0], GridMap())
    except DataError as error:
        assert "\n" not in str(error)
    else:
        np.testing.assert_allclose(pose.T_world_camera, np.eye(4), atol=1e-12)


def test_tracker_survives_a_frame_without_depth(tracker: PoseTracker, room: CornerRoom) -> None:
    scene = GridMap()
    tracker.track(room[0], scene)
    blind = replace(room[1], depth=np.zeros(CAMERA.shape, np.float32))
    assert isinstance(tracker.track(blind, scene), Pose)
    assert isinstance(tracker.track(room[2], scene), Pose)


# Refiners


@pytest.fixture(params=registered.names("refiner"))
def refiner(request: pytest.FixtureRequest, ready: Ready) -> ClusterRefiner:
    refiner: ClusterRefiner = ready("refiner", request.param)
    return refiner


def bleeding(frame: Frame) -> PointClusters:
    """Both spheres, with masks that take in some of the wall behind."""
    exact = SphereDetector().detect(frame)
    masks = exact.masks | np.roll(exact.masks, 3, axis=2)
    return lift(replace(exact, masks=masks), frame, Pose(pose_at(frame.index)))


def readings(frame: Frame) -> np.ndarray:
    """(H, W, 3) where each pixel's reading lies in the world, NaN without one."""
    whole = replace(SphereDetector().detect(frame), masks=np.ones((2, *CAMERA.shape), bool))
    lifted = lift(whole, frame, Pose(pose_at(frame.index)))
    points = np.full((*CAMERA.shape, 3), np.nan)
    points[lifted.pixels[:, 1], lifted.pixels[:, 0]] = lifted.points_world
    return points


def test_refiner_invents_no_points(refiner: ClusterRefiner, room: CornerRoom) -> None:
    clusters = bleeding(room[1])
    before = {name: np.array(value) for name, value in vars(clusters).items()}
    refined = refiner.refine(clusters, room[1])
    u, v = refined.pixels.T
    np.testing.assert_allclose(refined.points_world, readings(room[1])[v, u], atol=1e-4)
    of_one = np.c_[refined.pixels, refined.cluster]
    assert len(np.unique(of_one, axis=0)) == len(of_one), "a pixel twice in one cluster"
    assert refined.classes == clusters.classes
    assert all(np.array_equal(before[name], value) for name, value in vars(clusters).items()), "input was changed"
    assert (refined.cluster >= 0).any(), "nothing is left of two whole spheres"


def test_refiner_is_repeatable(refiner: ClusterRefiner, room: CornerRoom) -> None:
    first = refiner.refine(bleeding(room[1]), room[1])
    refiner.refine(bleeding(room[2]), room[2])
    assert same(first, refiner.refine(bleeding(room[1]), room[1]))


def test_refiner_does_not_depend_on_the_number_of_threads(refiner: ClusterRefiner, room: CornerRoom) -> None:
    clusters = bleeding(room[1])
    by_one, by_two = by_one_thread_and_two(lambda: refiner.refine(clusters, room[1]))
    assert same(by_one, by_two)


def test_refiner_takes_no_clusters(refiner: ClusterRefiner, room: CornerRoom) -> None:
    nothing = lift(Detections.none(CAMERA.shape, CLASSES), room[0], Pose(pose_at(0)))
    refined = refiner.refine(nothing, room[0])
    assert (len(refined), len(refined.points_world), refined.classes) == (0, 0, CLASSES)


def test_refiner_takes_empty_and_tiny_clusters(refiner: ClusterRefiner, room: CornerRoom) -> None:
    exact = SphereDetector().detect(room[0])
    masks = np.zeros_like(exact.masks)
    masks[1, 40, 40] = True
    refined = refiner.refine(lift(replace(exact, masks=masks), room[0], Pose(pose_at(0))), room[0])
    assert len(refined.points_world) <= 1


# Fusers


@pytest.fixture(params=registered.names("fuser"))
def fuser(request: pytest.FixtureRequest, ready: Ready) -> MapFuser:
    fuser: MapFuser = ready("fuser", request.param)
    return fuser


def fused(fuser: MapFuser, frames: int = 5) -> MapFuser:
    for frame in CornerRoom(frames=frames):
        pose = Pose(pose_at(frame.index))
        fuser.fuse(frame, pose, lift(SphereDetector().detect(frame), frame, pose))
    return fuser


def test_fuser_starts_with_an_empty_map(fuser: MapFuser) -> None:
    view = fuser.scene.render(CAMERA, np.eye(4))
    assert not view.depth.any()
    assert not view.instance_ids.any()
    assert (view.class_ids == -1).all()
    assert len(fuser.scene.mesh().vertices) == 0
    assert not fuser.scene.instances()
    assert fuser.scene.instance_count == 0


def test_fuser_maps_what_it_saw(fuser: MapFuser) -> None:
    scene = fused(fuser).scene
    assert scene.voxel_count > 0
    assert scene.byte_count > 0
    truth = CornerRoom()[2]
    view = scene.render(CAMERA, pose_at(2))
    both = (view.depth > 0) & (truth.depth > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(view.depth - truth.depth)[both]) < 0.02
    length = np.linalg.norm(view.normals_world[view.depth > 0], axis=1)
    np.testing.assert_allclose(length, 1, atol=1e-3)
    assert not view.normals_world[view.depth == 0].any()


def test_fusers_instances_are_those_of_its_mesh(fuser: MapFuser) -> None:
    scene = fused(fuser).scene
    mesh, instances = scene.mesh(), scene.instances()
    assert scene.instance_count == len(instances)
    assert mesh.triangles.max(initial=-1) < len(mesh.vertices)
    assert instances, "two spheres, each seen whole in five frames"
    for key, instance in instances.items():
        assert key == instance.id > 0
        assert (mesh.instance_ids[instance.vertices] == key).all()
        assert 0 <= instance.confidence <= 1
        assert instance.class_probabilities.shape == (len(scene.classes),)
        assert instance.class_probabilities.sum() == pytest.approx(1, abs=1e-3)
        points = mesh.vertices[instance.vertices]
        low, high = (instance.aabb.center + sign * instance.aabb.extent / 2 for sign in (-1, 1))
        assert ((points >= low - 1e-4) & (points <= high + 1e-4)).all()
        inside = np.abs((points - instance.obb.center) @ instance.obb.rotation)
        assert (inside <= instance.obb.extent / 2 + 1e-3).all()


def test_fuser_takes_a_frame_without_detections_or_depth(fuser: MapFuser, room: CornerRoom) -> None:
    frame, pose = room[0], Pose(pose_at(0))
    fuser.fuse(frame, pose, lift(Detections.none(CAMERA.shape, CLASSES), frame, pose))
    blind = replace(room[1], depth=np.zeros(CAMERA.shape, np.float32))
    fuser.fuse(blind, pose, lift(Detections.none(CAMERA.shape, CLASSES), blind, pose))
    assert not fuser.scene.instances()


def test_fuser_maps_the_depths_that_it_says(fuser: MapFuser, room: CornerRoom) -> None:
    nearest, farthest = fuser.scene.depth_range
    frame, pose = room[0], Pose(pose_at(0))
    nothing = lift(Detections.none(CAMERA.shape, CLASSES), frame, pose)
    for depth in (0.99 * nearest, 1.01 * farthest):
        fuser.fuse(replace(frame, depth=np.full(CAMERA.shape, depth, np.float32)), pose, nothing)
    assert not len(fuser.scene.mesh().vertices)
    fuser.fuse(replace(frame, depth=np.full(CAMERA.shape, nearest + 0.1, np.float32)), pose, nothing)
    assert len(fuser.scene.mesh().vertices)


def test_fusers_map_is_seen_by_cameras_from_poses_only(fuser: MapFuser) -> None:
    scene, pose, depth = fuser.scene, pose_at(0), np.ones(CAMERA.shape, np.float32)
    for no_pose in (2 * pose, pose[:3], pose.tolist(), np.full((4, 4), np.nan), None):
        with pytest.raises(DataError, match="T_world_camera"):
            scene.render(CAMERA, no_pose)
        with pytest.raises(DataError, match="T_world_camera"):
            scene.render_near(CAMERA, no_pose, depth)
    with pytest.raises(DataError, match="camera must be a Camera, found ndarray"):
        scene.render(CAMERA.K, pose)  # type: ignore[arg-type]


def test_fusers_map_survives_saving(fuser: MapFuser, tmp_path: Path) -> None:
    scene = fused(fuser, frames=3).scene
    path = tmp_path / "map.npz"
    scene.save(path)
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]
    loaded = type(scene).load(path)
    assert loaded.classes == scene.classes
    assert loaded.voxel_count == scene.voxel_count
    before, after = scene.render(CAMERA, pose_at(1)), loaded.render(CAMERA, pose_at(1))
    for name in ("depth", "color", "instance_ids", "class_ids"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert set(loaded.instances()) == set(scene.instances())


def test_fusers_map_refuses_a_damaged_file(fuser: MapFuser, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    fused(fuser, frames=1).scene.save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match=r"map\.npz"):
        type(fuser.scene).load(path)
