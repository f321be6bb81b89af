"""Class-only baseline: class fusion in voxels, with connected components as instances."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.baselines.class_evidence import mask_classes
from framework.baselines.semantic_map import ABSENCE, AREA, SMOOTHNESS, Elections, SemanticMap
from framework.config.validation import check_bounds
from framework.data import Float64, Frame, PointClusters, Pose
from framework.interfaces import MapFuser, StageTimer, untimed
from framework.mapping.labels.pixel_lists import list_points_by_pixel
from framework.mapping.voxels.tsdf_volume import VoxelHashing


@dataclass
class ClassOnlyFusion(MapFuser):
    """Class fusion in voxels without data association.

    The baseline follows SemanticFusion (McCormac et al., 2017) and Pham et al. (WACV 2019). Each voxel has a
    distribution over the classes and the background. Instances are connected components of one class, so that two
    touching objects of one class become one instance.

    The original systems label every pixel. Here, a pixel gets the distribution of the mask with the highest score. A
    pixel outside all masks is evidence for the background. This evidence is limited by `absence_likelihood_ratio`,
    because the detector may have missed an object. The original systems regularize with a CRF. Here, `smoothness` is
    the weight of a Potts model over the mesh. It is off by default, because it did not improve AP50.
    """

    hashing: VoxelHashing = field(default_factory=VoxelHashing)
    min_area: float = 0.01  # minimum surface area of an instance in the mesh, m^2, >= 0; smaller instances are omitted
    class_floor: float = 0.1  # weight of the uniform distribution in a class measurement, in [1e-6, 0.999]
    # likelihood ratio for a pixel without a mask, P(no mask | any class) / P(no mask | background), in (0, 1]; 1 = no
    # evidence of absence
    absence_likelihood_ratio: float = 0.7
    smoothness: float = 0.0  # log-odds added per neighboring vertex of the same class, >= 0; 0 = no regularization

    def __post_init__(self) -> None:
        check_bounds(self, class_floor=(1e-6, 0.999), absence_likelihood_ratio=ABSENCE)
        check_bounds(self, min_area=AREA, smoothness=SMOOTHNESS)
        elections = Elections(self.absence_likelihood_ratio, self.min_area, self.smoothness)
        self.scene: SemanticMap = SemanticMap(self.hashing.new_volume(), elections)

    def renew_colors(self) -> None:
        self.scene.volume.renew_colors()

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        self.scene.begin(clusters.classes)
        with timer("update"):
            points = list_points_by_pixel(clusters, frame.depth.shape)
            masks = (
                mask_classes(self._log_ratio(clusters), clusters, points, frame.index) if clusters.detected else None
            )
        with timer("integration"):
            seen = self.scene.volume.integrate(frame, pose.T_world_camera, self.hashing.near)
        with timer("update"):
            self.scene.labels.update(seen, masks)

    def _log_ratio(self, clusters: PointClusters) -> Float64:
        """Return the log ratio (N, C) of each class to the background for a pixel inside each mask."""
        # A score is the probability of the best class, but the distribution excludes the background. Therefore, the
        # score divided by the largest entry is the probability of all classes together.
        p = clusters.class_probabilities.astype(np.float64)
        objects = np.minimum(clusters.scores[:, None] / p.max(axis=1, keepdims=True, initial=1e-6), 1.0)
        uniform = self.class_floor / (1 + p.shape[1])
        of_classes = (1 - self.class_floor) * objects * p + uniform
        of_background = (1 - self.class_floor) * (1 - objects) + uniform
        return np.asarray(np.log(of_classes / of_background))
