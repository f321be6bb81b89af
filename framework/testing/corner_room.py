"""A synthetic scene with exact ground truth, for contract tests.

The scene is a textured corner of a room, with two walls and a floor. It contains a chair and a couch, which are both
spheres. The world frame is the frame of the first camera: x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from framework.data import (
    Camera,
    Detections,
    Float32,
    Float64,
    Frame,
    FrameTruth,
    Instance,
    InstanceMesh,
    Int32,
    PointClusters,
    Pose,
    UInt8,
    View,
)
from framework.detection.masks.binary_masks import tight_boxes
from framework.errors import DataError
from framework.geometry import exp_se3, inverse
from framework.interfaces import MapStatistics, SceneMap, SubmapSurfaces
from framework.refinement.lifting import lift

CLASSES = ("chair", "couch")
CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
RATE = 30  # frame rate, Hz
PLANES = (((-1.0, 0.0, 0.0), 1.5), ((0.0, -1.0, 0.0), 1.0), ((0.0, 0.0, -1.0), 3.0))
"""Normal n, which points into the room, and offset d, m, of each plane n . p + d = 0."""

SPHERES = (((-0.5, 0.7, 2.2), 0.35), ((0.5, 0.6, 2.5), 0.45))  # centers and radii of instances 1 and 2, m


def look(camera: Camera, T_world_camera: Float64) -> tuple[Float32, Float64, UInt8, Int32]:
    """Render the room from a pose.

    Returns:
        Depth (H, W), m, world-frame normals (H, W, 3), color (H, W, 3) and instance ids (H, W). Without a visible
        surface, depth and color are 0. Instance 0 = no instance.
    """
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    d = rays @ T_world_camera[:3, :3].T
    o = T_world_camera[:3, 3]
    depth = np.full(u.shape, np.inf)
    normals = np.zeros((*u.shape, 3))
    ids = np.zeros(u.shape, np.int32)
    with np.errstate(divide="ignore", invalid="ignore"):
        for n, offset in PLANES:
            t = -(o @ np.array(n) + offset) / (d @ np.array(n))
            nearer = (t > 1e-3) & (t < depth)
            depth[nearer], normals[nearer] = t[nearer], n
        for k, (center, radius) in enumerate(SPHERES, start=1):
            b, a = d @ (o - center), (d**2).sum(-1)
            t = (-b - np.sqrt(b**2 - a * (((o - center) ** 2).sum() - radius**2))) / a
            nearer = (t > 1e-3) & (t < depth)
            depth[nearer], ids[nearer] = t[nearer], k
            normals[nearer] = ((o + t[..., None] * d - center) / radius)[nearer]
    seen = np.isfinite(depth)
    depth = np.where(seen, depth, 0)
    p = o + depth[..., None] * d
    waves = np.stack([np.sin(9 * p + 1.3 * k).sum(-1) + np.sin(23 * p[..., k] + k) for k in range(3)], axis=-1)
    color = np.where(seen[..., None], 128 + 28 * waves + 20 * (ids[..., None] - 1), 0)
    return depth.astype(np.float32), normals, np.clip(color, 0, 255).astype(np.uint8), ids


def pose_at(k: int) -> Float64:
    """Return the camera pose (4, 4) of frame k.

    The camera moves about 1 cm and 0.3 degrees per frame.
    """
    return exp_se3(np.array([0.010, -0.003, 0.006, 0.002, -0.005, 0.001]) * k)


def frame_at(k: int, truth: bool = True) -> Frame:
    """Return frame k of a moving camera.

    Args:
        k: Frame number.
        truth: Include the ground-truth pose and instances.
    """
    depth, _, color, ids = look(CAMERA, pose_at(k))
    if not truth:
        return Frame(k, k / RATE, color, depth, CAMERA)
    return Frame(k, k / RATE, color, depth, CAMERA, pose_at(k), FrameTruth(ids, dict(enumerate(CLASSES, start=1))))


def misleading(frame: Frame) -> Frame:
    """Return a frame with a wrong ground-truth pose, 10 cm and 6 degrees off, and exchanged instances.

    A plugin that does not depend on the ground truth has the same result for both frames.

    Raises:
        DataError: The frame has no ground truth.
    """
    if frame.T_world_camera is None or frame.truth is None:
        raise DataError(f"frame {frame.index}: expected ground truth, got none; pass frame_at(k, truth=True)")
    wrong = exp_se3(np.array([0.1, 0.0, 0.0, 0.0, 0.1, 0.0])) @ frame.T_world_camera
    ids = frame.truth.instance_ids
    exchanged = FrameTruth(np.where(ids > 0, len(CLASSES) + 1 - ids, 0).astype(np.int32), frame.truth.class_names)
    return replace(frame, T_world_camera=wrong, truth=exchanged)


def spheres_in(frame: Frame) -> Detections:
    """Return the ground-truth masks of both spheres as detections.

    Raises:
        DataError: The frame has no ground-truth instances.
    """
    if frame.truth is None:
        raise DataError(f"frame {frame.index}: expected ground-truth instances, got none; choose another detector")
    masks = frame.truth.instance_ids == np.array([1, 2], np.int32)[:, None, None]
    sure = np.array([[0.9, 0.1], [0.2, 0.8]], np.float32)
    return Detections(masks, tight_boxes(masks), sure.max(1), sure, CLASSES)


def exact_clusters(frame: Frame) -> PointClusters:
    """Return the point clusters of both spheres, lifted with exact masks and the exact pose."""
    return lift(spheres_in(frame), frame, Pose(pose_at(frame.index)))


def bleeding_clusters(frame: Frame) -> PointClusters:
    """Return the point clusters of both spheres, lifted with masks that extend 3 px to the right."""
    exact = spheres_in(frame)
    masks = exact.masks | np.roll(exact.masks, 3, axis=2)
    return lift(replace(exact, masks=masks), frame, Pose(pose_at(frame.index)))


@dataclass(frozen=True)
class RoomMap(SceneMap):
    """Read-only map of the room with exact views, but without a mesh and instances."""

    classes: tuple[str, ...] = CLASSES
    T_world_room: Float64 = field(default_factory=lambda: np.eye(4))  # (4, 4) motion of the room

    @property
    def statistics(self) -> MapStatistics:
        return MapStatistics(voxels=1, bytes=1)

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        depth, normals, color, ids = look(camera, inverse(self.T_world_room) @ T_world_camera)
        normals_world = (normals @ self.T_world_room[:3, :3].T).astype(np.float32)
        return View(camera, T_world_camera, depth, normals_world, color, ids, ids - 1)

    def hidden_surfaces(self) -> SubmapSurfaces:
        return RoomSurfaces(self)

    def mesh(self) -> InstanceMesh:
        return InstanceMesh(
            vertices=np.zeros((0, 3), np.float32),
            triangles=np.zeros((0, 3), np.int32),
            colors=np.zeros((0, 3), np.uint8),
            instance_ids=np.zeros(0, np.int32),
            class_ids=np.zeros(0, np.int32),
            classes=self.classes,
        )

    def instances(self) -> Mapping[int, Instance]:
        return {}

    def save(self, path: Path | str) -> None:
        raise DataError("RoomMap.save: expected a map of a fuser, got the map of the contract tests")

    @classmethod
    def load(cls, path: Path | str) -> RoomMap:
        raise DataError("RoomMap.load: expected a map of a fuser, got the map of the contract tests")


@dataclass(frozen=True)
class RoomSurfaces(SubmapSurfaces):
    """Submaps that all contain the room."""

    room: RoomMap

    def render(
        self, camera: Camera, T_world_camera: Float64, submaps: Collection[int], depth: Float32 | None = None
    ) -> View:
        return self.room.render(camera, T_world_camera)
