"""Voxblox++'s label rule: a voxel counts how often it was seen as each instance and as each class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import PointClusters
from framework.mapping.evidence import Combine
from framework.mapping.instance_fuser import FrameEvidence, InstanceFuser, only_best


@dataclass
class LabelCount(InstanceFuser):
    """Every detection counts as one for its instance and its best class, whatever its score (Grinvald et al. 2019).

    The label with the highest count wins; nothing counts against one.
    """

    combine = Combine.SUM
    logarithmic = False
    units = 1

    def evidence(self, clusters: PointClusters) -> FrameEvidence:
        return FrameEvidence(np.ones(len(clusters), np.float32), only_best(clusters, np.ones(len(clusters))))
