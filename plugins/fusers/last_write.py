"""The simplest label rule: a voxel is what it was last seen as."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64, PointClusters
from framework.mapping.evidence import Combine
from framework.mapping.evidence_fuser import EvidenceFuser, only_best


@dataclass
class LastWrite(EvidenceFuser):
    """A voxel has the instance and best class of the last detection over it; where two overlap, of the later one."""

    combine = Combine.LATEST
    logarithmic = False

    def instance_evidence(self, clusters: PointClusters) -> Float32:
        return np.ones(len(clusters), np.float32)

    def class_evidence(self, clusters: PointClusters) -> Float64:
        return only_best(clusters, self.instance_evidence(clusters))
