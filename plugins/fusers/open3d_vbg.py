"""The off-the-shelf fuser: Open3D's VoxelBlockGrid, whose voxels vote for an instance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float64, Frame, Int32, PointClusters, Pose
from framework.mapping.association import PixelLists
from framework.mapping.instance_fuser import InstanceFuser, floored_log
from framework.parameters import check_bounds
from framework.rivals.open3d_grid import BlockGridSettings
from framework.rivals.open3d_map import Open3DMap


@dataclass
class Open3DVoxelBlockGrid(InstanceFuser):
    """Open3D's TSDF; a voxel keeps the instance that most frames gave it, an instance the product of its classes."""

    block_resolution: int = 8  # voxels a side, 2 to 64: 16, Open3D's, takes twice the voxels and half as long again
    max_blocks: int = 200_000  # blocks, > 0: 14 KiB each, and Open3D copies the map to make room: 5.7 GB at its end
    min_weight: float = 1.0  # frames, >= 1, that must have seen a voxel: Open3D's 3 loses what is seen briefly
    class_floor: float = 0.1  # in (0, 1): share of the uniform distribution mixed into a measured one

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(
            self,
            block_resolution=(2, 64),
            max_blocks=(1, 2**31 // 512),
            min_weight=(1.0, 1e6),
            class_floor=(1e-6, 0.999),
        )
        settings = BlockGridSettings(
            voxel_size=self.voxel_size,
            block_resolution=self.block_resolution,
            truncation=self.truncation,
            min_depth=self.min_depth,
            max_depth=self.max_depth,
            max_blocks=self.max_blocks,
            min_weight=self.min_weight,
        )
        self.scene: Open3DMap = Open3DMap(settings, self.confirmation)

    def class_evidence(self, clusters: PointClusters) -> Float64:
        return floored_log(clusters.class_probabilities, self.class_floor)

    def integrate(
        self, frame: Frame, pose: Pose, clusters: PointClusters, points: PixelLists, instance_ids: Int32
    ) -> None:
        self.scene.integrate(frame, pose.T_world_camera)
        seen_ids = _paint(clusters, instance_ids, frame.depth.shape)
        self.scene.vote(frame, pose.T_world_camera, seen_ids, self.label_band)


def _paint(clusters: PointClusters, instance_ids: Int32, shape: tuple[int, int]) -> Int32:
    """(H, W) the instance seen at each pixel, 0 = none; under overlapping clusters that of the best score."""
    image = np.zeros(shape, np.int32)
    for k in np.argsort(clusters.scores, kind="stable"):
        if instance_ids[k]:
            u, v = clusters.pixels[clusters.cluster == k].T
            image[v, u] = instance_ids[k]
    return image
