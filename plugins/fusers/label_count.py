"""Voxblox++'s label rule: a voxel counts how often it was seen as each instance and as each class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64, PointClusters
from framework.mapping.evidence import Combine
from framework.mapping.evidence_fuser import EvidenceFuser, only_best


@dataclass
class LabelCount(EvidenceFuser):
    """Every detection counts as one for its instance and its best class, whatever its score (Grinvald et al. 2019).

    The label with the highest count wins; nothing counts against one.
    """

    combine = Combine.SUM
    logarithmic = False
    units = 1

    def instance_evidence(self, clusters: PointClusters) -> Float32:
        return np.ones(len(clusters), np.float32)

    def class_evidence(self, clusters: PointClusters) -> Float64:
        return only_best(clusters, self.instance_evidence(clusters))
