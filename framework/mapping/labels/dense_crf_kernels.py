"""Kernels of dense_crf.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.label_evidence_kernels import labeled_voxel
from framework.mapping.labels.vertex_labels_kernels import CHUNK, CORNERS, corner_voxels, keep_near
from framework.mapping.voxels.voxel_grid_kernels import device

SLOTS = 6  # maximum number of instances with a probability at a node
CANDIDATES = 64  # maximum number of instances that are compared at a node
ABSENT = np.float32(-1.0)  # log-odds, over no instance, of an instance without evidence at a node


@device
def _add(labels, values, count, label, value):
    """Add a value to a label of the list, and return the new number of labels. A full list ignores new labels."""
    for n in range(count):
        if labels[n] == label:
            values[n] += value
            return count
    if count == len(labels):
        return count
    labels[count], values[count] = label, value
    return count + 1


@device
def _keep_largest(labels, values, count, out_labels, out_values):
    """Write the labels with the largest values, in descending order. Equal values are in ascending order of labels."""
    for s in range(len(out_labels)):
        best = -1
        for n in range(count):
            if labels[n] > 0 and (
                best < 0 or values[n] > values[best] or (values[n] == values[best] and labels[n] < labels[best])
            ):
                best = n
        out_labels[s], out_values[s] = (labels[best], values[best]) if best >= 0 else (np.int32(0), np.float32(0.0))
        if best >= 0:
            labels[best] = 0


@njit(cache=True, nogil=True, parallel=True)
def evidence_of_vertices(grid, evidence, counts, vertices, labels, values):
    """Write the instances with most evidence around each vertex, and their log-odds over no instance.

    The log-odds are means over the eight voxels, weighted trilinearly.

    Args:
        grid: The voxel grid.
        evidence: The label evidence.
        counts: A Boolean array, True for the instance ids that can be assigned.
        vertices: The vertices (V, 3), m.
        labels: The output (V, SLOTS), 0 = none.
        values: The output (V, SLOTS).
    """
    for chunk in prange(-(-len(vertices) // CHUNK)):
        blocks, voxels = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        weights = np.empty(CORNERS, np.float32)
        found, sums = np.empty(CANDIDATES, np.int32), np.empty(CANDIDATES, np.float32)
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(vertices))):
            count, total = 0, np.float32(0.0)
            if corner_voxels(grid, vertices[v], blocks, voxels, weights):
                keep_near(grid, blocks, voxels, weights)
                for c in range(CORNERS):
                    total += weights[c]
                    voxel = labeled_voxel(grid, evidence, blocks[c], voxels[c]) if weights[c] > 0 else np.int32(-1)
                    for s in range(evidence.instance_ids.shape[1] if voxel >= 0 else 0):
                        label = evidence.instance_ids[voxel, s]
                        if label > 0 and counts[label]:
                            count = _add(found, sums, count, label, weights[c] * evidence.instance_value[voxel, s])
            for n in range(count):
                sums[n] /= total
            _keep_largest(found, sums, count, labels[v], values[v])


@device
def _similarity(a, b):
    """Return the Gaussian kernel of two feature vectors, which are in standard deviations."""
    square = np.float32(0.0)
    for k in range(len(a)):
        square += (a[k] - b[k]) * (a[k] - b[k])
    return np.exp(np.float32(-0.5) * square)


@njit(cache=True, nogil=True, parallel=True)
def similarities(features, starts, neighbors, weights):
    """Write the Gaussian kernel of each pair of neighbors to `weights` (E,), in the order of `neighbors`.

    Args:
        features: The features (N, F) of the nodes, in standard deviations.
        starts: The first neighbor (N + 1,) of each node, and the number of neighbors.
        neighbors: The neighbors (E,) of all nodes.
        weights: The output.
    """
    for i in prange(len(starts) - 1):
        for e in range(starts[i], starts[i + 1]):
            weights[e] = _similarity(features[i], features[neighbors[e]])


@device
def _add_unary(labels, values, count, own_labels, own_values, limit):
    """Add the log-odds of the instances at a node, limited to [-limit, limit], to those from its neighbors."""
    for n in range(count):
        values[n] += ABSENT
    for s in range(len(own_labels)):
        if own_labels[s] > 0:
            value = min(max(own_values[s], -limit), limit)
            before = count
            count = _add(labels, values, count, own_labels[s], value - ABSENT)
            if count > before:
                values[before] = value
    return count


@njit(cache=True, nogil=True, parallel=True)
def mean_field_step(starts, neighbors, weights, labels, values, limit, q_labels, q, new_labels, new_q):
    """Update the distributions of all nodes once, in parallel.

    The probability of no instance is 1 minus the sum of a row of `q`.

    Args:
        starts: The first neighbor (N + 1,) of each node, and the number of neighbors.
        neighbors: The neighbors (E,) of all nodes.
        weights: The weights (E,) of the pairs.
        labels: The instances (N, SLOTS) with evidence at each node, 0 = none.
        values: Their log-odds (N, SLOTS) over no instance.
        limit: The maximum magnitude of log-odds.
        q_labels: The instances (N, SLOTS) of the last distributions.
        q: Their probabilities (N, SLOTS).
        new_labels: The instances of the new distributions, an output.
        new_q: Their probabilities, an output.
    """
    for i in prange(len(starts) - 1):
        found, sums = np.empty(CANDIDATES, np.int32), np.empty(CANDIDATES, np.float32)
        count, none = 0, np.float32(0.0)
        for e in range(starts[i], starts[i + 1]):
            j, rest = neighbors[e], np.float32(1.0)
            for s in range(SLOTS):
                if q_labels[j, s] > 0:
                    count = _add(found, sums, count, q_labels[j, s], weights[e] * q[j, s])
                    rest -= q[j, s]
            none += weights[e] * rest
        count = _add_unary(found, sums, count, labels[i], values[i], limit)
        _keep_largest(found, sums, count, new_labels[i], new_q[i])
        largest = max(none, new_q[i, 0]) if new_labels[i, 0] > 0 else none
        total = np.exp(none - largest)
        for s in range(SLOTS):
            new_q[i, s] = np.exp(new_q[i, s] - largest) if new_labels[i, s] > 0 else np.float32(0.0)
            total += new_q[i, s]
        for s in range(SLOTS):
            new_q[i, s] /= total


@njit(cache=True, nogil=True, parallel=True)
def label_vertices_by_nodes(
    nodes, features, starts, neighbors, node_features, scales, labels, values, limit, q_labels, q, instance_ids
):
    """Write the most likely instance (V,) of each vertex, 0 = none: the last step of the mean field at the vertices.

    Args:
        nodes: The node (V,) of each vertex, -1 = the instance does not change.
        features: The features (V, F) of the vertices, in standard deviations.
        starts: The first neighbor (N + 1,) of each node, and the number of neighbors.
        neighbors: The neighbors (E,) of all nodes.
        node_features: The features (N, F) of the nodes.
        scales: The factor (N,) of the weights of each node.
        labels: The instances (V, SLOTS) with evidence at each vertex, 0 = none.
        values: Their log-odds (V, SLOTS) over no instance.
        limit: The maximum magnitude of log-odds.
        q_labels: The instances (N, SLOTS) of the distributions of the nodes.
        q: Their probabilities (N, SLOTS).
        instance_ids: The instances (V,), changed in place.
    """
    for chunk in prange(-(-len(nodes) // CHUNK)):
        found, sums = np.empty(CANDIDATES, np.int32), np.empty(CANDIDATES, np.float32)
        best, score = np.empty(1, np.int32), np.empty(1, np.float32)
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(nodes))):
            i = nodes[v]
            if i < 0:
                continue
            count, none = 0, np.float32(0.0)
            for e in range(starts[i], starts[i + 1]):
                j, rest = neighbors[e], np.float32(1.0)
                weight = scales[i] * scales[j] * _similarity(features[v], node_features[j])
                for s in range(SLOTS):
                    if q_labels[j, s] > 0:
                        count = _add(found, sums, count, q_labels[j, s], weight * q[j, s])
                        rest -= q[j, s]
                none += weight * rest
            count = _add_unary(found, sums, count, labels[v], values[v], limit)
            _keep_largest(found, sums, count, best, score)
            instance_ids[v] = best[0] if score[0] > none else np.int32(0)
