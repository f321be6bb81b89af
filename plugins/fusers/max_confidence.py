"""A label rule without memory of the many: a voxel is what the most confident detection over it said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import PointClusters
from framework.mapping.evidence import Combine
from framework.mapping.instance_fuser import FrameEvidence, InstanceFuser, only_best


@dataclass
class MaxConfidence(InstanceFuser):
    """A voxel has the instance and best class of the detection with the highest score over it, of the whole video."""

    combine = Combine.LARGEST
    logarithmic = False
    units = 1 << 14  # scores are at most 1

    def evidence(self, clusters: PointClusters) -> FrameEvidence:
        scores = np.maximum(clusters.scores, np.finfo(np.float32).tiny)  # 0 would be no evidence at all
        return FrameEvidence(scores, only_best(clusters, scores))
