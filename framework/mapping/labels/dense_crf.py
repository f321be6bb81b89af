"""Dense conditional random field over the surface of a map (Kraehenbuehl and Koltun, 2011).

The nodes are cells of the surface. The unary potentials are the log-odds of the instances, and the pairwise potentials
are Potts terms with a Gaussian kernel of position, color and normal, as in Hermans et al. (2014):

    E(x) = - sum_i u_i(x_i) + w sum_{i<j} k_ij [x_i != x_j],    k_ij = g_ij / sqrt(d_i d_j),    d_i = sum_j g_ij

Nodes farther apart than REACH standard deviations of the position are not connected. Inference is by the mean field.
Its last step is at the vertices, so that the outlines are as fine as the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from framework.config.validation import check_bounds
from framework.data import Bool, Float32, Int32, Int64
from framework.mapping.labels.dense_crf_kernels import (
    SLOTS,
    evidence_of_vertices,
    label_vertices_by_nodes,
    mean_field_step,
    similarities,
)
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.labels.vertex_labels import Labels
from framework.mapping.storage.map_header import MapHeader
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.voxel_grid import Grid
from framework.rendering.surface import Surface

REACH = 2.5  # standard deviations of the position, maximum distance of connected nodes
CELLS = 2.0  # number of cells per standard deviation of the position
STEPS = 10  # number of steps of the mean field
UNDECIDED = 0.01  # minimum probability of another instance near the vertices that the last step labels


class Instances(NamedTuple):
    """The instances of N nodes or vertices and their log-odds over no instance, or their probabilities."""

    ids: Int32  # (N, SLOTS), 0 = free slot
    values: Float32  # (N, SLOTS)

    @classmethod
    def empty(cls, count: int) -> Instances:
        return cls(np.zeros((count, SLOTS), np.int32), np.zeros((count, SLOTS), np.float32))

    def at(self, rows: Int64) -> Instances:
        return Instances(self.ids[rows], self.values[rows])


class Pairs(NamedTuple):
    """The connected pairs of N nodes, each in both directions."""

    starts: Int32  # (N + 1,) first neighbor of each node, and number of neighbors
    neighbors: Int32  # (E,)

    @classmethod
    def within(cls, points: Float32, distance: float) -> Pairs:
        """Return the pairs of points (N, 3) within a distance."""
        i, j = cKDTree(points).query_pairs(distance, output_type="ndarray").astype(np.int32).T
        both = np.concatenate([i, j]), np.concatenate([j, i])
        table = coo_array((np.ones(len(both[0]), np.bool_), both), shape=(len(points), len(points))).tocsr()
        table.sort_indices()
        return cls(table.indptr.astype(np.int32), table.indices.astype(np.int32))


class Model(NamedTuple):
    """A random field over V vertices and N nodes."""

    features: Float32  # (V, 9) position, color and normal of the vertices, in standard deviations
    of_vertices: Instances
    nodes: Int32  # (V,) node of each vertex
    node_features: Float32  # (N, 9)
    of_nodes: Instances


@dataclass(frozen=True)
class DenseCrf:
    """Dense conditional random field that smooths the instances of the vertices."""

    # weight of the pairwise potentials of the dense conditional random field (CRF), in [0, 1000]; 0 = off
    crf_weight: float = 0.0
    crf_position: float = 0.06  # standard deviation of the distance of similar vertices, m, in [0.001, 10]
    crf_color: float = 20.0  # standard deviation of the colors of similar vertices, 8-bit levels, in [0.1, 1000]
    crf_normal: float = 0.3  # standard deviation of the unit normals of similar vertices, in [0.001, 10]
    crf_limit: float = 3.0  # maximum magnitude of the log-odds of the map, in [0, 100]

    def __post_init__(self) -> None:
        check_bounds(
            self, crf_weight=(0.0, 1000.0), crf_position=(0.001, 10.0), crf_color=(0.1, 1000.0),
            crf_normal=(0.001, 10.0), crf_limit=(0.0, 100.0),
        )  # fmt: skip

    @classmethod
    def of(cls, saved: MapHeader) -> DenseCrf:
        """Return the parameters in the header of a map file.

        Raises:
            DataError: If a value is missing or has the wrong type.
            ConfigError: If a value is out of range.
        """
        return cls(**{one.name: saved.number(one.name) for one in fields(cls)})

    def smoothed(
        self, grid: Grid, evidence: Evidence, counts: Bool, surface: UnlabeledMesh, labels: Labels, classes: Int32
    ) -> Labels:
        """Return the labels of a surface with smoothed instances.

        Args:
            grid: The voxel grid.
            evidence: The label evidence.
            counts: A Boolean array, True for the instance ids that can be assigned.
            surface: The surface.
            labels: Its labels without smoothing.
            classes: The class (last id + 1,) of the vertices that get an instance.
        """
        of_surface = Instances.empty(len(surface.vertices))
        evidence_of_vertices(grid, evidence, counts, surface.vertices, *of_surface)
        near = _near(surface.vertices, of_surface.ids[:, 0] > 0, REACH * self.crf_position)
        normals = Surface(surface.vertices, surface.triangles).vertex_normals[near]
        vertices, colors, of_vertices = surface.vertices[near], labels.colors[near], of_surface.at(near)
        cells, inverse = np.unique(self._cells(vertices, normals), return_inverse=True)
        nodes: Int32 = inverse.astype(np.int32).ravel()
        parts = (vertices / self.crf_position, colors / self.crf_color, normals / self.crf_normal)
        features = np.concatenate(parts, axis=1, dtype=np.float32)
        of_nodes = mean_instances(nodes, of_vertices, len(cells))
        model = Model(features, of_vertices, nodes, _means(nodes, features, len(cells)), of_nodes)
        instance_ids = labels.instance_ids.copy()
        instance_ids[near] = self.most_likely(model, instance_ids[near])
        changed = instance_ids != labels.instance_ids
        class_ids = np.where(changed, classes[instance_ids], labels.class_ids)
        return Labels(labels.colors, instance_ids, np.asarray(class_ids, np.int32))

    def most_likely(self, model: Model, instance_ids: Int32) -> Int32:
        """Return the most likely instance (V,) of each vertex, 0 = none.

        Args:
            model: The random field.
            instance_ids: The instances (V,) without smoothing.
        """
        pairs = Pairs.within(model.node_features[:, :3], REACH)
        scales, q = self.inferred(pairs, model.node_features, model.of_nodes)
        sure = np.where(q.values[:, 0] > 1 - UNDECIDED, q.ids[:, 0], np.where(q.values.sum(axis=1) < UNDECIDED, 0, -1))
        decided = _unanimous(pairs, sure)
        open_nodes = np.where(decided, np.int32(-1), np.arange(len(sure), dtype=np.int32))
        smoothed = np.where(decided[model.nodes], sure[model.nodes], instance_ids).astype(np.int32)
        label_vertices_by_nodes(
            open_nodes[model.nodes], model.features, *pairs, model.node_features, scales, *model.of_vertices,
            np.float32(self.crf_limit), *q, smoothed,
        )  # fmt: skip
        return smoothed

    def inferred(self, pairs: Pairs, features: Float32, unary: Instances) -> tuple[Float32, Instances]:
        """Return the factor (N,) of the weights of each node, and the distributions of the nodes by the mean field."""
        weights = np.empty(len(pairs.neighbors), np.float32)
        similarities(features, *pairs, weights)
        sources = np.repeat(np.arange(len(features)), np.diff(pairs.starts))
        degrees = np.bincount(sources, weights, len(features))
        scales = np.sqrt(self.crf_weight / np.maximum(degrees, np.finfo(np.float32).tiny)).astype(np.float32)
        weights *= scales[sources] * scales[pairs.neighbors]
        limit = np.float32(self.crf_limit)
        q, free = Instances.empty(len(features)), Instances.empty(len(features))
        mean_field_step(*pairs, np.zeros_like(weights), *unary, limit, *free, *q)  # from the unary potentials alone
        for _ in range(STEPS):
            mean_field_step(*pairs, weights, *unary, limit, *q, *free)
            q, free = free, q
        return scales, q

    def _cells(self, vertices: Float32, normals: Float32) -> Int64:
        """Return a number (V,) for the cell of each vertex: cubes, divided by the main direction of the normal."""
        coords = np.floor(vertices * (CELLS / self.crf_position)).astype(np.int64)
        coords -= coords.min(axis=0, initial=0)
        axis = np.abs(normals).argmax(axis=1)
        faces = 2 * axis + (normals[np.arange(len(normals)), axis] > 0)
        size = coords.max(axis=0, initial=0) + 1
        return np.asarray(((coords[:, 2] * size[1] + coords[:, 1]) * size[0] + coords[:, 0]) * 6 + faces)


def _near(points: Float32, chosen: Bool, side: float) -> Int64:
    """Return the indices of the points (V, 3) in the cubes of chosen points and next to them. `side` is in m."""
    cubes = np.floor(points / side).astype(np.int64)
    cubes -= cubes.min(axis=0, initial=0) - 1
    size = cubes.max(axis=0, initial=0) + 2
    steps = np.array([size[1] * size[2], size[2], 1])
    keys = cubes @ steps
    offsets = np.array([*product((-1, 0, 1), repeat=3)]) @ steps
    around = np.unique(np.unique(keys[chosen])[:, None] + offsets)
    return np.flatnonzero(np.isin(keys, around))


def _means(nodes: Int32, values: Float32, count: int) -> Float32:
    """Return the mean values (N, F) of the vertices (V, F) of each node."""
    sizes = np.bincount(nodes, minlength=count)
    columns = [np.bincount(nodes, column, count) / sizes for column in values.T]
    return np.stack(columns, axis=1).astype(np.float32)


def mean_instances(nodes: Int32, found: Instances, count: int) -> Instances:
    """Return the instances of N nodes with the largest mean log-odds of their vertices."""
    vertex, slot = np.nonzero(found.ids > 0)
    owners, ids = nodes[vertex].astype(np.int64), found.ids[vertex, slot].astype(np.int64)
    keys, positions = np.unique(owners << 32 | ids, return_inverse=True)
    owners, ids = keys >> 32, keys & 0xFFFFFFFF
    sums = np.bincount(positions.ravel(), found.values[vertex, slot], len(keys))
    means = sums / np.bincount(nodes, minlength=count)[owners]
    order = np.lexsort((ids, -means, owners))
    owners, ids, means = owners[order], ids[order], means[order]
    ranks = np.arange(len(owners)) - np.searchsorted(owners, owners)
    kept = ranks < SLOTS
    merged = Instances.empty(count)
    merged.ids[owners[kept], ranks[kept]] = ids[kept]
    merged.values[owners[kept], ranks[kept]] = means[kept]
    return merged


def _unanimous(pairs: Pairs, sure: Int32) -> Bool:
    """Return True for each node (N,) that has the same sure instance (N,) as all its neighbors; -1 = not sure."""
    differs = np.repeat(sure, np.diff(pairs.starts)) != sure[pairs.neighbors]
    sources = np.repeat(np.arange(len(sure)), np.diff(pairs.starts))
    return np.asarray((sure >= 0) & (np.bincount(sources[differs], minlength=len(sure)) == 0))
