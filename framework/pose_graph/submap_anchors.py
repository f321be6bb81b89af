"""Division of the trajectory into submaps.

A submap begins where the camera is far from the anchor of the current one. It is hidden where the camera is far from
all views of it. The camera enters a visible submap again instead of beginning another one, so that the number of
submaps depends on the size of the place, not on the duration of the run. Submaps are rigid, and only their anchors
move, as in Voxgraph (Reijgwart et al., 2020) and Panoptic Multi-TSDFs (Schmid et al., 2022).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds, require
from framework.data import Camera, Float32, Float64, Frame
from framework.geometry import back_project, inverse, project, sampled_camera, transform
from framework.tracking.keyframes import Keyframe

VIEW_DISTANCE = 0.5  # m, distance between two views of equal direction
VIEW_ANGLE = 0.5  # rad, angle between two views at one position
CELLS = 16  # number of depth samples along the longer image side
MIN_DEPTH = 0.1  # m, minimum depth of a point in view
ENTERED_COVERAGE = 0.25  # minimum coverage of a frame by a submap that is entered again; it may be behind a wall
NEAR_DEPTH = 0.1  # maximum depth difference of near points, fraction of the depth


def view_separation(views: Float64, T_a_camera: Float64) -> Float64:
    """Return the separation (V,) of views (V, 4, 4) from a camera pose (4, 4), 1 = far enough for a new view."""
    distances = np.linalg.norm(views[:, :3, 3] - T_a_camera[:3, 3], axis=1)
    cosines = (np.einsum("vij,ij->v", views[:, :3, :3], T_a_camera[:3, :3]) - 1) / 2
    return np.asarray(distances / VIEW_DISTANCE + np.arccos(np.clip(cosines, -1, 1)) / VIEW_ANGLE)


@dataclass(frozen=True)
class DepthSamples:
    """Few samples of a depth image, one for each cell of a grid."""

    camera: Camera  # whose pixels are the cells
    depth: Float32  # (h, w) m, 0 = no reading

    @classmethod
    def of(cls, frame: Frame) -> DepthSamples:
        """Return the samples of a frame."""
        step = -(-max(frame.camera.shape) // CELLS)
        return cls(sampled_camera(frame.camera, step), frame.depth[step // 2 :: step, step // 2 :: step])

    def points(self) -> Float32:
        """Return the sampled points (P, 3) in the camera frame, m."""
        v, u = np.nonzero(self.depth)
        return back_project(self.camera, np.stack([u, v], axis=1).astype(np.float32), self.depth[v, u])

    def coverage(self, points_camera: Float32, tolerance: float) -> float:
        """Return the fraction of the samples near one of the points (P, 3) in the camera frame, m.

        Args:
            points_camera: The points.
            tolerance: The maximum difference of the depths, m, in addition to NEAR_DEPTH.
        """
        points = points_camera[points_camera[:, 2] > MIN_DEPTH]
        u, v = np.rint(project(self.camera, points)).astype(np.int64).T
        inside = (u >= 0) & (u < self.camera.width) & (v >= 0) & (v < self.camera.height)
        u, v, z = u[inside], v[inside], points[inside, 2]
        near = (self.depth[v, u] > 0) & (np.abs(self.depth[v, u] - z) <= tolerance + NEAR_DEPTH * z)
        covered = np.zeros(self.depth.shape, np.bool_)
        covered[v[near], u[near]] = True
        return float(np.count_nonzero(covered)) / max(int(np.count_nonzero(self.depth)), 1)


@dataclass
class Submap:
    """A rigid part of the map. Views, points and keyframes are in the frame of its anchor."""

    number: int
    T_world_anchor: Float64  # (4, 4), as applied to the map
    views: Float64 = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (V, 4, 4) T_anchor_camera
    frames: list[int] = field(default_factory=list)  # Frame.index of each view
    points: Float32 = field(default_factory=lambda: np.zeros((0, 3), np.float32))  # (P, 3) few points of each view, m
    keyframes: list[Keyframe] = field(default_factory=list)  # the views with enough features
    hidden: bool = False  # True = invisible to the tracker and the fuser
    stored: bool = False  # True = a stored map, which has no views and is never hidden

    def local(self, T_world_camera: Float64) -> Float64:
        """Return a camera pose (4, 4) in the frame of the anchor."""
        return inverse(self.T_world_anchor) @ T_world_camera

    def distance(self, T_world_camera: Float64) -> float:
        """Return the distance of a camera from the nearest view, m."""
        position = self.local(T_world_camera)[:3, 3]
        return float(np.linalg.norm(self.views[:, :3, 3] - position, axis=1).min())

    def nearest_view(self, T_anchor_camera: Float64) -> int:
        """Return the number of the nearest view of a camera pose (4, 4)."""
        return int(view_separation(self.views, T_anchor_camera).argmin())

    def add_view(self, frame: Frame, T_world_camera: Float64) -> bool:
        """Add a frame at T_world_camera (4, 4) to the views, and return True if its view is new."""
        T_anchor_camera = self.local(T_world_camera)
        if (view_separation(self.views, T_anchor_camera) < 1).any():
            return False
        points = transform(T_anchor_camera, DepthSamples.of(frame).points())
        self.points = np.concatenate([self.points, np.asarray(points, np.float32)])
        self.views = np.concatenate([self.views, T_anchor_camera[None]])
        self.frames.append(frame.index)
        return True

    def coverage(self, samples: DepthSamples, T_anchor_camera: Float64, tolerance: float) -> float:
        """Return the fraction of the depth samples of a view that are near the points of the submap.

        Args:
            samples: The depth samples.
            T_anchor_camera: The pose (4, 4) of the view.
            tolerance: The maximum difference of the depths, m, as the pose is inaccurate.
        """
        return samples.coverage(np.asarray(transform(inverse(T_anchor_camera), self.points), np.float32), tolerance)


@dataclass
class SubmapAnchors:
    """The submaps of a trajectory. Each begins at its anchor, the pose of its first view."""

    begin_distance: float = 2.5  # distance from its anchor at which the current submap ends, m, in [0.5, 100]
    # distance from all views of a submap at which it is hidden, m, > begin_distance; more than the range of the sensor
    hide_distance: float = 6.0

    def __post_init__(self) -> None:
        check_bounds(self, begin_distance=(0.5, 100.0), hide_distance=(0.5, 1000.0))
        require(
            self.hide_distance > self.begin_distance,
            "backend.hide_distance", self.hide_distance, f"more than begin_distance ({self.begin_distance:g})",
        )  # fmt: skip
        self.submaps: list[Submap] = []
        self.current = 0  # number of the current submap

    def resume(self) -> None:
        """Begin with a stored map as submap 0."""
        self.submaps.append(Submap(0, np.eye(4), stored=True))

    def divide(self, frame: Frame, T_world_camera: Float64) -> bool:
        """Begin a submap, or enter a visible one again, if the camera has left the current one.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).

        Returns:
            True if the camera has left the current submap, or if there was none.
        """
        here = T_world_camera[:3, 3]
        distances = {one.number: float(np.linalg.norm(one.T_world_anchor[:3, 3] - here)) for one in self.visible()}
        if distances:
            if distances.get(self.current, np.inf) <= self.begin_distance:
                return False
            samples = DepthSamples.of(frame)
            for number in sorted(distances, key=distances.__getitem__):
                submap = self.submaps[number]
                if distances[number] <= self.begin_distance and (
                    submap.coverage(samples, submap.local(T_world_camera), 0) >= ENTERED_COVERAGE
                ):
                    self.current = number
                    return True
        self.current = len(self.submaps)
        self.submaps.append(Submap(self.current, T_world_camera.copy()))
        self.submaps[-1].add_view(frame, T_world_camera)
        return True

    def visible(self) -> list[Submap]:
        """Return the visible submaps of this run in order."""
        return [submap for submap in self.submaps if not (submap.hidden or submap.stored)]

    def hidden(self) -> list[Submap]:
        """Return the hidden submaps in order."""
        return [submap for submap in self.submaps if submap.hidden]

    def hide_distant(self, T_world_camera: Float64) -> frozenset[int]:
        """Hide the visible submaps that are far away, and return their numbers."""
        distant = [one for one in self.visible() if one.distance(T_world_camera) > self.hide_distance]
        for submap in distant:
            submap.hidden = True
        return frozenset(submap.number for submap in distant)
