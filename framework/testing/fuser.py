"""The contract of a fuser and of the map that it builds."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Detections, Frame, PointClusters, Pose
from framework.interfaces import MapFuser
from framework.refinement.lifting import lift
from framework.testing.assertions import refused
from framework.testing.corner_room import CAMERA, CLASSES, exact_clusters, frame_at, pose_at


class FuserContract:
    """What every fuser keeps."""

    stage = "fuser"

    def plugin(self) -> MapFuser:
        raise NotImplementedError("the fuser that is tested")

    def test_fuser_starts_with_an_empty_map(self) -> None:
        scene = self.plugin().scene
        view = scene.render(CAMERA, np.eye(4))
        assert not view.depth.any()
        assert not view.instance_ids.any()
        assert (view.class_ids == -1).all()
        assert len(scene.mesh().vertices) == 0
        assert not scene.instances()
        assert not scene.instance_ids()

    def test_fuser_maps_what_it_saw(self) -> None:
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

    def test_fusers_instances_are_those_of_its_mesh(self) -> None:
        scene = fused(self.plugin()).scene
        mesh, instances = scene.mesh(), scene.instances()
        assert scene.instance_ids() == set(instances)
        assert mesh.triangles.max(initial=-1) < len(mesh.vertices)
        assert instances, "two spheres, each seen whole in five frames"
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

    def test_fuser_takes_a_frame_without_detections_or_depth(self) -> None:
        fuser = self.plugin()
        frame, pose = frame_at(0), Pose(pose_at(0))
        fuser.fuse(frame, pose, nothing_in(frame, pose))
        blind = replace(frame_at(1), depth=np.zeros(CAMERA.shape, np.float32))
        fuser.fuse(blind, pose, nothing_in(blind, pose))
        assert not fuser.scene.instances()

    def test_fuser_maps_the_depths_that_it_says(self) -> None:
        fuser = self.plugin()
        nearest, farthest = fuser.scene.depth_range
        frame, pose = frame_at(0), Pose(pose_at(0))
        nothing = nothing_in(frame, pose)
        for depth in [0.99 * nearest] + [1.01 * farthest] * bool(np.isfinite(farthest)):
            fuser.fuse(replace(frame, depth=np.full(CAMERA.shape, depth, np.float32)), pose, nothing)
        assert not len(fuser.scene.mesh().vertices)
        fuser.fuse(replace(frame, depth=np.full(CAMERA.shape, nearest + 0.1, np.float32)), pose, nothing)
        assert len(fuser.scene.mesh().vertices)

    def test_fusers_map_is_seen_by_cameras_from_poses_only(self) -> None:
        scene, pose, depth = self.plugin().scene, pose_at(0), np.ones(CAMERA.shape, np.float32)
        no_poses: list[Any] = [2 * pose, pose[:3], pose.tolist(), np.full((4, 4), np.nan), None]
        for no_pose in no_poses:
            refused(partial(scene.render, CAMERA, no_pose), "T_world_camera")
            refused(partial(scene.render_near, CAMERA, no_pose, depth), "T_world_camera")
        no_camera: Any = CAMERA.K
        refused(partial(scene.render, no_camera, pose), "camera must be a Camera, found ndarray")

    def test_fusers_map_survives_saving(self, tmp_path: Path) -> None:
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

    def test_fusers_map_refuses_a_damaged_file(self, tmp_path: Path) -> None:
        fuser = self.plugin()
        path = tmp_path / "map.npz"
        fused(fuser, frames=1).scene.save(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        refused(lambda: type(fuser.scene).load(path), "map.npz")


def fused(fuser: MapFuser, frames: int = 5) -> MapFuser:
    """The fuser, once it has seen so many frames of the room."""
    for k in range(frames):
        frame = frame_at(k)
        fuser.fuse(frame, Pose(pose_at(k)), exact_clusters(frame))
    return fuser


def nothing_in(frame: Frame, pose: Pose) -> PointClusters:
    return lift(Detections.none(CAMERA.shape, CLASSES), frame, pose)
