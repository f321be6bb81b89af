"""The off-the-shelf fuser: Open3D's VoxelBlockGrid, whose voxels vote for an instance."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from framework.data import Float64, Frame, Int32, PointClusters, Pose
from framework.errors import DataError
from framework.geometry import back_project, transform
from framework.interfaces import MapFuser
from framework.mapping.association import (
    Overlaps,
    PixelLists,
    count_overlaps,
    cover_another,
    list_points_by_pixel,
    match_one_to_one,
)
from framework.mapping.open3d_map import BlockGridSettings, Open3DMap
from framework.parameters import check_bounds

VOTES_ACROSS = 320  # pixels of an image row that vote in association: more cost time and tell the same


@dataclass
class Open3DVoxelBlockGrid(MapFuser):
    """Open3D's TSDF; a voxel keeps the instance that most frames gave it, an instance the product of its classes."""

    voxel_size: float = 0.01  # m, > 0
    block_resolution: int = 8  # voxels a side, 2 to 64: 16, Open3D's, takes twice the voxels and half as long again
    truncation: float = 4.0  # voxels, >= 1
    min_depth: float = 0.2  # m, > 0
    max_depth: float = 5.0  # m, > min_depth: beyond it a structured-light sensor is off by voxels
    max_blocks: int = 200_000  # blocks, > 0: 14 KiB each, and Open3D copies the map to make room: 5.7 GB at its end
    min_weight: float = 1.0  # frames, >= 1, that must have seen a voxel: Open3D's 3 loses what is seen briefly
    label_band: float = 2.0  # voxels, >= 1: those within this distance of the measured surface vote
    overlap: float = 0.35  # in (0, 1): a cluster updates an instance above this overlap over the smaller of the two
    create_score: float = 0.3  # in [0, 1]: a detection needs this to create an instance; any may update one
    create_points: int = 50  # pixels, >= 1: and this many; overlaps with less of an instance are counted over this many
    duplicate_overlap: float = 0.6  # in (0, 1]: a cluster that shares this with a better one creates nothing
    merge_overlap: float = 0.5  # in (0, 1]: two instances under one cluster above this are one object ...
    merge_frames: int = 3  # frames, >= 1: ... when seen so in this many more frames than apart
    class_floor: float = 0.1  # in (0, 1): share of the uniform distribution mixed into a measured one
    min_observations: int = 3  # frames, >= 1: before that an instance is tentative
    min_confidence: float = 0.05  # in [0, 1]: likewise
    min_vertices: int = 30  # mesh vertices, >= 1: of an instance that counts

    def __post_init__(self) -> None:
        check_bounds(
            self,
            voxel_size=(1e-4, 1.0),
            block_resolution=(2, 64),
            truncation=(1.0, 100.0),
            min_depth=(1e-3, 100.0),
            max_depth=(self.min_depth, 1000.0),
            max_blocks=(1, 2**31 // 512),
            min_weight=(1.0, 1e6),
            label_band=(1.0, self.truncation),
            overlap=(0.0, 1.0),
            create_score=(0.0, 1.0),
            create_points=(1, 2**31),
            duplicate_overlap=(0.0, 1.0),
            merge_overlap=(0.0, 1.0),
            merge_frames=(1, 2**31),
            class_floor=(1e-6, 0.999),
            min_observations=(1, 2**31),
            min_confidence=(0.0, 1.0),
            min_vertices=(1, 2**31),
        )
        settings = BlockGridSettings(
            voxel_size=self.voxel_size,
            block_resolution=self.block_resolution,
            truncation=self.truncation,
            min_depth=self.min_depth,
            max_depth=self.max_depth,
            max_blocks=self.max_blocks,
            min_weight=self.min_weight,
            min_observations=self.min_observations,
            min_confidence=self.min_confidence,
            min_vertices=self.min_vertices,
        )
        self.scene: Open3DMap = Open3DMap(settings)
        self._together: Counter[tuple[int, int]] = Counter()  # frames that see two instances as one, less those as two

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        self._agree_on_classes(clusters.classes)
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = self._look_up(frame, pose, clusters)
        instance_ids = self._associate(overlaps, clusters, points, frame)
        self.scene.integrate(frame, pose.T_world_camera)
        self._observe(overlaps, clusters, instance_ids, frame)
        seen_ids = _paint(clusters, instance_ids, frame.depth.shape)
        self.scene.vote(frame, pose.T_world_camera, seen_ids, self.label_band)
        self._merge_instances(overlaps, instance_ids)

    def _agree_on_classes(self, classes: tuple[str, ...]) -> None:
        """The first frame's label space becomes the map's."""
        if not self.scene.classes:
            self.scene.classes = classes
        elif self.scene.classes != classes:
            raise DataError(
                f"the map has {len(self.scene.classes)} classes and this frame's clusters have {len(classes)} "
                "others; use one detector, or map them to one label space"
            )

    def _look_up(self, frame: Frame, pose: Pose, clusters: PointClusters) -> Overlaps:
        """How the clusters lie on the instances that the map has at the measured surface."""
        stride = max(1, frame.camera.width // VOTES_ACROSS)
        v, u = np.nonzero(frame.depth[::stride, ::stride])
        pixels = np.stack([u * stride, v * stride], axis=1).astype(np.int32)
        points_camera = back_project(frame.camera, pixels, frame.depth[pixels[:, 1], pixels[:, 0]])
        instance_ids = np.zeros(tuple(-(-side // stride) for side in frame.depth.shape), np.int32)
        points_world = np.asarray(transform(pose.T_world_camera, points_camera), np.float32)
        instance_ids[v, u] = self.scene.instances_at(points_world)
        return count_overlaps(clusters, instance_ids, stride)

    def _associate(self, overlaps: Overlaps, clusters: PointClusters, points: PixelLists, frame: Frame) -> Int32:
        """(N,) the instance of each cluster, an old or a new one; 0 = none."""
        match = match_one_to_one(overlaps.over_smaller(self.create_points), self.overlap)
        instance_ids = np.where(match >= 0, np.append(overlaps.instance_ids, 0)[match], 0).astype(np.int32)
        may_create = (
            (instance_ids == 0) & (clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points)
        )
        if may_create.any():
            may_create &= ~cover_another(clusters, points, self.duplicate_overlap)
        for k in np.flatnonzero(may_create):
            instance_ids[k] = self.scene.table.create(len(clusters.classes), frame.index).id
        return instance_ids

    def _observe(self, overlaps: Overlaps, clusters: PointClusters, instance_ids: Int32, frame: Frame) -> None:
        """Brings the table of instances up to date with what this frame saw."""
        log_probabilities = self._log_probabilities(clusters)
        for k in np.flatnonzero(instance_ids):
            self.scene.table.observe(int(instance_ids[k]), log_probabilities[k], float(clusters.scores[k]), frame.index)
        in_view = set(overlaps.instance_ids[overlaps.visible >= self.create_points].tolist())
        for instance_id in in_view | set(instance_ids[instance_ids > 0].tolist()):
            self.scene.table.records[instance_id].visible += 1

    def _log_probabilities(self, clusters: PointClusters) -> Float64:
        """(N, C) log P(O_u = c | I_t), the uniform distribution mixed in so that no zero kills a class for good."""
        p = clusters.class_probabilities.astype(np.float64)
        return np.asarray(np.log((1 - self.class_floor) * p + self.class_floor / max(p.shape[1], 1)))

    def _merge_instances(self, overlaps: Overlaps, instance_ids: Int32) -> None:
        """Merges two instances that keep lying under one cluster and are hardly ever seen as two (after Voxblox++)."""
        matched = sorted(set(instance_ids[instance_ids > 0].tolist()))
        self._together.subtract(combinations(matched, 2))
        for k, row in enumerate(overlaps.over_smaller(self.create_points)):
            kept = int(instance_ids[k])
            covered = overlaps.instance_ids[row > self.merge_overlap].tolist() if kept else []
            for other in set(covered) - set(matched):
                pair = (min(kept, other), max(kept, other))
                self._together[pair] += 1
                if self._together[pair] >= self.merge_frames:
                    self.scene.merge(*pair)
                    self._together = Counter({p: n for p, n in self._together.items() if pair[1] not in p})
                    return  # overlaps are out of date now; what else is to be merged will be seen again


def _paint(clusters: PointClusters, instance_ids: Int32, shape: tuple[int, int]) -> Int32:
    """(H, W) the instance seen at each pixel, 0 = none; under overlapping clusters that of the best score."""
    image = np.zeros(shape, np.int32)
    for k in np.argsort(clusters.scores, kind="stable"):
        if instance_ids[k]:
            u, v = clusters.pixels[clusters.cluster == k].T
            image[v, u] = instance_ids[k]
    return image
