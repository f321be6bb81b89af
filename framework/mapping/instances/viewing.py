"""Statistics of the views of an instance, for its calibrated probabilities."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from framework.data import Float64

NEW_ANGLE = math.radians(10.0)  # change of the viewing direction between two views, rad
NEW_RATIO = 1.25  # ratio of the viewing distances of two views

Point = tuple[float, float, float]


@dataclass
class Viewing:
    """Sums over the frames in which an instance is in view. Each frame takes constant time.

    Errors of a detector in similar frames are correlated. Therefore, the frames are also counted as *views*: a frame is
    a new view if the viewing direction changed by NEW_ANGLE or the distance by NEW_RATIO since the last new view.
    """

    views: int = 0  # number of views
    outlines: int = 0  # number of detections of the instance while it was visible in the map
    outline_sum: float = 0.0  # sum of the IoUs of detection and visible instance in these detections
    centered: int = 0  # number of detections with points
    center_sum: Point = (0.0, 0.0, 0.0)  # sum of the centers of these detections, m
    camera: Point | None = None  # camera center at the last new view, m; None = no view

    @property
    def outline(self) -> float | None:
        """Mean IoU of a detection and the visible instance, or None if unknown."""
        return self.outline_sum / self.outlines if self.outlines else None

    @property
    def center(self) -> Point | None:
        """Mean of the centers of the detections in the world frame, m, or None if unknown."""
        if not self.centered:
            return None
        x, y, z = self.center_sum
        return x / self.centered, y / self.centered, z / self.centered

    def detect(self, outline: float) -> None:
        """Add a detection, given its IoU with the visible instance, in pixels."""
        self.outlines += 1
        self.outline_sum += outline

    def locate(self, center: Point) -> None:
        """Add the center of a detection in the world frame, m."""
        self.centered += 1
        self.center_sum = _plus(self.center_sum, center)

    def see(self, camera: Point) -> None:
        """Add a frame with the instance in view, given the camera center in the world frame, m."""
        if self.camera is None or self._is_new(camera, self.camera):
            self.views += 1
            self.camera = camera

    def _is_new(self, camera: Point, last: Point) -> bool:
        """Return True if the instance is seen from another direction or distance than in the last new view."""
        center = self.center
        if center is None:
            return False
        distances = math.dist(camera, center), math.dist(last, center)
        near, far = min(distances), max(distances)
        if far > NEW_RATIO * near:
            return True
        cosine = (distances[0] ** 2 + distances[1] ** 2 - math.dist(camera, last) ** 2) / max(2 * near * far, 1e-12)
        return cosine < math.cos(NEW_ANGLE)

    def merge(self, other: Viewing) -> None:
        """Add the sums of another instance. Views of both count once."""
        self.views = max(self.views, other.views)
        self.outlines += other.outlines
        self.outline_sum += other.outline_sum
        self.centered += other.centered
        self.center_sum = _plus(self.center_sum, other.center_sum)
        self.camera = self.camera if other.camera is None else other.camera

    def moved(self, T_new_old: Float64) -> Viewing:
        """Return the sums in another world frame, given its transform (4, 4) from this world frame."""
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        camera = None if self.camera is None else _point(R @ np.array(self.camera) + t)
        return replace(self, center_sum=_point(R @ np.array(self.center_sum) + self.centered * t), camera=camera)


def _point(vector: Float64) -> Point:
    x, y, z = vector.tolist()
    return x, y, z


def _plus(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
