"""Label voting: each detection votes for its instance and its most likely class."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from framework.data import Frame, PointClusters, Pose
from framework.interfaces import MapFuser, SceneMap, StageTimer, SubmapChange, untimed
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Association
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.label_rule import LabeledVoxels, LabelRule, vote_for_best


class Vote(Enum):
    """Rule for selecting the label of a voxel."""

    COUNT = "count"  # number of detections (Voxblox++, Grinvald et al. 2019)
    LAST = "last"  # last detection only; among overlapping masks, the last mask
    MAX_SCORE = "max_score"  # detection with the highest score


RULES = {
    Vote.COUNT: LabelRule(Combine.SUM, logarithmic=False, score_scale=1),
    Vote.LAST: LabelRule(Combine.LATEST, logarithmic=False),
    Vote.MAX_SCORE: LabelRule(Combine.LARGEST, logarithmic=False, score_scale=1 << 14),  # scores are at most 1
}


@dataclass
class LabelVote(MapFuser):
    """TSDF with votes of the detections for the labels of voxels.

    There is no evidence against a label.
    """

    voxels: LabeledVoxels = field(default_factory=LabeledVoxels)
    association: Association = field(default_factory=Association)
    vote: Vote = Vote.COUNT  # rule for the label of a voxel

    has_submaps = True

    def __post_init__(self) -> None:
        self.scene: InstanceMap = self.voxels.new_map(RULES[self.vote])

    def resume(self, scene: SceneMap) -> None:
        self.scene = self.voxels.continued(scene, RULES[self.vote])

    def correct(self, change: SubmapChange) -> Mapping[int, int]:
        return self.scene.correct(change, self.association)

    def renew_colors(self) -> None:
        self.scene.renew_colors()

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        self.scene.begin(clusters.classes)
        with timer("association"):
            points, matches = self.association.match(self.scene, frame, pose, clusters)
        with timer("integration"):
            seen = self.scene.integrate(frame, pose.T_world_camera, self.voxels.hashing.near)
        with timer("update"):
            weights = np.ones(len(clusters), np.float32)
            if self.vote is Vote.MAX_SCORE:
                weights = np.maximum(clusters.scores, np.finfo(np.float32).tiny)  # a score of 0 would not be evidence
            evidence = vote_for_best(clusters, weights)
            measurement = self.voxels.measurement(self.scene.table, points, matches, evidence, RULES[self.vote])
            self.scene.labels.update(seen, measurement)
            self.association.observe(self.scene.table, matches, evidence.classes)
        with timer("association"):
            self.association.merge(self.scene, matches)
            self.association.expire(self.scene)
