"""A detector by color, and a refiner by depth."""

from dataclasses import dataclass

import cv2
import numpy as np

from instancemap import ClusterRefiner, Detections, Detector, Frame, PointClusters, keep_points


@dataclass
class SaturatedRegions(Detector):
    """Detection of connected regions of saturated color."""

    min_area: int = 200  # minimum area of a region, px

    def __post_init__(self) -> None:
        self.classes = ("chair", "couch")

    def detect(self, frame: Frame) -> Detections:
        saturation = cv2.cvtColor(frame.color, cv2.COLOR_RGB2HSV)[..., 1]
        count, regions, stats, _ = cv2.connectedComponentsWithStats((saturation > 80).astype(np.uint8))
        kept = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= self.min_area]
        if not kept:
            return Detections.none(frame.camera.shape, self.classes)
        x, y, width, height = stats[kept, :4].T.astype(np.float32)
        return Detections(
            masks=regions == np.array(kept)[:, None, None],
            boxes=np.stack([x, y, x + width - 1, y + height - 1], axis=1),
            scores=np.full(len(kept), 0.6, np.float32),
            class_probabilities=np.tile(np.float32([0.6, 0.4]), (len(kept), 1)),
            classes=self.classes,
        )


@dataclass
class NearestPoints(ClusterRefiner):
    """Selection of the points of each cluster that are nearer than a quantile of their depths."""

    quantile: float = 0.5  # quantile of the depths, in [0, 1]

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        u, v = clusters.pixels.T
        depth = frame.depth[v, u]
        kept = np.ones(len(depth), np.bool_)
        for k in range(len(clusters)):
            own = clusters.cluster == k
            if own.any():
                kept[own] = depth[own] <= np.quantile(depth[own], self.quantile)
        return keep_points(clusters, kept)
