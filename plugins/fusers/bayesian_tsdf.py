"""The paper's fuser: voxels carry class and instance distributions, updated by Bayes' rule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64, PointClusters
from framework.mapping.evidence_fuser import EvidenceFuser
from framework.mapping.instance_fuser import floored_log
from framework.parameters import check_bounds


@dataclass
class BayesianTsdf(EvidenceFuser):
    """Two independent Bayesian recursions a voxel, eqs. [7] and [8] of the paper, as sums of log-likelihoods.

    An instance's class distribution is the product of the distributions of all its detections.
    """

    class_floor: float = 0.1  # in (0, 1): share of the uniform distribution mixed into a measured one
    instance_floor: float = 0.05  # in (0, 1): P(O = another instance); the matched one has the detection's score
    absence: float = 0.7  # in (0, 1]: P(outside the mask | of the matched instance); 1 = no evidence of absence

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(self, class_floor=(1e-6, 0.999), instance_floor=(1e-6, 0.999), absence=(1e-6, 1.0))

    def instance_evidence(self, clusters: PointClusters) -> Float32:
        scores = np.maximum(clusters.scores, 2 * self.instance_floor)  # a detection never speaks against itself
        return np.asarray(np.log(scores / self.instance_floor), np.float32)

    def absence_evidence(self) -> float:
        return float(np.log(self.absence))

    def class_evidence(self, clusters: PointClusters) -> Float64:
        return floored_log(clusters.class_probabilities, self.class_floor)
