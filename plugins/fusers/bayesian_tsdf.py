"""The paper's fuser: voxels carry class and instance distributions, updated by Bayes' rule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import PointClusters
from framework.mapping.instance_fuser import FrameEvidence, InstanceFuser
from framework.parameters import check_bounds


@dataclass
class BayesianTsdf(InstanceFuser):
    """Two independent Bayesian recursions a voxel, eqs. [7] and [8] of the paper, as sums of log-likelihoods.

    An instance's class distribution is the product of the distributions of all its detections.
    """

    class_floor: float = 0.1  # in (0, 1): share of the uniform distribution mixed into a measured one
    instance_floor: float = 0.05  # in (0, 1): P(O = another instance); the matched one has the detection's score
    absence: float = 0.3  # in (0, 1]: P(outside the mask | of the matched instance); 1 = no evidence of absence

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(self, class_floor=(1e-6, 0.999), instance_floor=(1e-6, 0.999), absence=(1e-6, 1.0))

    def evidence(self, clusters: PointClusters) -> FrameEvidence:
        p = clusters.class_probabilities.astype(np.float64)
        scores = np.maximum(clusters.scores, 2 * self.instance_floor)  # a detection never speaks against itself
        return FrameEvidence(
            instances=np.log(scores / self.instance_floor).astype(np.float32),
            # no zero may kill a class for good
            classes=np.log((1 - self.class_floor) * p + self.class_floor / max(p.shape[1], 1)),
            absence=float(np.log(self.absence)),
        )
