"""Tests for the dense conditional random field."""

from __future__ import annotations

from dataclasses import asdict
from itertools import product

import numpy as np
import pytest

from framework.data import Float64, Int32
from framework.errors import ConfigError, DataError
from framework.mapping.labels.dense_crf import REACH, STEPS, DenseCrf, Instances, Model, Pairs, mean_instances
from framework.mapping.labels.dense_crf_kernels import ABSENT, SLOTS
from framework.mapping.storage.map_header import MapHeader

LABELS = (0, 3, 8)  # no instance, and two instances


def random_field(seed: int, nodes: int = 6, evidence: float = 2.0) -> tuple[np.ndarray, Instances]:
    """Return the features of nodes, and their instances with log-odds for LABELS."""
    rng = np.random.default_rng(seed)
    features = rng.normal(0, 0.5, (nodes, 9)).astype(np.float32)
    found = Instances.empty(nodes)
    found.ids[:, :2] = LABELS[1:]
    found.values[:, :2] = rng.normal(0, evidence, (nodes, 2))
    return features, found


def couplings(crf: DenseCrf, features: np.ndarray) -> Float64:
    """Return the weights (N, N) of the pairwise potentials, in the plain formula."""
    n = len(features)
    g = np.zeros((n, n))
    for i, j in product(range(n), range(n)):
        if i != j and np.linalg.norm(features[i, :3] - features[j, :3]) <= REACH:
            g[i, j] = np.exp(-0.5 * ((features[i] - features[j]) ** 2).sum())
    d = g.sum(axis=1)
    return np.asarray(crf.crf_weight * g / np.sqrt(np.maximum(d[:, None] * d, 1e-30)))


def unaries(crf: DenseCrf, found: Instances) -> Float64:
    """Return the unary potentials (N, LABELS)."""
    scores = np.full((len(found.ids), len(LABELS)), ABSENT, np.float64)
    scores[:, 0] = 0
    for i, s in zip(*np.nonzero(found.ids), strict=True):
        scores[i, LABELS.index(found.ids[i, s])] = np.clip(found.values[i, s], -crf.crf_limit, crf.crf_limit)
    return scores


def exact_marginals(weights: Float64, scores: Float64) -> Float64:
    """Return the marginal distributions (N, LABELS) by enumeration of all labelings."""
    n, count = scores.shape
    marginals = np.zeros_like(scores)
    for x in product(range(count), repeat=n):
        labels = np.array(x)
        disagreement = weights[np.triu(labels[:, None] != labels)].sum()
        marginals[np.arange(n), labels] += np.exp(scores[np.arange(n), labels].sum() - disagreement)
    return marginals / marginals.sum(axis=1, keepdims=True)


def inferred(crf: DenseCrf, features: np.ndarray, found: Instances) -> Float64:
    """Return the distributions (N, LABELS) by the mean field."""
    _, q = crf.inferred(Pairs.within(features[:, :3], REACH), features, found)
    dense = np.zeros((len(features), len(LABELS)))
    for i, s in zip(*np.nonzero(q.ids), strict=True):
        dense[i, LABELS.index(q.ids[i, s])] = q.values[i, s]
    dense[:, 0] = 1 - dense.sum(axis=1)
    return dense


@pytest.mark.parametrize("seed", range(5))
def test_mean_field_equals_slow_reference(seed: int) -> None:
    crf = DenseCrf(crf_weight=3.0)
    features, found = random_field(seed)
    weights, scores = couplings(crf, features), unaries(crf, found)
    q = np.exp(scores) / np.exp(scores).sum(axis=1, keepdims=True)
    for _ in range(STEPS):
        q = np.exp(scores + weights @ q)
        q /= q.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(inferred(crf, features, found), q, atol=1e-4)


def test_mean_field_finds_exact_labels() -> None:
    crf, right, wrong_before, total = DenseCrf(crf_weight=3.0), 0, 0, 0
    for seed in range(40):
        features, found = random_field(seed, evidence=1.0)
        scores = unaries(crf, found)
        exact = exact_marginals(couplings(crf, features), scores)
        sure = exact.max(axis=1) > 0.6
        right += int((inferred(crf, features, found).argmax(axis=1) == exact.argmax(axis=1))[sure].sum())
        wrong_before += int((scores.argmax(axis=1) != exact.argmax(axis=1))[sure].sum())
        total += int(sure.sum())
    assert wrong_before > 15  # the pairwise potentials matter
    assert right >= 0.98 * total


def test_mean_field_without_pairs_keeps_evidence() -> None:
    crf = DenseCrf(crf_weight=5.0)
    features, found = random_field(0)
    features[:, 0] = 10 * REACH * np.arange(len(features))
    scores = unaries(crf, found)
    expected = np.exp(scores) / np.exp(scores).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(inferred(crf, features, found), expected, atol=1e-6)


def stripe(boundary: int, edge: int) -> tuple[Model, Int32]:
    """Return a stripe of 60 vertices in 30 nodes: instance 3 before `boundary`, and another color from `edge` on."""
    crf, x = DenseCrf(), np.arange(60, dtype=np.float32)
    ids = np.where(x < boundary, 3, 0).astype(np.int32)
    found = Instances.empty(60)
    found.ids[ids > 0, 0], found.values[ids > 0, 0] = 3, 1.0
    color = np.where(x < edge, 0, 200) / crf.crf_color
    features = np.zeros((60, 9), np.float32)
    features[:, 0], features[:, 3] = x / 6, color
    nodes = (x // 2).astype(np.int32)
    node_features = features.reshape(30, 2, 9).mean(axis=1)
    return Model(features, found, nodes, node_features, mean_instances(nodes, found, 30)), ids


@pytest.mark.parametrize("boundary", [26, 36])
def test_crf_moves_outline_to_color_edge(boundary: int) -> None:
    model, ids = stripe(boundary, edge=30)
    smoothed = DenseCrf(crf_weight=8.0).most_likely(model, ids)
    np.testing.assert_array_equal(smoothed, np.where(np.arange(60) < 30, 3, 0))


def test_mean_instances_keep_those_with_most_evidence() -> None:
    found = Instances.empty(2)
    found.ids[0, :2], found.values[0, :2] = (5, 2), (1.0, 4.0)
    found.ids[1, :1], found.values[1, :1] = 2, 2.0
    means = mean_instances(np.zeros(2, np.int32), found, 1)
    assert means.ids[0].tolist() == [2, 5] + (SLOTS - 2) * [0]
    assert means.values[0, :2].tolist() == [3.0, 0.5]


def test_crf_header_is_read_back() -> None:
    crf = DenseCrf(crf_weight=3.0, crf_position=0.05)
    assert DenseCrf.of(MapHeader(asdict(crf))) == crf
    with pytest.raises(DataError, match="crf_color"):
        DenseCrf.of(MapHeader({**asdict(crf), "crf_color": "red"}))


def test_crf_parameter_out_of_range_raises_config_error() -> None:
    with pytest.raises(ConfigError, match="crf_position"):
        DenseCrf(crf_position=0.0)
