"""Voxels with class and instance distributions, updated by Bayes' rule (section 3.2.3 of the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters, Pose
from framework.interfaces import MapFuser, SceneMap, StageTimer, SubmapChange, untimed
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Association
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.label_rule import DetectionEvidence, LabeledVoxels, LabelRule, floored_log

RULE = LabelRule(Combine.SUM, logarithmic=True)
MIN_LIKELIHOOD = 1e-3  # minimum of score and 1 - score, so that no single detection determines the result


@dataclass
class BayesianTsdf(MapFuser):
    """TSDF with two independent Bayesian recursions per voxel, one for the instance and one for the class.

    The recursions are eqs. (7) and (8) of docs/method.md, computed as sums of log-likelihoods. The likelihood of the
    matched instance is the score of the detection (our interpretation). The paper does not state the likelihood of the
    other instances. Here, it is `instance_floor`. If `instance_floor` is 0, 1 - score is divided equally among the
    other instances and "no instance".
    """

    voxels: LabeledVoxels = field(default_factory=LabeledVoxels)
    association: Association = field(default_factory=Association)
    class_floor: float = 0.1  # weight of the uniform distribution in a class measurement, in [1e-6, 0.999]
    # likelihood of each unmatched instance, in [0, 0.999]; 0 = (1 - score) divided equally among the unmatched
    # instances and "no instance"
    instance_floor: float = 0.05
    absence_likelihood: float = 0.7  # P(outside the mask | matched instance), in (0, 1]; 1 = no evidence of absence

    has_submaps = True

    def __post_init__(self) -> None:
        check_bounds(self, class_floor=(1e-6, 0.999), instance_floor=(0.0, 0.999), absence_likelihood=(1e-6, 1.0))
        self.scene: InstanceMap = self.voxels.new_map(RULE)

    def resume(self, scene: SceneMap) -> None:
        self.scene = self.voxels.continued(scene, RULE)

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
            evidence = self.evidence(clusters, len(self.scene.table.records))
            measurement = self.voxels.measurement(self.scene.table, points, matches, evidence, RULE)
            self.scene.labels.update(seen, measurement)  # the sums of eqs. (7) and (8)
            self.association.observe(self.scene.table, matches, evidence.classes)
        with timer("association"):
            self.association.merge(self.scene, matches)
            self.association.expire(self.scene)

    def evidence(self, clusters: PointClusters, instances: int) -> DetectionEvidence:
        """Return the log-likelihoods of the clusters.

        The evidence for an instance is relative to any other instance.

        Args:
            clusters: The clusters of the frame.
            instances: The number of instances of the map.
        """
        if self.instance_floor > 0:  # a score counts as at least twice the floor, so that no match lowers the log-odds
            log_odds = np.log(np.maximum(clusters.scores, 2 * self.instance_floor) / self.instance_floor)
        else:
            scores = np.clip(clusters.scores, MIN_LIKELIHOOD, 1 - MIN_LIKELIHOOD)
            # 1 - score is divided into `instances` equal parts, for the other instances and for "no instance"
            log_odds = np.log(scores * max(instances, 1) / (1 - scores))
        return DetectionEvidence(
            instances=np.asarray(log_odds, np.float32),
            classes=floored_log(clusters.class_probabilities, self.class_floor),
            absence=float(np.log(self.absence_likelihood)),
        )
