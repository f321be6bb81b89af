"""Tests for the learned association: features, network and weights file."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from framework.data import PointClusters
from framework.errors import DataError
from framework.files.search_paths import PROJECT_ROOT
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.learned_association import (
    FEATURES,
    WEIGHTS,
    AssociationScorer,
    CandidatePairs,
    pairs_of,
    shapes,
)
from framework.mapping.instances.overlaps import Overlaps

MAX_BYTES = 1_000_000


def random_clusters(rng: np.random.Generator, count: int) -> PointClusters:
    points = 40 * count
    return PointClusters(
        points_world=rng.normal(size=(points, 3)).astype(np.float32),
        pixels=np.zeros((points, 2), np.int32),
        cluster=rng.integers(-1, count, points).astype(np.int32),
        class_probabilities=rng.dirichlet(np.ones(4), count).astype(np.float32),
        scores=rng.uniform(size=count).astype(np.float32),
        classes=("a", "b", "c", "d"),
    )


def random_table(rng: np.random.Generator, ids: list[int]) -> InstanceTable:
    table = InstanceTable()
    for _ in range(max(ids)):
        record = table.create(4, 0)
        for frame in range(int(rng.integers(1, 6))):
            table.observe(record.id, np.log(rng.dirichlet(np.ones(4))), float(rng.uniform()), frame)
            table.see([record.id], frame)
            record.viewing.locate(tuple(rng.normal(size=3).tolist()))
        table.see([record.id], 7)
    return table


def random_overlaps(rng: np.random.Generator, clusters: int, ids: list[int]) -> Overlaps:
    votes = rng.integers(0, 50, (clusters, len(ids))) * (rng.uniform(size=(clusters, len(ids))) < 0.6)
    return Overlaps(
        instance_ids=np.array(ids, np.int32),
        visible=(votes.max(axis=0) + rng.integers(1, 100, len(ids))).astype(np.int32),
        sizes=(votes.sum(axis=1) + rng.integers(1, 100, clusters)).astype(np.int32),
        votes=votes.astype(np.int32),
        seen=np.zeros((1, 1), np.int32),
        stride=1,
    )


def reference(table: InstanceTable, overlaps: Overlaps, clusters: PointClusters, frame: int, n: int, m: int) -> list:
    """Return the features of one pair, computed with loops."""
    votes, sizes, visible = overlaps.votes.tolist(), overlaps.sizes.tolist(), overlaps.visible.tolist()
    record = table.records[int(overlaps.instance_ids[m])]
    points = [p for p, k in zip(clusters.points_world.tolist(), clusters.cluster.tolist(), strict=True) if k == n]
    center = [math.fsum(p[axis] for p in points) / len(points) for axis in range(3)]
    extent = math.sqrt(math.fsum(math.dist(p, center) ** 2 for p in points) / len(points))
    located = [value / record.viewing.centered for value in record.viewing.center_sum]
    distance = min(math.dist(center, located), 3)
    p, q = clusters.class_probabilities[n].tolist(), table.class_probabilities(record).tolist()
    others = [j for j in range(len(visible)) if j != m]
    return [
        votes[n][m] / sizes[n],
        votes[n][m] / visible[m],
        votes[n][m] / (sizes[n] + visible[m] - votes[n][m]),
        max((votes[n][j] / sizes[n] for j in others), default=0),
        max((votes[i][m] / visible[m] for i in range(len(sizes)) if i != n), default=0),
        1 - sum(votes[n]) / sizes[n],
        math.log1p(sizes[n]) / 10,
        math.log1p(visible[m]) / 10,
        distance,
        min(distance / max(extent, 0.01), 5) / 5,
        sum(math.sqrt(a * b) for a, b in zip(p, q, strict=True)),
        sum(a * b for a, b in zip(p, q, strict=True)),
        float(clusters.scores[n]),
        record.mean_score,
        record.observations / record.visible,
        math.log1p(record.observations) / 5,
        math.log1p(frame - record.last_frame) / 5,
    ]


@pytest.mark.parametrize(("clusters", "ids"), [(1, [1]), (1, [2, 3]), (4, [1]), (5, [1, 3, 4, 6])])
def test_pair_features_match_slow_reference(clusters: int, ids: list[int]) -> None:
    rng = np.random.default_rng([clusters, len(ids)])
    found, table, overlaps = random_clusters(rng, clusters), random_table(rng, ids), random_overlaps(rng, clusters, ids)
    pairs = pairs_of(table, overlaps, found, 9)
    expected = [*zip(*np.nonzero(overlaps.votes), strict=True)]
    assert [*zip(pairs.clusters, pairs.instances, strict=True)] == expected
    assert pairs.features.shape == (len(expected), len(FEATURES))
    for k, (n, m) in enumerate(expected):
        assert pairs.features[k] == pytest.approx(reference(table, overlaps, found, 9, int(n), int(m)), abs=1e-6)


def test_pair_features_without_pairs_are_empty() -> None:
    rng = np.random.default_rng(0)
    overlaps = random_overlaps(rng, 2, [1])
    overlaps = replace(overlaps, votes=np.zeros_like(overlaps.votes))
    pairs = pairs_of(random_table(rng, [1]), overlaps, random_clusters(rng, 2), 9)
    assert pairs.features.shape == (0, len(FEATURES))
    assert np.isneginf(AssociationScorer.load(WEIGHTS).scores(pairs, (2, 1))).all()


def test_pair_features_of_cluster_without_points_are_finite() -> None:
    rng = np.random.default_rng(1)
    clusters = random_clusters(rng, 2)
    clusters = replace(clusters, cluster=np.zeros_like(clusters.cluster))
    assert np.isfinite(pairs_of(random_table(rng, [1]), random_overlaps(rng, 2, [1]), clusters, 9).features).all()


def random_pairs(seed: int) -> tuple[CandidatePairs, tuple[int, int]]:
    rng = np.random.default_rng(seed)
    n, m = np.nonzero(rng.uniform(size=(6, 5)) < 0.6)
    return CandidatePairs(n, m, rng.uniform(size=(len(n), len(FEATURES)))), (6, 5)


def test_scorer_is_invariant_to_order_of_instances() -> None:
    scorer = AssociationScorer.load(WEIGHTS)
    pairs, shape = random_pairs(0)
    order = np.array([3, 0, 4, 1, 2])
    scores = scorer.scores(pairs, shape)
    assert np.allclose(scorer.scores(replace(pairs, instances=order[pairs.instances]), shape)[:, order], scores)


@pytest.mark.integration
def test_scorer_does_not_depend_on_number_of_threads() -> None:
    code = (
        "import hashlib\nfrom tests.framework.mapping.instances.test_learned_association import *\n"
        "pairs, shape = random_pairs(1)\n"
        "print(hashlib.sha256(AssociationScorer.load(WEIGHTS).scores(pairs, shape).tobytes()).hexdigest())"
    )
    found = set()
    for threads in ("1", "2"):
        variables = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
        environment = {**os.environ, **variables, "PYTHONPATH": str(PROJECT_ROOT)}
        found.add(subprocess.check_output([sys.executable, "-c", code], env=environment, cwd=PROJECT_ROOT))
    assert len(found) == 1


def test_weights_are_smaller_than_one_megabyte() -> None:
    assert (PROJECT_ROOT / WEIGHTS).stat().st_size < MAX_BYTES
    assert (PROJECT_ROOT / WEIGHTS).with_suffix(".md").is_file(), "expected a model card"


def write_weights(path: Path, features: tuple[str, ...] = FEATURES, **changed: np.ndarray) -> Path:
    tensors = {name: np.zeros(shape, np.float32) for name, shape in shapes().items()} | changed
    save_file(tensors, path, {"features": json.dumps(features)})
    return path


def test_weights_without_file_raise(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"association_weights: .*expected a weights file, got none"):
        AssociationScorer.load(tmp_path / "none.safetensors")


def test_weights_of_another_format_raise(tmp_path: Path) -> None:
    path = tmp_path / "damaged.safetensors"
    path.write_bytes(b"no safetensors")
    with pytest.raises(DataError, match="expected a safetensors file"):
        AssociationScorer.load(path)


def test_weights_of_another_network_raise(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="features of this version"):
        AssociationScorer.load(PROJECT_ROOT / "plugins/detectors/mask_rcnn_rooms.safetensors")
    with pytest.raises(DataError, match="features of this version"):
        AssociationScorer.load(write_weights(tmp_path / "features.safetensors", FEATURES[:-1]))


def test_weights_with_wrong_shape_or_nan_raise(tmp_path: Path) -> None:
    wrong = {"offset": np.zeros(2, np.float32)}
    with pytest.raises(DataError, match=r"offset: expected the shape \(1,\), got \(2,\)"):
        AssociationScorer.load(write_weights(tmp_path / "shape.safetensors", **wrong))
    with pytest.raises(DataError, match="offset: expected finite weights"):
        AssociationScorer.load(write_weights(tmp_path / "nan.safetensors", offset=np.full(1, np.nan, np.float32)))
