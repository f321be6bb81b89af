"""Point clusters at a single pixel, and the voxel at the surface of this pixel."""

import numpy as np

from framework.mapping.labels.class_slots import CLASS_SLOTS, NO_CLASS, class_id_type
from framework.mapping.labels.evidence_rows import INSTANCE_SLOTS
from framework.mapping.labels.label_evidence import Evidence, Measurement, named_classes, pack_class_scores
from framework.mapping.labels.label_evidence_kernels import Combine

FLOOR = 0.05
SCORE_SCALE = 1 << 16  # the precision of exact storage
BARE, COVERED = np.int32(0), np.int32(1)  # indices of the cluster lists: no cluster, all clusters


def blank(classes: int = 255) -> Evidence:
    """Return the evidence of one voxel with empty label slots in a map with the given number of classes."""
    return Evidence(
        np.zeros((1, 512), np.int32),
        np.zeros((1, INSTANCE_SLOTS), np.int32),
        np.zeros((1, INSTANCE_SLOTS), np.float32),
        np.full((1, CLASS_SLOTS), NO_CLASS, class_id_type(classes)),
        np.zeros((1, CLASS_SLOTS), np.int64),
    )


def measured(
    ids: list[int],
    scores: list[float],
    distributions: np.ndarray,
    absence: float,
    last_id: int,
) -> Measurement:
    """Return a measurement of clusters at the only pixel. Each has an instance, a score and a class distribution."""
    clusters = np.flatnonzero(ids).astype(np.int32)
    matched = np.zeros(last_id + 1, np.bool_)
    matched[ids] = True
    relative, named, bits = named_classes(np.log(distributions), logarithmic=True)
    return Measurement(
        np.full((1, 1), COVERED),
        np.array([0, 0, len(clusters)], np.int32),
        clusters,
        np.array(ids, np.int32),
        np.log(np.array(scores) / FLOOR).astype(np.float32),
        np.float32(np.log(absence)),
        matched,
        pack_class_scores(relative, SCORE_SCALE, bits, np.int64),
        named,
        int(Combine.SUM),
        1 << 62,
    )


def voted(ids: list[int], weights: list[float], classes: list[int], combine: Combine, number: int = 6) -> Measurement:
    """Return a measurement for rules that are not Bayesian. Each cluster has an instance, a weight and a class."""
    evidence = np.zeros((len(ids), number))
    evidence[np.arange(len(ids)), classes] = weights
    relative, named, bits = named_classes(evidence, logarithmic=False)
    every = measured(ids, weights, np.full((len(ids), 1), 1.0), 1.0, max(ids))
    return every._replace(
        instance_log_odds=np.array(weights, np.float32),
        class_scores=pack_class_scores(relative, 100, bits, np.int64),
        named_classes=named,
        combine=int(combine),
    )


def distribution(rng: np.random.Generator, classes: int) -> np.ndarray:
    p = rng.dirichlet(np.full(classes, 0.3))
    return 0.9 * p + 0.1 / classes
