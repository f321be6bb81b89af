"""Contract tests of plugins and their options, by stage.

The tests of viewers are in viewer.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
from omegaconf import DictConfig, OmegaConf

from framework.commands.installation.plugins import registered
from framework.config.composition import composed
from framework.data import Detections, Float64, Frame, FrameTruth, PointClusters, Pose, check_rigid
from framework.errors import DataError
from framework.geometry import exp_se3
from framework.interfaces import (
    BackEnd,
    ClusterRefiner,
    Detector,
    FrameMasking,
    MapFuser,
    PoseTracker,
    RGBDSequence,
    SubmapChange,
)
from framework.refinement.lifting import lift
from framework.registry import GROUPS, build, find_class, parameters
from framework.runtime.run_log import FUSION_STAGES
from framework.testing.corner_room import (
    CAMERA,
    CLASSES,
    RATE,
    RoomMap,
    bleeding_clusters,
    exact_clusters,
    frame_at,
    misleading,
    pose_at,
    spheres_in,
)

SAME_POSE = 5e-6  # maximum difference of equal poses, m and rad; Open3D's sums in several threads differ by 2e-6
ODOMETRY_START = exp_se3(np.array([3.0, -2.0, 1.0, 0.3, -1.2, 0.5]))  # pose of the first frame in an odometry frame

CORRECTED_POSE = 1e-3  # maximum difference of a pose in a moved map, m and rad, because float32 points are rounded
MAP_CHANGES = {
    2: SubmapChange({0: exp_se3(np.array([0.2, -0.1, 0.3, 0.1, 0.3, -0.2]))}, submap=1),
    5: SubmapChange(dict.fromkeys((0, 1), exp_se3(np.full(6, -0.1))), submap=1),
}
"""Motions of the entire map after frames, for trackers."""


class OptionContract:
    """Tests of a config option. The plugin is built as in a run.

    Use this class as the first base class of a test class, followed by the contract of the stage.
    """

    stage: str  # config group; set by the contract of the stage
    option: str  # name of the tested option in the config group of the stage
    overrides: tuple[str, ...] = ()  # values that the user must set, such as ("detector.weights=FILE",)

    def plugin(self) -> Any:
        return build(GROUPS[self.stage], self.node())

    def node(self) -> DictConfig:
        others = [f"~{stage}" for stage in GROUPS if stage != self.stage]
        node: DictConfig = composed(f"{self.stage}={self.option}", *others, *self.overrides)[self.stage]
        return node

    def test_option_lists_every_parameter_with_comment(self) -> None:
        [listed] = registered(self.stage, only=self.option)
        assert listed.documentation, "the class requires a docstring"
        assert not listed.documentation.startswith("unusable"), listed.documentation
        named = {parameter.name for parameter in listed.parameters}
        assert named == set(map(str, self.node())) - {"_target_"}, "the YAML file must list every parameter"
        bare = [parameter.name for parameter in listed.parameters if not parameter.comment]
        assert not bare, f"the YAML file must have a comment for each of {bare}"

    def test_option_values_are_class_defaults(self) -> None:
        node = self.node()
        plugin_class = find_class(GROUPS[self.stage], str(node["_target_"]))
        of_the_user = [override.partition("=")[0].partition(".")[2] for override in self.overrides]
        bare = OmegaConf.masked_copy(node, ["_target_", *of_the_user])
        given, default = (parameters(self.option, plugin_class, of) for of in (node, bare))
        assert given == default


def _plugin_missing(tests: object, tested: str) -> NotImplementedError:
    return NotImplementedError(
        f"{type(tests).__name__}.plugin: expected an override, got none; return the {tested} under test from plugin()"
    )


class SequenceContract:
    """Tests of a sequence with poses."""

    stage = "dataset"

    def plugin(self) -> RGBDSequence:
        raise _plugin_missing(self, "sequence")

    def test_dataset_returns_frames_of_its_camera(self) -> None:
        sequence = self.plugin()
        assert sequence.name
        assert len(sequence) > 0
        frame = sequence[0]
        assert frame.T_world_camera is not None, "the tested sequence must have poses"
        assert frame.camera == sequence.camera
        assert (frame.depth > 0).any()
        assert same(frame, sequence[0])

    def test_dataset_frames_are_in_order(self) -> None:
        sequence = self.plugin()
        first, last = sequence[0], sequence[len(sequence) - 1]
        assert len(sequence) == 1 or (last.index > first.index and last.timestamp > first.timestamp)


class DetectorContract:
    """Tests of a detector."""

    stage = "detector"

    def plugin(self) -> Detector:
        raise _plugin_missing(self, "detector")

    def test_detector_returns_valid_detections(self) -> None:
        detector = self.plugin()
        frame = frame_at(0)
        assert_valid(detector.detect(frame), detector, frame)
        assert same(frame, frame_at(0)), "the frame was changed"

    def test_detector_uses_ground_truth_only_if_required(self) -> None:
        """A detector that depends on ground truth must raise an error without ground truth."""
        detector = self.plugin()
        frame = frame_at(0)
        if not same(detector.detect(frame), detector.detect(misleading(frame))):
            assert_data_error(lambda: detector.detect(frame_at(0, truth=False)), "truth")

    def test_detector_does_not_depend_on_frame_order(self) -> None:
        detector = self.plugin()
        forwards = [detector.detect(frame_at(k)) for k in (0, 1)]
        backwards = [detector.detect(frame_at(k)) for k in (1, 0)]
        assert same(forwards[0], backwards[1])
        assert same(forwards[1], backwards[0])

    def test_detector_does_not_depend_on_thread(self) -> None:
        detector = self.plugin()
        frames = [frame_at(k) for k in (0, 1, 0, 1)]
        with ThreadPoolExecutor(3 if detector.concurrent else 1) as threads:
            found = list(threads.map(detector.detect, frames))
        for k in (0, 1):
            expected = detector.detect(frames[k])
            assert same(found[k], expected)
            assert same(found[k + 2], expected)

    def test_detector_accepts_blank_image(self) -> None:
        detector = self.plugin()
        color, depth = np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32)
        blank = Frame(0, 0.0, color, depth, CAMERA, truth=FrameTruth(np.zeros(CAMERA.shape, np.int32), {}))
        assert_valid(detector.detect(blank), detector, blank)

    def test_detector_without_truth_works_or_raises(self) -> None:
        detector = self.plugin()
        frame = frame_at(0, truth=False)
        try:
            assert_valid(detector.detect(frame), detector, frame)
        except DataError as error:
            assert "\n" not in str(error)


def assert_valid(found: Detections, detector: Detector, frame: Frame) -> None:
    """Assert that the detections of a frame are valid."""
    assert found.classes == detector.classes
    assert found.masks.shape == (len(found), *frame.camera.shape)
    assert found.class_probabilities.shape == (len(found), len(detector.classes))
    np.testing.assert_allclose(found.class_probabilities.sum(axis=1), 1, atol=1e-4)
    assert (np.diff(found.scores) <= 0).all(), "the best detection must come first"
    for mask, (x1, y1, x2, y2) in zip(found.masks, found.boxes, strict=True):
        assert -1 <= x1 <= x2 <= frame.camera.width + 1
        assert -1 <= y1 <= y2 <= frame.camera.height + 1
        v, u = np.nonzero(mask)
        if len(u):
            slack = 2  # px, because boxes are regressed and masks are resampled
            assert u.min() >= x1 - slack
            assert u.max() <= x2 + slack
            assert v.min() >= y1 - slack
            assert v.max() <= y2 + slack


class MaskingContract:
    """Tests of the masking of frames."""

    stage = "masking"

    def plugin(self) -> FrameMasking:
        raise _plugin_missing(self, "masking")

    def test_masking_only_removes_depth_and_detections(self) -> None:
        masking = self.plugin()
        for k in range(4):
            frame, found = frame_at(k), spheres_in(frame_at(k))
            masked, kept = masking.mask(frame, found)
            assert (np.isin(masked.depth, 0) | (masked.depth == frame.depth)).all()
            assert same(replace(masked, depth=frame.depth), frame)
            assert set(kept.scores) <= set(found.scores)
            assert kept.classes == found.classes
            assert same(frame, frame_at(k)), "the frame was changed"
            assert same(found, spheres_in(frame_at(k))), "the detections were changed"

    def test_masking_does_not_depend_on_ground_truth(self) -> None:
        masking, misled = self.plugin(), self.plugin()
        for k in range(4):
            frame, found = frame_at(k), spheres_in(frame_at(k))
            masked, kept = masking.mask(frame, found)
            masked_too, kept_too = misled.mask(misleading(frame), found)
            assert np.array_equal(masked.depth, masked_too.depth)
            assert same(kept, kept_too)


class TrackerContract:
    """Tests of a tracker with an immutable map. Changes to the map raise an error."""

    stage = "tracker"

    def plugin(self) -> PoseTracker:
        raise _plugin_missing(self, "tracker")

    def test_tracker_returns_poses_without_changing_map(self) -> None:
        tracker = self.plugin()
        scene = RoomMap()
        for k in range(6):
            frame = frame_at(k)
            pose = tracker.track(frame, scene)
            assert isinstance(pose, Pose)  # a Pose is always rigid
            assert not pose.lost or pose.reason
            assert same(frame, frame_at(k)), "the frame was changed"

    def test_tracker_pose_source_is_correct(self) -> None:
        """With the pose source `ground_truth`, poses are those of the frames. Other trackers use only the first one."""
        tracker, misled = self.plugin(), self.plugin()
        scene = RoomMap()
        for k in range(4):
            frame = frame_at(k) if k == 0 else misleading(frame_at(k))
            pose = misled.track(frame, scene)
            if misled.pose_source == "ground_truth":
                given = frame.T_world_camera
                assert given is not None
                assert pose.lost or np.array_equal(pose.T_world_camera, given)
            else:
                expected = tracker.track(frame_at(k), scene)
                np.testing.assert_allclose(
                    pose.T_world_camera,
                    expected.T_world_camera,
                    atol=SAME_POSE,
                    err_msg="the pose depends on the ground truth; set pose_source = 'ground_truth'",
                )
                assert pose.lost == expected.lost

    def test_tracker_does_not_depend_on_odometry_frame(self) -> None:
        """The origin of odometry is arbitrary, so only its motion may affect poses. Some frames have no odometry."""
        scene = RoomMap()
        found = []
        for start in (pose_at(0), ODOMETRY_START):
            tracker = self.plugin()
            frames = [replace(frame_at(k), T_odom_camera=None if k == 2 else start @ pose_at(k)) for k in range(4)]
            found.append([tracker.track(frame, scene) for frame in frames])
        for one, other in zip(*found, strict=True):
            assert one.lost == other.lost
            np.testing.assert_allclose(one.T_world_camera, other.T_world_camera, atol=SAME_POSE)

    def test_tracker_first_pose_equals_ground_truth(self) -> None:
        frame = replace(frame_at(4), T_odom_camera=ODOMETRY_START)
        pose = self.plugin().track(frame, RoomMap())
        np.testing.assert_allclose(pose.T_world_camera, pose_at(4), atol=1e-12)

    def test_tracker_without_truth_starts_at_identity_or_raises(self) -> None:
        tracker = self.plugin()
        try:
            pose = tracker.track(frame_at(0, truth=False), RoomMap())
        except DataError as error:
            assert "\n" not in str(error)
        else:
            np.testing.assert_allclose(pose.T_world_camera, np.eye(4), atol=1e-12)

    def test_tracker_accepts_frame_without_depth(self) -> None:
        tracker = self.plugin()
        scene = RoomMap()
        tracker.track(frame_at(0), scene)
        blind = replace(frame_at(1), depth=np.zeros(CAMERA.shape, np.float32))
        assert isinstance(tracker.track(blind, scene), Pose)
        assert isinstance(tracker.track(frame_at(2), scene), Pose)

    def test_tracker_follows_corrections_of_map(self) -> None:
        """The pipeline does not correct given poses."""
        tracker, uncorrected = self.plugin(), self.plugin()
        if tracker.poses_given or tracker.pose_source == "ground_truth":
            return
        T_world_room = np.eye(4)
        for k in range(9):
            pose = tracker.track(frame_at(k), RoomMap(T_world_room=T_world_room))
            expected = uncorrected.track(frame_at(k), RoomMap())
            assert pose.lost == expected.lost, pose.reason
            np.testing.assert_allclose(
                pose.T_world_camera,
                T_world_room @ expected.T_world_camera,
                atol=CORRECTED_POSE,
                err_msg="the pose does not move with the map; implement correct()",
            )
            if k in MAP_CHANGES:
                tracker.correct(MAP_CHANGES[k])
                T_world_room = MAP_CHANGES[k].moved(0, T_world_room)


class RefinerContract:
    """Tests of a refiner."""

    stage = "refiner"

    def plugin(self) -> ClusterRefiner:
        raise _plugin_missing(self, "refiner")

    def test_refiner_returns_only_measured_points(self) -> None:
        frame = frame_at(1)
        clusters = bleeding_clusters(frame)
        before = {name: np.array(value) for name, value in vars(clusters).items()}
        refined = self.plugin().refine(clusters, frame)
        u, v = refined.pixels.T
        np.testing.assert_allclose(refined.points_world, readings(frame)[v, u], atol=1e-4)
        of_one = np.c_[refined.pixels, refined.cluster]
        assert len(np.unique(of_one, axis=0)) == len(of_one), "duplicate pixel in a cluster"
        assert refined.classes == clusters.classes
        assert all(np.array_equal(before[name], value) for name, value in vars(clusters).items()), "input was changed"
        assert same(frame, frame_at(1)), "the frame was changed"
        assert (refined.cluster >= 0).any(), "all points of two complete spheres were removed"

    def test_refiner_does_not_depend_on_ground_truth(self) -> None:
        refiner = self.plugin()
        frame = frame_at(1)
        clusters = bleeding_clusters(frame)
        assert same(refiner.refine(clusters, frame), refiner.refine(clusters, misleading(frame)))

    def test_refiner_is_repeatable(self) -> None:
        refiner = self.plugin()
        one, other = frame_at(1), frame_at(2)
        first = refiner.refine(bleeding_clusters(one), one)
        refiner.refine(bleeding_clusters(other), other)
        assert same(first, refiner.refine(bleeding_clusters(one), one))

    def test_refiner_does_not_depend_on_thread_count(self) -> None:
        refiner = self.plugin()
        frame = frame_at(1)
        clusters = bleeding_clusters(frame)
        usual = numba.get_num_threads()
        made = []
        try:
            for threads in (1, numba.config.NUMBA_NUM_THREADS):
                numba.set_num_threads(threads)
                made.append(refiner.refine(clusters, frame))
        finally:
            numba.set_num_threads(usual)
        assert same(*made)

    def test_refiner_accepts_no_clusters(self) -> None:
        frame = frame_at(0)
        nothing = lift(Detections.none(CAMERA.shape, CLASSES), frame, Pose(pose_at(0)))
        refined = self.plugin().refine(nothing, frame)
        assert (len(refined), len(refined.points_world), refined.classes) == (0, 0, CLASSES)

    def test_refiner_accepts_empty_and_tiny_clusters(self) -> None:
        frame = frame_at(0)
        exact = spheres_in(frame)
        masks = np.zeros_like(exact.masks)
        masks[1, 40, 40] = True
        refined = self.plugin().refine(lift(replace(exact, masks=masks), frame, Pose(pose_at(0))), frame)
        assert len(refined.points_world) <= 1


def readings(frame: Frame) -> Float64:
    """Return the world point (H, W, 3) of each pixel of a frame, m. Pixels without depth are NaN."""
    whole = replace(spheres_in(frame), masks=np.ones((2, *CAMERA.shape), np.bool_))
    lifted = lift(whole, frame, Pose(pose_at(frame.index)))
    points = np.full((*CAMERA.shape, 3), np.nan)
    points[lifted.pixels[:, 1], lifted.pixels[:, 0]] = lifted.points_world
    return points


class FuserContract:
    """Tests of a fuser and its map."""

    stage = "fuser"

    def plugin(self) -> MapFuser:
        raise _plugin_missing(self, "fuser")

    def test_fuser_starts_with_empty_map(self) -> None:
        scene = self.plugin().scene
        view = scene.render(CAMERA, np.eye(4))
        assert not view.depth.any()
        assert not view.instance_ids.any()
        assert (view.class_ids == -1).all()
        assert len(scene.mesh().vertices) == 0
        assert not scene.instances()
        assert not scene.instance_ids()

    def test_fuser_map_matches_depth(self) -> None:
        scene = fused(self.plugin()).scene
        assert scene.statistics.voxels > 0
        assert scene.statistics.bytes > 0
        truth = frame_at(2)
        view = scene.render(CAMERA, pose_at(2))
        both = (view.depth > 0) & (truth.depth > 0)
        assert both.mean() > 0.5
        assert np.median(np.abs(view.depth - truth.depth)[both]) < 0.02
        length = np.linalg.norm(view.normals_world[view.depth > 0], axis=1)
        np.testing.assert_allclose(length, 1, atol=1e-3)
        assert not view.normals_world[view.depth == 0].any()

    def test_fuser_does_not_depend_on_ground_truth(self) -> None:
        fuser, misled = self.plugin(), self.plugin()
        for k in range(3):
            frame = frame_at(k)
            fuser.fuse(frame, Pose(pose_at(k)), exact_clusters(frame))
            misled.fuse(misleading(frame), Pose(pose_at(k)), exact_clusters(frame))
            assert same(frame, frame_at(k)), "the frame was changed"
        assert same(fuser.scene.mesh(), misled.scene.mesh())

    def test_fuser_instances_match_mesh(self) -> None:
        scene = fused(self.plugin()).scene
        mesh, instances = scene.mesh(), scene.instances()
        assert scene.instance_ids() == set(instances)
        assert mesh.triangles.max(initial=-1) < len(mesh.vertices)
        assert instances, "expected instances of two spheres, which are fully visible in five frames, got none"
        for key, instance in instances.items():
            assert key == instance.id > 0
            assert (mesh.instance_ids[instance.vertices] == key).all()
            assert 0 <= instance.confidence <= 1
            assert instance.class_probabilities.shape == (len(scene.classes),)
            np.testing.assert_allclose(instance.class_probabilities.sum(), 1, atol=1e-3)
            points = mesh.vertices[instance.vertices]
            low, high = (instance.aabb.center + sign * instance.aabb.extent / 2 for sign in (-1, 1))
            assert ((points >= low - 1e-4) & (points <= high + 1e-4)).all()
            inside = np.abs((points - instance.obb.center) @ instance.obb.rotation)
            assert (inside <= instance.obb.extent / 2 + 1e-3).all()

    def test_fuser_accepts_frame_without_detections_or_depth(self) -> None:
        fuser = self.plugin()
        frame, pose = frame_at(0), Pose(pose_at(0))
        fuser.fuse(frame, pose, nothing_in(frame, pose))
        blind = replace(frame_at(1), depth=np.zeros(CAMERA.shape, np.float32))
        fuser.fuse(blind, pose, nothing_in(blind, pose))
        assert not fuser.scene.instances()

    def test_fuser_keeps_confidence_without_detection(self) -> None:
        fuser = fused(self.plugin())
        before = fuser.scene.instances()
        frame, pose = frame_at(4), Pose(pose_at(4))
        nothing = replace(nothing_in(frame, pose), detected=False)
        for index in range(5, 15):
            fuser.fuse(replace(frame, index=index), pose, nothing)
        after = fuser.scene.instances()
        assert set(after) == set(before)
        for key, instance in before.items():
            assert after[key].confidence >= 0.99 * instance.confidence
            assert after[key].observations == instance.observations

    def test_fuser_stage_timers_are_not_nested(self) -> None:
        begun: list[str] = []
        ended: list[str] = []

        @contextmanager
        def timer(stage: str) -> Iterator[None]:
            assert begun == ended, f"{stage} is timed within {begun[-1]}"
            begun.append(stage)
            yield
            ended.append(stage)

        frame = frame_at(0)
        self.plugin().fuse(frame, Pose(pose_at(0)), exact_clusters(frame), timer)
        assert set(begun) <= set(FUSION_STAGES)

    def test_fuser_maps_only_depths_in_its_range(self) -> None:
        fuser = self.plugin()
        nearest, farthest = fuser.scene.depth_range
        frame, pose = frame_at(0), Pose(pose_at(0))
        nothing = nothing_in(frame, pose)
        for depth in [0.99 * nearest] + [1.01 * farthest] * bool(np.isfinite(farthest)):
            fuser.fuse(replace(frame, depth=np.full(CAMERA.shape, depth, np.float32)), pose, nothing)
        assert not len(fuser.scene.mesh().vertices)
        fuser.fuse(replace(frame, depth=np.full(CAMERA.shape, nearest + 0.1, np.float32)), pose, nothing)
        assert len(fuser.scene.mesh().vertices)

    def test_fuser_map_rejects_invalid_poses(self) -> None:
        scene, pose, depth = self.plugin().scene, pose_at(0), np.ones(CAMERA.shape, np.float32)
        no_poses: list[Any] = [2 * pose, pose[:3], pose.tolist(), np.full((4, 4), np.nan), None]
        for no_pose in no_poses:
            assert_data_error(partial(scene.render, CAMERA, no_pose), "T_world_camera")
            assert_data_error(partial(scene.render_near, CAMERA, no_pose, depth), "T_world_camera")
        no_camera: Any = CAMERA.K
        assert_data_error(partial(scene.render, no_camera, pose), "camera: expected a Camera, got ndarray")

    def test_fuser_map_is_restored_from_file(self, tmp_path: Path) -> None:
        scene = fused(self.plugin(), frames=3).scene
        path = tmp_path / "map.npz"
        scene.save(path)
        assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]
        loaded = type(scene).load(path)
        assert loaded.classes == scene.classes
        assert loaded.statistics == scene.statistics
        before, after = scene.render(CAMERA, pose_at(1)), loaded.render(CAMERA, pose_at(1))
        for name in ("depth", "color", "instance_ids", "class_ids"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        assert set(loaded.instances()) == set(scene.instances())

    def test_fuser_map_rejects_damaged_file(self, tmp_path: Path) -> None:
        fuser = self.plugin()
        path = tmp_path / "map.npz"
        fused(fuser, frames=1).scene.save(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert_data_error(lambda: type(fuser.scene).load(path), "map.npz")


class BackEndContract:
    """Tests of a back end.

    The camera drifts away from the room and returns to it.
    """

    stage = "backend"

    def plugin(self) -> BackEnd:
        raise _plugin_missing(self, "back end")

    def test_backend_changes_only_known_submaps(self) -> None:
        backend, scene = self.plugin(), RoomMap()
        submaps, hidden = {0}, frozenset[int]()
        for change in changes_of(backend, scene):
            for number, T_new_old in change.motions.items():
                check_rigid(f"motion of submap {number}", T_new_old)
            assert submaps >= {*change.motions, *change.shown, *change.hidden}, "a submap does not exist"
            assert change.shown <= hidden, "a visible submap is shown"
            assert not change.hidden & (hidden - change.shown), "a hidden submap is hidden again"
            hidden = hidden - change.shown | change.hidden
            submaps.add(change.submap)
            assert submaps == set(range(len(submaps))), "a submap number was skipped"
            assert change.submap not in hidden, "the submap of the next frames is hidden"

    def test_backend_does_not_depend_on_ground_truth(self) -> None:
        changes, misled = (list(changes_of(self.plugin(), RoomMap(), wrong)) for wrong in (False, True))
        assert len(changes) == len(misled)
        for one, other in zip(changes, misled, strict=True):
            assert (one.shown, one.hidden, one.submap) == (other.shown, other.hidden, other.submap)
            assert one.motions.keys() == other.motions.keys()
            for number, T_new_old in one.motions.items():
                np.testing.assert_array_equal(T_new_old, other.motions[number])

    def test_backend_keeps_stored_map(self) -> None:
        backend = self.plugin()
        backend.resume()
        for change in changes_of(backend, RoomMap()):
            assert 0 not in change.hidden, "the stored map is hidden"
            assert 0 not in change.motions, "the stored map moves"

    def test_backend_without_frames_changes_nothing(self) -> None:
        assert self.plugin().finish(RoomMap()) is None

    def test_backend_graph_has_all_submaps(self) -> None:
        backend = self.plugin()
        submaps = {0} | {change.submap for change in changes_of(backend, RoomMap())}
        graph = backend.graph()
        if graph is not None:
            assert len(graph.anchors) == len(submaps)


def changes_of(backend: BackEnd, scene: RoomMap, wrong_truth: bool = False) -> Iterator[SubmapChange]:
    """Yield the changes of a back end while the camera drifts 12 m away from the room and returns to it.

    Args:
        backend: The back end.
        scene: The map, which does not change.
        wrong_truth: Pass frames with wrong ground truth.
    """
    T_drifted_true = np.eye(4)
    for index in range(48):
        k = min(index, 48 - index)
        T_drifted_true[0, 3] = k / 2
        frame = replace(frame_at(k), index=index, timestamp=index / RATE)
        seen = misleading(frame) if wrong_truth else frame
        change = backend.update(seen, Pose(T_drifted_true @ pose_at(k)), scene)
        if change is not None:
            yield change
    change = backend.finish(scene)
    if change is not None:
        yield change


def fused(fuser: MapFuser, frames: int = 5) -> MapFuser:
    """Fuse the first frames of the corner room with exact clusters and poses, and return the fuser."""
    for k in range(frames):
        frame = frame_at(k)
        fuser.fuse(frame, Pose(pose_at(k)), exact_clusters(frame))
    return fuser


def nothing_in(frame: Frame, pose: Pose) -> PointClusters:
    """Return the point clusters of a frame without detections."""
    return lift(Detections.none(CAMERA.shape, CLASSES), frame, pose)


def same(a: Any, b: Any) -> bool:
    """Return True if two data objects of the pipeline contain equal arrays."""
    pairs = [(getattr(a, field.name), getattr(b, field.name)) for field in fields(a)]
    return all(same(x, y) if is_dataclass(x) else np.array_equal(x, y) for x, y in pairs)


def assert_data_error(call: Callable[[], object], words: str) -> None:
    """Assert that `call` raises a one-line DataError that contains `words`."""
    try:
        call()
    except DataError as error:
        assert words in str(error), f"{str(error)!r} does not contain {words!r}"
        assert "\n" not in str(error)
    else:
        raise AssertionError(f"expected a DataError with {words!r}, got no error")
