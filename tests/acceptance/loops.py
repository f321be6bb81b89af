"""False and missed loops in buildings with identical rooms, with drift added to the true poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from framework.data import Float32, Float64, Frame, PointClusters, Pose
from framework.geometry import exp_se3, inverse, pose_distance, project, rotation_angle, transform
from framework.interfaces import SceneMap
from framework.mapping.labels.label_rule import LabeledVoxels
from framework.mapping.voxels.tsdf_volume import Tsdf, VoxelHashing
from framework.pose_graph.loop_detection import Loop
from framework.pose_graph.submap_anchors import DepthSamples, Submap
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
SAME_SURFACE = 0.1  # m, maximum depth difference of a point that two frames see
NOTHING = PointClusters(  # a frame without detections
    np.zeros((0, 3), np.float32), np.zeros((0, 2), np.int32), np.zeros(0, np.int32), np.zeros((0, 1), np.float32),
    np.zeros(0, np.float32), ("object",),
)  # fmt: skip


@dataclass(frozen=True)
class SeenFrame:
    """A frame without its images."""

    index: int
    T_true: Float64  # (4, 4) true pose
    submap: int
    T_anchor_camera: Float64  # (4, 4) pose with drift in its submap
    samples: DepthSamples
    points_camera: Float32  # (P, 3) the samples, m

    @classmethod
    def of(cls, frame: Frame, submap: int, T_anchor_camera: Float64) -> SeenFrame:
        assert frame.T_world_camera is not None
        samples = DepthSamples.of(frame)
        return cls(frame.index, frame.T_world_camera, submap, T_anchor_camera, samples, samples.points())

    def seen_in(self, others: Iterable[SeenFrame]) -> float:
        """Return the fraction of the points that are visible in at least one of the other frames."""
        visible = np.zeros(len(self.points_camera), np.bool_)
        for other in others:
            points = transform(inverse(other.T_true) @ self.T_true, self.points_camera)
            in_front = np.flatnonzero(points[:, 2] > 0.1)
            u, v = np.rint(project(other.samples.camera, points[in_front])).astype(int).T
            inside = (u >= 0) & (u < other.samples.camera.width) & (v >= 0) & (v < other.samples.camera.height)
            at = in_front[inside]
            visible[at] |= np.abs(other.samples.depth[v[inside], u[inside]] - points[at, 2]) < SAME_SURFACE
        return float(visible.mean()) if len(visible) else 0.0

    def in_hidden(self, frames: Sequence[SeenFrame], submaps: Sequence[Submap], scene: SceneMap) -> float:
        """Return the fraction of the readings on the surface of hidden submaps, as seen from the true pose.

        Args:
            frames: Frames of hidden submaps, at least one.
            submaps: All submaps.
            scene: The map.
        """
        nearest = min(frames, key=lambda one: pose_distance(one.T_true, self.T_true))
        T_world_nearest = submaps[nearest.submap].T_world_anchor @ nearest.T_anchor_camera
        T_world_camera = T_world_nearest @ inverse(nearest.T_true) @ self.T_true
        seeing = {one.submap for one in frames if self.seen_in([one]) > 0}
        depth, mapped = (
            self.samples.depth,
            scene.hidden_surfaces().render(self.samples.camera, T_world_camera, seeing).depth,
        )
        same = (mapped > 0) & (depth > 0) & (np.abs(mapped - depth) < SAME_SURFACE)
        return float(same.sum() / max(np.count_nonzero(depth), 1))


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
            assert frame.T_world_camera is not None
            if frames:
                T_world_camera = _drifted(T_world_camera, frames[-1].T_true, frame.T_world_camera, rng)
            else:
                T_world_camera = frame.T_world_camera
            submaps, submap = back_end.anchors.submaps, back_end.anchors.current
            T_anchor_camera = submaps[submap].local(T_world_camera) if submaps else np.eye(4)
            seen = SeenFrame.of(frame, submap, T_anchor_camera)
            hidden = [one for one in frames if submaps[one.submap].hidden]
            in_view.append(seen.seen_in(hidden) >= IN_VIEW and seen.in_hidden(hidden, submaps, fuser.scene) >= IN_VIEW)
            frames.append(seen)
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
