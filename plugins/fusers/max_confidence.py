"""A label rule without memory of the many: a voxel is what the most confident detection over it said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64, PointClusters
from framework.mapping.evidence import Combine
from framework.mapping.evidence_fuser import EvidenceFuser, only_best


@dataclass
class MaxConfidence(EvidenceFuser):
    """A voxel has the instance and best class of the detection with the highest score over it, of the whole video."""

    combine = Combine.LARGEST
    logarithmic = False
    units = 1 << 14  # scores are at most 1

    def instance_evidence(self, clusters: PointClusters) -> Float32:
        return np.maximum(clusters.scores, np.finfo(np.float32).tiny)  # 0 would be no evidence at all

    def class_evidence(self, clusters: PointClusters) -> Float64:
        return only_best(clusters, self.instance_evidence(clusters))
