"""The simplest label rule: a voxel is what it was last seen as."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import PointClusters
from framework.mapping.evidence import Combine
from framework.mapping.instance_fuser import FrameEvidence, InstanceFuser, only_best


@dataclass
class LastWrite(InstanceFuser):
    """A voxel has the instance and best class of the last detection over it; where two overlap, of the later one."""

    combine = Combine.LATEST
    logarithmic = False

    def evidence(self, clusters: PointClusters) -> FrameEvidence:
        return FrameEvidence(np.ones(len(clusters), np.float32), only_best(clusters, np.ones(len(clusters))))
