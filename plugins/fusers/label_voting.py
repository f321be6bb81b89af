"""Label rules without probabilities: count the detections of each label, or keep the latest or most confident one."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from framework.data import Frame, PointClusters, Pose
from framework.interfaces import MapFuser, SceneMap
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Association
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.label_rule import LabeledVoxels, LabelRule, vote_for_best
from framework.mapping.labels.pixel_lists import list_points_by_pixel


class VotingRule(Enum):
    """How the detections that cover a voxel determine its instance and class."""

    COUNT = LabelRule(Combine.SUM, logarithmic=False, units=1)
    LAST = LabelRule(Combine.LATEST, logarithmic=False)
    MAX = LabelRule(Combine.LARGEST, logarithmic=False, units=1 << 14)  # scores are at most 1


@dataclass
class LabelVoting(MapFuser):
    """Each detection votes for its instance and its most likely class.

    COUNT keeps the label with the most detections, regardless of their scores (Voxblox++, Grinvald et al. 2019). LAST
    keeps the label of the last detection, and of the later one where two overlap. MAX keeps the label of the detection
    with the highest score. No rule reduces the votes for a label.
    """

    voxels: LabeledVoxels = field(default_factory=LabeledVoxels)
    association: Association = field(default_factory=Association)
    rule: VotingRule = VotingRule.COUNT  # COUNT: most detections; LAST: last detection; MAX: highest score

    def __post_init__(self) -> None:
        self.scene: InstanceMap = self.voxels.new_map(self.rule.value)

    def resume(self, scene: SceneMap) -> None:
        self.scene = self.voxels.continued(scene, self.rule.value)

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        self.scene.begin(clusters.classes)
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = self.association.look_up(self.scene, frame, pose, points)
        matches = self.association.associate(self.scene.table, overlaps, clusters, points, frame.index)
        seen = self.scene.volume.integrate(frame, pose.T_world_camera, self.voxels.hashing.near)
        weights = np.ones(len(clusters), np.float32)
        if self.rule is VotingRule.MAX:
            weights = np.maximum(clusters.scores, np.finfo(np.float32).tiny)  # 0 is no evidence
        evidence = vote_for_best(clusters, weights)
        measurement = self.voxels.measurement(self.scene.table, points, matches, evidence, self.rule.value)
        self.scene.labels.update(seen, measurement)
        self.association.observe(self.scene.table, matches, evidence.classes)
        self.association.merge(self.scene, matches)
