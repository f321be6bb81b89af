"""The rival with one volume an object: a re-implementation, in the manner of Fusion++ and MaskFusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float64, Frame, Int32, PointClusters, Pose
from framework.geometry import require_pixels_inside
from framework.mapping.association import OverlapRule, Overlaps, count_overlaps
from framework.mapping.instance_fuser import VOTES_ACROSS
from framework.mapping.instance_list import Confirmation
from framework.mapping.instance_table import InstanceRecord
from framework.mapping.tsdf_fuser import VoxelHashingFuser, require_same_classes
from framework.parameters import check_bounds
from framework.rivals.object_map import ObjectMap


def existence(record: InstanceRecord) -> float:
    """The probability that an object exists: the mean of Beta(1 + frames that detected it, 1 + other frames that saw
    where it is), as in Fusion++.
    """
    return (1 + record.observations) / (2 + max(record.visible, record.observations))


@dataclass
class ObjectVolumes(VoxelHashingFuser):
    """A TSDF for each object, with the probability of each voxel to be of the object, before one of everything.

    A detection belongs to the object that it overlaps most with, several may belong to one, and an object's masks of a
    frame are taken together. The defaults are Fusion++'s rule; MaskFusion's is `overlap_rule=CLUSTER overlap=0.05
    same_class=true`. How the maps differ from the originals': framework/rivals/object_map.py.
    """

    overlap: float = 0.2  # in [0, 1]: a detection may belong to an object above this overlap
    overlap_rule: OverlapRule = OverlapRule.IOU  # what an overlap is counted over
    same_class: bool = False  # whether their likeliest classes must be the same
    create_score: float = 0.3  # in [0, 1]: a detection needs this to create an object; any may update one
    create_points: int = 50  # pixels, >= 1: and this many; an object is seen, or missed, with this many in view
    min_existence: float = 0.1  # in [0, 1]: an object that exists with less probability is forgotten
    min_observations: int = 3  # frames, >= 1: before that an object is tentative, as in our own map

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(
            self,
            overlap=(0.0, 1.0),
            create_score=(0.0, 1.0),
            create_points=(1, 2**31),
            min_existence=(0.0, 1.0),
            min_observations=(1, 2**31),
        )
        confirmation = Confirmation(self.min_observations, min_confidence=0.0, min_area=self.min_area)
        self.scene: ObjectMap = ObjectMap(self.voxel_size, self.sensor, self.max_blocks, confirmation)

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        self.scene.classes = self.scene.classes or clusters.classes
        require_same_classes(self.scene.classes, clusters.classes)
        require_pixels_inside(clusters, frame.depth.shape)
        overlaps = self._look_up(frame, pose.T_world_camera, clusters)
        instance_ids = self._associate(overlaps, clusters, frame)
        masks = _masks(clusters, instance_ids, frame.depth.shape)
        self.scene.integrate(frame, pose.T_world_camera, masks, self.label_band * self.voxel_size)
        self._take_back_empty(instance_ids)
        self._observe(overlaps, clusters, instance_ids, frame)
        self._forget()

    def _look_up(self, frame: Frame, T_world_camera: Float64, clusters: PointClusters) -> Overlaps:
        """How the clusters lie on the objects that the map has at the measured surface."""
        stride = max(1, frame.camera.width // VOTES_ACROSS)
        return count_overlaps(
            clusters, self.scene.instances_seen(frame.camera, T_world_camera, frame.depth, stride), stride
        )

    def _associate(self, overlaps: Overlaps, clusters: PointClusters, frame: Frame) -> Int32:
        """(N,) the object of each cluster, an old or a new one; 0 = none."""
        shares = overlaps.by(self.overlap_rule, self.create_points)
        shares[~self._agree(clusters, overlaps.instance_ids)] = 0
        instance_ids = np.zeros(len(clusters), np.int32)
        if shares.size:
            best = shares.argmax(axis=1)
            instance_ids[:] = np.where(shares.max(axis=1) > self.overlap, overlaps.instance_ids[best], 0)
        may_create = (clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points)
        for k in np.flatnonzero((instance_ids == 0) & may_create):
            instance_ids[k] = self.scene.create(frame.index)
        return instance_ids

    def _agree(self, clusters: PointClusters, instance_ids: Int32) -> Bool:
        """(N, M) whether a cluster may be an object, by their classes."""
        if not self.same_class or not len(instance_ids):
            return np.ones((len(clusters), len(instance_ids)), np.bool_)
        known = np.array([self.scene.table.records[k].class_evidence.argmax() for k in instance_ids.tolist()])
        return np.asarray(clusters.class_probabilities.argmax(axis=1)[:, None] == known[None, :])

    def _take_back_empty(self, instance_ids: Int32) -> None:
        """Removes new objects of which no reading was in range: without voxels they are never seen again."""
        for instance_id in set(instance_ids[instance_ids > 0].tolist()):
            if not self.scene.volumes[instance_id].block_count:
                self.scene.remove(instance_id)
                instance_ids[instance_ids == instance_id] = 0

    def _observe(self, overlaps: Overlaps, clusters: PointClusters, instance_ids: Int32, frame: Frame) -> None:
        """Brings the table up to date with what this frame saw, and what it should have seen."""
        table = self.scene.table
        for k in np.flatnonzero(instance_ids):
            evidence = clusters.class_probabilities[k].astype(np.float64)
            table.observe(int(instance_ids[k]), evidence, float(clusters.scores[k]), frame.index)
        expected = set(overlaps.instance_ids[overlaps.visible >= self.create_points].tolist())
        for instance_id in expected | set(instance_ids[instance_ids > 0].tolist()):
            table.records[instance_id].visible += 1

    def _forget(self) -> None:
        """Removes the objects that hardly exist."""
        for record in list(self.scene.table.records.values()):
            if existence(record) < self.min_existence:
                self.scene.remove(record.id)


def _masks(clusters: PointClusters, instance_ids: Int32, shape: tuple[int, int]) -> dict[int, Bool]:
    """(H, W) for each object that the frame's clusters belong to, by id: the pixels of all its clusters."""
    masks: dict[int, Bool] = {}
    for k in np.flatnonzero(instance_ids):
        u, v = clusters.pixels[clusters.cluster == k].T
        mask = masks.setdefault(int(instance_ids[k]), np.zeros(shape, np.bool_))
        mask[v, u] = True
    return masks
