"""The corner room as a video with configurable errors, and minimal plugins that map the room."""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from framework.data import (
    Box,
    Camera,
    Detections,
    Frame,
    Instance,
    InstanceMesh,
    PointClusters,
    Pose,
    SceneTruth,
    View,
)
from framework.errors import DataError, FrameError, MapFullError
from framework.files.atomic_write import atomic_write
from framework.geometry import back_project, transform
from framework.interfaces import (
    ClusterRefiner,
    Detector,
    FrameReader,
    LiveVideo,
    MapFuser,
    MapStatistics,
    PoseTracker,
    RGBDSequence,
    SceneMap,
    StageTimer,
    untimed,
)
from framework.testing.corner_room import CAMERA, CLASSES, frame_at, look, pose_at, spheres_in


@dataclass
class CornerRoom(RGBDSequence):
    """The corner room as a sequence with configurable errors."""

    frames: int = 6  # number of frames
    unreadable: int = -1  # index of the frame that raises FrameError; -1 = none
    truth: bool = True  # ground-truth poses and instances
    unposed: tuple[int, ...] = ()  # indices of the frames without a ground-truth pose
    slow_s: float = 0.0  # time to read a frame, s
    scene: str = ""  # sequence name, without effect on the room
    start: int = 0  # index of the first frame
    stop: int = -1  # index after the last frame; -1 = all frames
    stride: int = 1  # step between frames; 1 = every frame

    def __post_init__(self) -> None:
        self.camera, self.name = CAMERA, "corner_room"
        self._chosen = range(self.frames)[self.start : None if self.stop < 0 else self.stop : self.stride]

    def __len__(self) -> int:
        return len(self._chosen)

    def __getitem__(self, k: int) -> Frame:
        index = self._chosen[k]
        time.sleep(self.slow_s)
        if index == self.unreadable:
            raise FrameError(f"frame {index}: depth/{index:06d}.png is truncated")
        frame = frame_at(index, self.truth)
        return replace(frame, T_world_camera=None) if index in self.unposed else frame

    def scene_truth(self) -> SceneTruth | None:
        if not self.truth:
            return None
        depth, _, _, ids = look(CAMERA, pose_at(0))
        v, u = np.nonzero(depth > 0)
        points = back_project(CAMERA, np.stack([u, v], 1).astype(np.int32), depth[v, u])
        return SceneTruth(points, ids[v, u], dict(enumerate(CLASSES, start=1)))


@dataclass
class LiveRoom(LiveVideo):
    """The corner room as live video, with ground-truth poses."""

    frames_sent: int = 6  # number of frames that are sent
    period_s: float = -1.0  # time between frames, s; -1 = a frame is sent after the previous one has been read
    unreadable: int = -1  # index of the frame that raises FrameError; -1 = none
    fails_after: int = -1  # number of frames before the source fails; -1 = never

    def __post_init__(self) -> None:
        self.name = "live_room"
        self.room = CornerRoom(frames=self.frames_sent, unreadable=self.unreadable)
        self.sent = self.read = 0
        self.closed = False

    def has_poses(self) -> bool:
        return True

    def frames(self) -> Generator[FrameReader | None]:
        try:
            yield None
            for k in range(self.frames_sent):
                if k == self.fails_after:
                    raise DataError("live_room: expected a connected camera, got none")
                due = time.monotonic() + self.period_s
                while time.monotonic() < due or (self.period_s < 0 and self.read < k):
                    time.sleep(0.001)
                    yield None
                self.sent += 1
                yield partial(self._read, k, time.time())
        finally:
            self.closed = True

    def _read(self, k: int, timestamp: float) -> Frame:
        self.read += 1
        return replace(self.room[k], timestamp=timestamp)


@dataclass
class SphereDetector(Detector):
    """Detector of both spheres with exact masks. Concurrent calls are supported."""

    concurrent = True
    broken_at: int = -1  # index of the frame that raises FrameError; -1 = none
    unused_classes: int = 0  # number of classes without objects, before the classes of the spheres

    def __post_init__(self) -> None:
        self.classes = (*(f"unused {k}" for k in range(self.unused_classes)), *CLASSES)

    def detect(self, frame: Frame) -> Detections:
        if frame.index == self.broken_at:
            raise FrameError(f"frame {frame.index}: expected a usable frame, got an unusable one")
        found = spheres_in(frame)
        padded = np.pad(found.class_probabilities, ((0, 0), (self.unused_classes, 0)))
        return replace(found, class_probabilities=padded, classes=self.classes)


@dataclass
class GivenPose(PoseTracker):
    """Tracker that returns the ground-truth pose. Frames in [lost_from, lost_to) are lost."""

    pose_source = "ground_truth"
    lost_from: int = 0  # index of the first lost frame
    lost_to: int = 0  # index after the last lost frame

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        if frame.T_world_camera is None:
            raise DataError(
                f"frame {frame.index}: expected a ground-truth pose, got none; use a tracker that estimates poses"
            )
        lost = self.lost_from <= frame.index < self.lost_to
        return Pose(frame.T_world_camera, lost, "too few points associate" if lost else "")


@dataclass
class KeepAll(ClusterRefiner):
    """Refiner that keeps all points."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return clusters


@dataclass
class GridMap(SceneMap):
    """Map with a separate triangle grid for each fused frame."""

    vertices: list[np.ndarray] = field(default_factory=list)
    colors: list[np.ndarray] = field(default_factory=list)
    ids: list[np.ndarray] = field(default_factory=list)
    triangles: list[np.ndarray] = field(default_factory=list)
    classes: tuple[str, ...] = CLASSES
    slow_save_s: float = 0.0

    @property
    def statistics(self) -> MapStatistics:
        voxels = sum(map(len, self.vertices))
        return MapStatistics(voxels, bytes=28 * voxels)

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> View:
        depth, normals, color, ids = look(camera, T_world_camera)  # like in a perfect map
        return View(camera, T_world_camera, depth, normals.astype(np.float32), color, ids, ids - 1)

    def mesh(self) -> InstanceMesh:
        ids = np.concatenate([np.zeros(0, np.int32), *self.ids])
        return InstanceMesh(
            vertices=np.concatenate([np.zeros((0, 3), np.float32), *self.vertices]),
            triangles=np.concatenate([np.zeros((0, 3), np.int32), *self.triangles]),
            colors=np.concatenate([np.zeros((0, 3), np.uint8), *self.colors]),
            instance_ids=ids,
            class_ids=ids - 1,
            classes=self.classes,
        )

    def instances(self) -> Mapping[int, Instance]:
        mesh = self.mesh()
        found = {}
        for key in np.unique(mesh.instance_ids[mesh.instance_ids > 0]).tolist():
            vertices = np.flatnonzero(mesh.instance_ids == key).astype(np.int32)
            points = mesh.vertices[vertices].astype(np.float64)
            low, high = points.min(0), points.max(0)
            box = Box((low + high) / 2, high - low, np.eye(3))
            sure = np.array([0.9, 0.1] if key == 1 else [0.2, 0.8], np.float32)
            found[key] = Instance(key, sure, float(sure.max()), len(self.vertices), 0, 0, vertices, box, box)
        return found

    def save(self, path: Path | str) -> None:
        mesh = self.mesh()
        with atomic_write(path) as temporary:
            np.savez(
                temporary,
                vertices=mesh.vertices,
                triangles=mesh.triangles,
                colors=mesh.colors,
                ids=mesh.instance_ids,
            )
            time.sleep(self.slow_save_s)

    @classmethod
    def load(cls, path: Path | str) -> GridMap:
        with np.load(path) as saved:
            return cls([saved["vertices"]], [saved["colors"]], [saved["ids"]], [saved["triangles"]])


@dataclass
class GridFuser(MapFuser):
    """Fuser that appends each frame to the map. Cluster k is instance k + 1."""

    capacity: int = 100  # maximum number of frames in the map
    slow_s: float = 0.0  # time to fuse a frame, s
    slow_save_s: float = 0.0  # time to save the map, s
    note: str = ""  # path of a file that is created after the first fused frame; "" = none

    def __post_init__(self) -> None:
        self.scene: GridMap = GridMap(slow_save_s=self.slow_save_s)

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        time.sleep(self.slow_s)
        scene = self.scene
        if len(scene.vertices) >= self.capacity:
            raise MapFullError(
                f"fuser.capacity: expected at most {self.capacity} frames, got more; increase fuser.capacity"
            )
        height, width = frame.camera.shape
        v, u = np.divmod(np.arange(height * width), width)
        points = back_project(frame.camera, np.stack([u, v], 1).astype(np.int32), frame.depth.ravel())
        ids = np.zeros((height, width), np.int32)
        ids[clusters.pixels[:, 1], clusters.pixels[:, 0]] = clusters.cluster + 1
        corner = (np.arange(height - 1)[:, None] * width + np.arange(width - 1)).ravel()
        below = corner + width
        triangles = np.concatenate(
            [np.stack([corner, below, corner + 1], 1), np.stack([corner + 1, below, below + 1], 1)]
        )
        scene.triangles.append((triangles + scene.statistics.voxels).astype(np.int32))
        scene.vertices.append(np.asarray(transform(pose.T_world_camera, points), np.float32))
        scene.colors.append(frame.color.reshape(-1, 3))
        scene.ids.append(ids.ravel())
        if self.note:
            Path(self.note).touch()


def fault(kind: str) -> BaseException:
    """Return the exception of this kind, as an example of a failing stage."""
    faults: dict[str, BaseException] = {
        "OSError": OSError(5, "Input/output error", "weights.bin"),
        "ValueError": ValueError("operands could not be broadcast together"),
        "MemoryError": MemoryError("Unable to allocate 40 GiB"),
        "SystemExit": SystemExit(7),
    }
    return faults[kind]


@dataclass
class FaultyDetector(SphereDetector):
    """Detector that raises an exception or returns invalid masks in one frame."""

    at: int = 3  # index of the frame at which the detector fails
    kind: str = "OSError"  # failure: OSError, ValueError, MemoryError, SystemExit or masks (invalid masks)

    def detect(self, frame: Frame) -> Detections:
        found = super().detect(frame)
        if frame.index != self.at:
            return found
        if self.kind == "masks":
            return Detections(
                found.masks[:, ::2], found.boxes, found.scores, found.class_probabilities, classes=found.classes
            )
        raise fault(self.kind)
