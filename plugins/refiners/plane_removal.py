"""Cluster refinement by removal of floors and walls."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.refine import keep_points
from framework.refinement.segmentation.planes import Planes, find_planes, off_planes, plane_image


@dataclass
class PlaneRemoval(ClusterRefiner):
    """Removal of points on the floor, a wall or another plane at the border of the scene.

    Planes are found in the depth of the whole frame. The gravity direction is not needed. A plane is structure if it is
    large (`min_area`, `min_frame_fraction`) and if few readings are behind it (`max_behind_ratio`). Table tops and
    screens have more readings behind them. A cluster keeps its points on a plane if they are more than
    `max_cluster_fraction` of the plane, e.g. for a table that fills the image. The planes are passed to later refiners
    as `structure`.
    """

    # maximum distance of a point from its plane, m, >= 0, in addition to 3 standard deviations of depth noise
    plane_distance: float = 0.01
    inverse_depth_noise: float = 0.003  # maximum RMS residual of a plane in inverse depth, 1/m, >= 0, for KINECT_V1
    min_area: float = 0.8  # minimum visible area of a plane, m^2, >= 0
    min_frame_fraction: float = 0.04  # minimum fraction of the frame's readings on a plane, in [0, 1]
    # maximum ratio of readings behind a plane to readings on the plane, >= 0; greater than 0 to allow for doorways
    max_behind_ratio: float = 0.1
    # maximum angle between the camera's up axis and the plane normal, degrees, in [0, 180]; 180 = any plane, 60 =
    # floors
    max_tilt: float = 180.0
    # maximum fraction of a plane's points that is removed from one cluster, in [0, 1]; above it, the cluster keeps them
    max_cluster_fraction: float = 0.5

    def __post_init__(self) -> None:
        check_bounds(
            self, plane_distance=(0.0, np.inf), inverse_depth_noise=(0.0, np.inf), min_area=(0.0, np.inf),
            min_frame_fraction=(0.0, 1.0), max_behind_ratio=(0.0, np.inf), max_tilt=(0.0, 180.0),
            max_cluster_fraction=(0.0, 1.0),
        )  # fmt: skip

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if len(clusters.cluster) == 0:
            return clusters
        planes = self.structure(frame)
        if len(planes) == 0:
            return clusters
        on_plane = plane_image(frame, planes, self.plane_distance)
        kept, structure = off_planes(clusters, on_plane, len(planes), self.max_cluster_fraction)
        return replace(keep_points(clusters, kept), structure=structure)

    def structure(self, frame: Frame) -> Planes:
        """Return the planes of the frame that are structure, such as floors and walls."""
        planes = find_planes(frame, self.plane_distance, self.inverse_depth_noise, self.min_area)
        upright = -planes.normals[:, 1] >= np.cos(np.deg2rad(self.max_tilt)) - 1e-9  # the camera y axis points down
        large = planes.fractions >= self.min_frame_fraction
        return planes.chosen(large & (planes.behind <= self.max_behind_ratio) & upright)
