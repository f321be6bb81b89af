"""False and missed loops in buildings with identical rooms, with drift added to the true poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from framework.data import Camera, Float32, Float64, Frame, PointClusters, Pose
from framework.geometry import back_project, exp_se3, inverse, project, rotation_angle, transform
from framework.mapping.labels.label_rule import LabeledVoxels
from framework.mapping.voxels.tsdf_volume import Tsdf, VoxelHashing
from framework.pose_graph.loop_detection import Loop
from framework.synthetic.buildings.building_sequence import SyntheticBuilding
from plugins.backends.pose_graph import PoseGraph
from plugins.fusers.bayesian_tsdf import BayesianTsdf

BUILDINGS = 20
ROOMS = 6
STRIDE = 5  # frames between two frames that are used
DRIFT = (0.02, 0.004)  # m and rad, standard deviation of each coordinate of the drift after 1 m; 1 to 2% after 50 m
FALSE = (0.2, np.deg2rad(5))  # m and rad, errors above which a loop is false
VOXEL = 0.02  # m
CORRECTION_DELAY = 2  # frames, as long as 10 frames of the whole sequence
IN_VIEW = 0.3  # minimum fraction of the points of a frame that hidden submaps have seen
LENGTH = 1.0  # m, minimum length of a passage in which hidden submaps are in view
POINT_STEP = 32  # px, distance between the points that are compared
SAME_SURFACE = 0.1  # m, maximum depth difference of a point that two frames see
NOTHING = PointClusters(  # a frame without detections
    np.zeros((0, 3), np.float32), np.zeros((0, 2), np.int32), np.zeros(0, np.int32), np.zeros((0, 1), np.float32),
    np.zeros(0, np.float32), ("object",),
)  # fmt: skip


@dataclass(frozen=True)
class SeenFrame:
    """A frame whose images are reduced to few points."""

    index: int
    T_true: Float64  # (4, 4) true pose
    submap: int
    points_camera: Float32  # (P, 3) m
    camera: Camera  # of the reduced depth
    depth: Float32  # (h, w) m

    @classmethod
    def of(cls, frame: Frame, submap: int) -> SeenFrame:
        assert frame.T_world_camera is not None
        c, half = frame.camera, POINT_STEP // 2
        depth = frame.depth[half::POINT_STEP, half::POINT_STEP]
        fx, fy, cx, cy = (value / POINT_STEP for value in (c.fx, c.fy, c.cx - half, c.cy - half))
        camera = Camera(depth.shape[1], depth.shape[0], fx, fy, cx, cy)
        v, u = np.nonzero(depth)
        points = back_project(camera, np.stack([u, v], axis=1).astype(np.float32), depth[v, u])
        return cls(frame.index, frame.T_world_camera, submap, points, camera, depth)

    def seen_in(self, others: Iterable[SeenFrame]) -> float:
        """Return the fraction of the points that are visible in at least one of the other frames."""
        visible = np.zeros(len(self.points_camera), np.bool_)
        for other in others:
            points = transform(inverse(other.T_true) @ self.T_true, self.points_camera)
            in_front = np.flatnonzero(points[:, 2] > 0.1)
            u, v = np.rint(project(other.camera, points[in_front])).astype(int).T
            inside = (u >= 0) & (u < other.camera.width) & (v >= 0) & (v < other.camera.height)
            at = in_front[inside]
            visible[at] |= np.abs(other.depth[v[inside], u[inside]] - points[at, 2]) < SAME_SURFACE
        return float(visible.mean()) if len(visible) else 0.0


@dataclass(frozen=True)
class LoopCounts:
    """Loops in one building."""

    loops: int
    false: int
    revisits: int  # passages of at least LENGTH in which hidden submaps are in view, and shorter ones with a loop
    found: int  # revisits with a loop

    @classmethod
    def of(cls, seed: int) -> LoopCounts:
        """Map a building with drift, and return the counts."""
        sequence, rng = _sequence(seed), np.random.default_rng(seed)
        back_end = PoseGraph(correction_delay=CORRECTION_DELAY)
        fuser = BayesianTsdf(LabeledVoxels(VoxelHashing(Tsdf(voxel_size=VOXEL))))
        frames: list[SeenFrame] = []
        in_view = []
        T_world_camera = np.eye(4)
        for frame in sequence:
            submap = back_end.anchors.current
            frames.append(SeenFrame.of(frame, submap))
            if len(frames) > 1:
                T_world_camera = _drifted(T_world_camera, *(one.T_true for one in frames[-2:]), rng)
            else:
                T_world_camera = frames[0].T_true
            hidden = {one.number for one in back_end.anchors.hidden()}
            in_view.append(frames[-1].seen_in(one for one in frames if one.submap in hidden) >= IN_VIEW)
            fuser.fuse(frame, Pose(T_world_camera), NOTHING)
            change = back_end.update(frame, Pose(T_world_camera), fuser.scene)
            if change is not None:
                fuser.correct(change)
                T_world_camera = change.moved(submap, T_world_camera)
        number = {frame.index: k for k, frame in enumerate(frames)}
        false = [
            loop
            for loop in back_end.loops
            if is_false(loop, frames[number[loop.earlier_frame]], frames[number[loop.frame]])
        ]
        looped = {number[loop.frame] for loop in back_end.loops}
        revisits = [k for k in passages(in_view) if looped & {*k} or length(frames, k) >= LENGTH]
        return cls(len(back_end.loops), len(false), len(revisits), sum(bool(looped & {*k}) for k in revisits))


def _sequence(seed: int) -> SyntheticBuilding:
    """Return every STRIDE-th frame of the tour of a building with identical rooms."""
    tour = SyntheticBuilding(seed=seed, rooms=ROOMS, designs=1).tour
    return SyntheticBuilding(seed=seed, rooms=ROOMS, designs=1, frames=tour.frames, stride=STRIDE)


def _drifted(T_world_last: Float64, T_true_last: Float64, T_true: Float64, rng: np.random.Generator) -> Float64:
    """Return the next pose (4, 4), with more drift."""
    T_last_next = inverse(T_true_last) @ T_true
    deviations = np.repeat(DRIFT, 3) * np.sqrt(np.linalg.norm(T_last_next[:3, 3]))
    return T_world_last @ T_last_next @ exp_se3(rng.normal(0, deviations))


def is_false(loop: Loop, earlier: SeenFrame, later: SeenFrame) -> bool:
    """Return True if the measured motion between two frames is wrong."""
    error = inverse(inverse(earlier.T_true) @ later.T_true) @ loop.T_earlier_camera
    return bool(np.linalg.norm(error[:3, 3]) > FALSE[0] or rotation_angle(error[:3, :3]) > FALSE[1])


def passages(in_view: Sequence[bool]) -> Iterator[range]:
    """Yield the ranges of consecutive frames in which hidden submaps are in view."""
    edges = np.flatnonzero(np.diff([False, *in_view, False]))
    yield from (range(begin, end) for begin, end in edges.reshape(-1, 2))


def length(frames: Sequence[SeenFrame], numbers: range) -> float:
    """Return the length of the path of consecutive frames, m."""
    positions = np.array([frames[k].T_true[:3, 3] for k in numbers])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


@cache
def counted_loops() -> list[LoopCounts]:
    """Return the counts of all buildings, which take about a minute each, and print them."""
    counts = []
    for seed in range(BUILDINGS):
        counts.append(LoopCounts.of(seed))
        print(seed, counts[-1], flush=True)
    return counts


if __name__ == "__main__":
    counted_loops()
