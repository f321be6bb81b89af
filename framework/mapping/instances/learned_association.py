"""Learned association: a small attention network that scores the pairs of a cluster and an instance.

The features of a pair describe the masks, the geometry, the classes and the time since the last detection. Each cluster
attends to the instances that it overlaps with, and each instance to its clusters, so that a score depends on the
competitors. The weights were trained on synthetic rooms with simulated detectors (see
framework/training/train_association.py).

All sums have a fixed order without BLAS, so that the scores do not depend on the number of threads.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
from safetensors.numpy import load_file

from framework.data import Float64, Int64, PointClusters
from framework.errors import DataError, in_one_line
from framework.files.search_paths import candidates
from framework.mapping.instances.cluster_shapes import cluster_shapes
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.overlaps import Overlaps

WEIGHTS = Path("framework/mapping/instances/learned_association.safetensors")
WIDTH = 32  # number of hidden features
UNKNOWN_CENTER = (np.nan, np.nan, np.nan)
FEATURES = (
    "fraction of the cluster on the instance",
    "fraction of the visible instance on the cluster",
    "IoU of the cluster and the visible instance",
    "largest fraction of the cluster on another instance",
    "largest fraction of the visible instance on another cluster",
    "fraction of the cluster without an instance",
    "logarithm of the pixels of the cluster",
    "logarithm of the visible pixels of the instance",
    "distance of the centers",
    "distance of the centers relative to the extent of the cluster",
    "Bhattacharyya coefficient of the class distributions",
    "probability of the same class",
    "score of the detection",
    "mean score of the instance",
    "detection rate of the instance",
    "logarithm of the observations of the instance",
    "logarithm of the frames since the last detection",
)
"""Features of a pair. A weights file lists the features that it was trained with."""


def shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of each weight by name."""
    return {
        "pair.weight": (len(FEATURES), WIDTH),
        "pair.bias": (WIDTH,),
        "of_cluster": (WIDTH,),  # attention of a cluster to its instances
        "of_instance": (WIDTH,),  # attention of an instance to its clusters
        "match.weight": (3 * WIDTH, WIDTH),
        "match.bias": (WIDTH,),
        "match.score": (WIDTH,),
        "new.weight": (WIDTH, WIDTH),
        "new.bias": (WIDTH,),
        "new.score": (WIDTH,),
        "offset": (1,),
    }


@dataclass(frozen=True)
class CandidatePairs:
    """The P pairs of a cluster and a visible instance that share pixels, sorted by cluster, then by instance."""

    clusters: Int64  # (P,) index of the cluster
    instances: Int64  # (P,) index into Overlaps.instance_ids
    features: Float64  # (P, F)


def pairs_of(table: InstanceTable, overlaps: Overlaps, clusters: PointClusters, frame_index: int) -> CandidatePairs:
    """Return the pairs of a frame with their features.

    Args:
        table: The instance table before the frame.
        overlaps: The overlaps of the clusters with the visible instances.
        clusters: The clusters of the frame.
        frame_index: The index of the frame, from `InstanceTable.number_of`.
    """
    n, m = np.nonzero(overlaps.votes)
    if not len(n):
        return CandidatePairs(n, m, np.zeros((0, len(FEATURES))))
    records = [table.records[k] for k in overlaps.instance_ids.tolist()]
    known = np.stack([table.class_probabilities(record) for record in records]).astype(np.float64)
    found = clusters.class_probabilities.astype(np.float64)
    votes = overlaps.votes.astype(np.float64)
    on_instance = votes / np.maximum(overlaps.sizes[:, None], 1)
    on_cluster = votes / np.maximum(overlaps.visible[None, :], 1)
    centers, extents = cluster_shapes(clusters)
    located = np.array([record.viewing.center or UNKNOWN_CENTER for record in records])
    distance = np.sqrt(np.square(centers[n] - located[m]).sum(axis=1))
    distance = np.where(np.isfinite(distance), np.minimum(distance, 3.0), 0.0)  # 0 = unknown

    def of_instance(values: list[float]) -> Float64:
        return np.array(values, np.float64)[m]

    columns = [
        on_instance[n, m],
        on_cluster[n, m],
        overlaps.over_union(1)[n, m],
        _largest_other(on_instance, n, m),
        _largest_other(on_cluster.T, m, n),
        1 - on_instance.sum(axis=1)[n],
        np.log1p(overlaps.sizes[n]) / 10,
        np.log1p(overlaps.visible[m]) / 10,
        distance,
        np.minimum(distance / np.fmax(extents[n], 0.01), 5.0) / 5,
        np.sqrt(found[n] * known[m]).sum(axis=1),
        (found[n] * known[m]).sum(axis=1),
        clusters.scores[n].astype(np.float64),
        of_instance([record.mean_score for record in records]),
        of_instance([record.observations / max(record.visible, record.observations, 1) for record in records]),
        of_instance([np.log1p(record.observations) / 5 for record in records]),
        of_instance([np.log1p(max(frame_index - record.last_frame, 0)) / 5 for record in records]),
    ]
    return CandidatePairs(n, m, np.stack(columns, axis=1))


def _largest_other(values: Float64, row: Int64, column: Int64) -> Float64:
    """Return the largest value (P,) in each row that is not in the column, at least 0."""
    order = np.argsort(-values, axis=1, kind="stable")
    first = order[row, 0]
    second = values[row, order[row, 1]] if values.shape[1] > 1 else np.zeros(len(row))
    return np.asarray(np.where(first == column, second, values[row, first]))


@dataclass(frozen=True)
class AssociationScorer:
    """The network with its weights by name, see `shapes`."""

    weights: Mapping[str, Float64]

    @classmethod
    def load(cls, path: Path) -> AssociationScorer:
        """Read the weights. A relative path is searched in the working directory, then in the project.

        Raises:
            DataError: The file is missing, or it is not a weights file of this network.
        """
        where = f"association_weights: {path}"
        found = next((place for place in candidates(path) if place.is_file()), None)
        if found is None:
            raise DataError(f"{where}: expected a weights file, got none; correct the path")
        try:
            with safetensors.safe_open(found, framework="numpy") as file:
                features = (file.metadata() or {}).get("features", "none")
            tensors = load_file(found)
        except (safetensors.SafetensorError, OSError, ValueError) as error:
            raise DataError(f"{where}: expected a safetensors file, got an error ({in_one_line(error)})") from error
        if features != json.dumps(FEATURES):
            raise DataError(
                f"{where}: expected the {len(FEATURES)} features of this version in the metadata, got {features:.60}; "
                "train the network again, or use the weights of this version"
            )
        for name, shape in shapes().items():
            given = tensors[name].shape if name in tensors else "none"
            if given != shape:
                raise DataError(f"{where}: {name}: expected the shape {shape}, got {given}; train the network again")
            if not np.isfinite(tensors[name]).all():
                raise DataError(f"{where}: {name}: expected finite weights, got NaN or infinity")
        return cls({name: tensors[name].astype(np.float64) for name in shapes()})

    def scores(self, pairs: CandidatePairs, shape: tuple[int, int]) -> Float64:
        """Return the log-odds (N, M) of each pair against a new instance, -inf for pairs without shared pixels.

        Args:
            pairs: The pairs.
            shape: The number of clusters and the number of instances.
        """
        found = np.full(shape, -np.inf)
        if len(pairs.clusters):
            w = self.weights
            hidden = _layer(pairs.features, w["pair.weight"], w["pair.bias"])
            cluster = _attention(hidden, w["of_cluster"], pairs.clusters, shape[0])
            instance = _attention(hidden, w["of_instance"], pairs.instances, shape[1])
            inputs = np.concatenate([hidden, cluster[pairs.clusters], instance[pairs.instances]], axis=1)
            match = _product(_layer(inputs, w["match.weight"], w["match.bias"]), w["match.score"])
            new = _product(_layer(cluster, w["new.weight"], w["new.bias"]), w["new.score"])
            found[pairs.clusters, pairs.instances] = match + w["offset"] - new[pairs.clusters]
        return found


def _product(a: Float64, b: Float64) -> Float64:
    """Return a @ b without BLAS, whose results depend on the number of threads."""
    return np.asarray(np.einsum("pi,ij->pj" if b.ndim == 2 else "pi,i->p", a, b, optimize=False))


def _layer(a: Float64, weight: Float64, bias: Float64) -> Float64:
    return np.maximum(_product(a, weight) + bias, 0)


def _attention(hidden: Float64, query: Float64, group: Int64, count: int) -> Float64:
    """Return the mean (count, D) of the rows of each group, weighted by a softmax over the group, 0 if it is empty."""
    score = _product(hidden, query)
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, group, score)
    weight = np.exp(score - largest[group])
    sums = np.zeros((count, hidden.shape[1]))
    np.add.at(sums, group, hidden * weight[:, None])
    total = np.bincount(group, weight, count)
    return sums / np.where(total > 0, total, 1)[:, None]
