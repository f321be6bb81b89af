"""Baseline with one volume per object, based on Fusion++ and MaskFusion."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.baselines.object_map import ObjectMap
from framework.config.validation import check_bounds
from framework.data import Bool, Float64, Frame, Int32, PointClusters, Pose
from framework.geometry import require_pixels_inside
from framework.interfaces import MapFuser, StageTimer, untimed
from framework.mapping.instances.association import Matches, observe, vote_stride
from framework.mapping.instances.instance_list import Confirmation
from framework.mapping.instances.instance_table import InstanceRecord
from framework.mapping.instances.overlaps import OverlapRule, Overlaps, count_overlaps
from framework.mapping.labels.pixel_lists import list_points_by_pixel
from framework.mapping.voxels.tsdf_volume import VoxelHashing


def existence(record: InstanceRecord) -> float:
    """Return the existence probability of an object.

    The definition follows Fusion++.
    """
    # mean of Beta(1 + n, 1 + m): n frames with a detection, m frames in view without a detection
    return (1 + record.observations) / (2 + max(record.visible, record.observations))


@dataclass
class ObjectVolumes(MapFuser):
    """One TSDF with foreground probabilities per object, and one TSDF of the whole scene.

    A detection is matched with the object with the largest overlap. If several detections match one object, the union
    of their masks is used. The defaults are the rule of Fusion++. For the rule of MaskFusion, set `overlap_rule=CLUSTER
    min_overlap=0.05 require_same_class=true`. See `framework/baselines/object_map.py` for the differences from the
    original systems.
    """

    hashing: VoxelHashing = field(default_factory=VoxelHashing)
    min_overlap: float = 0.2  # minimum overlap of a detection and an object to match, in [0, 1]
    overlap_rule: OverlapRule = OverlapRule.IOU  # denominator of the overlap
    require_same_class: bool = False  # True = match only objects with the same most likely class, as in MaskFusion
    create_score: float = 0.3  # minimum score of a detection to create an object, in [0, 1]; no minimum for updates
    # minimum number of pixels of a detection to create an object, >= 1; also the minimum denominator of the overlap
    create_points: int = 50
    min_existence: float = 0.1  # minimum existence probability of an object, in [0, 1]; objects below it are removed
    min_observations: int = 3  # minimum number of frames with a detection to confirm an object, >= 1
    min_area: float = 0.01  # minimum surface area of a confirmed object in the mesh, m^2, >= 0

    def __post_init__(self) -> None:
        check_bounds(
            self,
            min_overlap=(0.0, 1.0),
            create_score=(0.0, 1.0),
            create_points=(1, 2**31),
            min_existence=(0.0, 1.0),
        )
        confirmation = Confirmation(self.min_observations, min_confidence=0.0, min_area=self.min_area)
        self.scene: ObjectMap = ObjectMap(self.hashing.new_volume(), confirmation)

    def renew_colors(self) -> None:
        self.scene.background.renew_colors()

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        self.scene.begin(clusters.classes)
        require_pixels_inside(clusters, frame.depth.shape)
        with timer("association"):
            overlaps = self._look_up(frame, pose.T_world_camera, clusters)
            matches = self._associate(overlaps, clusters, frame, pose.T_world_camera[:3, 3])
        with timer("integration"):
            masks = _masks(clusters, matches.instance_ids, frame.depth.shape)
            self.scene.integrate(frame, pose.T_world_camera, masks, self.hashing.near)
        with timer("update"):
            self._remove_empty(matches.instance_ids)
            observe(self.scene.table, matches, clusters.class_probabilities.astype(np.float64), self.create_points)
            self._remove_unlikely(matches)

    def _look_up(self, frame: Frame, T_world_camera: Float64, clusters: PointClusters) -> Overlaps:
        """Return the overlaps of the clusters with the objects at the measured surface."""
        stride = vote_stride(frame.camera)
        points = list_points_by_pixel(clusters, frame.depth.shape)
        seen = self.scene.instances_seen(frame.camera, T_world_camera, frame.depth, stride)
        return count_overlaps(points, seen, stride)

    def _associate(self, overlaps: Overlaps, clusters: PointClusters, frame: Frame, camera_center: Float64) -> Matches:
        """Match each cluster with the object with the largest overlap, and create objects for other clusters."""
        ratios = overlaps.by(self.overlap_rule, self.create_points)
        ratios[~self._agree(clusters, overlaps.instance_ids)] = 0
        instance_ids = np.zeros(len(clusters), np.int32)
        if ratios.size:
            best = ratios.argmax(axis=1)
            instance_ids[:] = np.where(ratios.max(axis=1) > self.min_overlap, overlaps.instance_ids[best], 0)
        may_create = (clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points)
        for k in np.flatnonzero((instance_ids == 0) & may_create):
            instance_ids[k] = self.scene.create(frame.index)
        return Matches(frame.index, clusters, overlaps, instance_ids, camera_center)

    def _agree(self, clusters: PointClusters, instance_ids: Int32) -> Bool:
        """Return a Boolean array (N, M), True where the classes of a cluster and an object allow a match."""
        if not self.require_same_class or not len(instance_ids):
            return np.ones((len(clusters), len(instance_ids)), np.bool_)
        known = np.array([self.scene.table.records[k].class_evidence.argmax() for k in instance_ids.tolist()])
        return np.asarray(clusters.class_probabilities.argmax(axis=1)[:, None] == known[None, :])

    def _remove_empty(self, instance_ids: Int32) -> None:
        """Remove new objects without voxels, and set their entries in `instance_ids` (N,) to 0."""
        for instance_id in set(instance_ids[instance_ids > 0].tolist()):
            if not self.scene.volumes[instance_id].block_count:
                self.scene.remove(instance_id)
                instance_ids[instance_ids == instance_id] = 0

    def _remove_unlikely(self, matches: Matches) -> None:
        """Remove unlikely objects. A frame changes the existence probability of visible and matched objects only."""
        records = self.scene.table.records
        changed = {*matches.overlaps.instance_ids.tolist(), *matches.instance_ids.tolist()} & records.keys()
        for instance_id in sorted(changed):
            if existence(records[instance_id]) < self.min_existence:
                self.scene.remove(instance_id)


def _masks(clusters: PointClusters, instance_ids: Int32, shape: tuple[int, int]) -> dict[int, Bool]:
    """Return the union of the cluster masks of each object by id."""
    masks: dict[int, Bool] = {}
    for k in np.flatnonzero(instance_ids):
        u, v = clusters.pixels[clusters.cluster == k].T
        mask = masks.setdefault(int(instance_ids[k]), np.zeros(shape, np.bool_))
        mask[v, u] = True
    return masks
