"""The simplest label rule: a voxel is what it was last seen as."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.data import Frame, PointClusters, Pose
from framework.interfaces import MapFuser, SceneMap
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Association
from framework.mapping.labels.label_evidence import Combine
from framework.mapping.labels.label_rule import LabeledVoxels, LabelRule, vote_for_best
from framework.mapping.labels.pixel_lists import list_points_by_pixel

RULE = LabelRule(Combine.LATEST, logarithmic=False)


@dataclass
class LastWrite(MapFuser):
    """A voxel has the instance and best class of the last detection over it; where two overlap, of the later one."""

    voxels: LabeledVoxels = field(default_factory=LabeledVoxels)
    association: Association = field(default_factory=Association)

    def __post_init__(self) -> None:
        self.scene: InstanceMap = self.voxels.new_map(RULE)

    def go_on(self, scene: SceneMap) -> None:
        self.scene = self.voxels.continued(scene, RULE)

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        self.scene.begin(clusters.classes)
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = self.association.look_up(self.scene, frame, pose, points)
        matches = self.association.associate(self.scene.table, overlaps, clusters, points, frame.index)
        seen = self.scene.volume.integrate(frame, pose.T_world_camera, self.voxels.hashing.near)
        evidence = vote_for_best(clusters, np.ones(len(clusters), np.float32))
        measurement = self.voxels.measurement(self.scene.table, points, matches, evidence, RULE)
        self.scene.labels.update(seen, measurement)
        self.association.observe(self.scene.table, matches, evidence.classes)
        self.association.merge(self.scene, matches)
