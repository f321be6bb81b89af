"""Off-the-shelf baseline: Open3D's VoxelBlockGrid with a majority vote per voxel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, Int32, PointClusters, Pose
from framework.interfaces import MapFuser, StageTimer, untimed
from framework.mapping.instances.association import Association
from framework.mapping.instances.instance_list import Confirmation
from framework.mapping.labels.label_rule import floored_log
from framework.mapping.voxels.tsdf_volume import Tsdf

if TYPE_CHECKING:
    from framework.baselines.open3d_map import Open3DMap


@dataclass
class Open3DVoxelBlockGrid(MapFuser):
    """TSDF of Open3D with a majority vote for the instance of each voxel.

    The class distribution of an instance is the product of the distributions of its detections.
    """

    tsdf: Tsdf = field(default_factory=Tsdf)
    association: Association = field(default_factory=Association)
    confirmation: Confirmation = field(default_factory=Confirmation)
    # number of voxels per block side, in [2, 64]; with 16, the default of Open3D, the map has twice as many voxels
    block_resolution: int = 8
    # maximum number of blocks, > 0; each needs 14 KiB; at the maximum, copying the map needs up to 5.7 GB
    max_blocks: int = 200_000
    min_weight: float = 1.0  # minimum number of observations of a surface voxel, >= 1; Open3D's default is 3
    class_floor: float = 0.1  # weight of the uniform distribution in a class measurement, in [1e-6, 0.999]

    def __post_init__(self) -> None:
        from framework.baselines.open3d_grid import BlockGridSettings
        from framework.baselines.open3d_map import Open3DMap

        check_bounds(self, class_floor=(1e-6, 0.999))
        settings = BlockGridSettings(
            voxel_size=self.tsdf.voxel_size,
            block_resolution=self.block_resolution,
            truncation=self.tsdf.truncation,
            min_depth=self.tsdf.min_depth,
            max_depth=self.tsdf.max_depth,
            max_blocks=self.max_blocks,
            min_weight=self.min_weight,
        )
        self.scene: Open3DMap = Open3DMap(settings, self.confirmation)

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        self.scene.begin(clusters.classes)
        with timer("association"):
            _, matches = self.association.match(self.scene, frame, pose, clusters)
        with timer("integration"):
            self.scene.integrate(frame, pose.T_world_camera)
        with timer("update"):
            seen_ids = _paint(clusters, matches.instance_ids, frame.depth.shape)
            self.scene.vote(frame, pose.T_world_camera, seen_ids, self.tsdf.label_band)
            class_evidence = floored_log(clusters.class_probabilities, self.class_floor)
            self.association.observe(self.scene.table, matches, class_evidence)
        with timer("association"):
            self.association.merge(self.scene, matches)
            self.association.expire(self.scene)


def _paint(clusters: PointClusters, instance_ids: Int32, shape: tuple[int, int]) -> Int32:
    """Return the instance (H, W) at each pixel, 0 = none, from the cluster with the highest score."""
    image = np.zeros(shape, np.int32)
    for k in np.argsort(clusters.scores, kind="stable"):
        if instance_ids[k]:
            u, v = clusters.pixels[clusters.cluster == k].T
            image[v, u] = instance_ids[k]
    return image
