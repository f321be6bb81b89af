"""Kernels of label_evidence.py."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from framework.mapping.labels.class_slots import (
    ALL_NAMED,
    NEW_CLASSES,
    NO_CLASS,
    add_scores,
    least_likely_slot,
    most_likely_slot,
)
from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.voxel_grid_kernels import device


class Combine(IntEnum):
    """Rule for combining new and old evidence for a label."""

    SUM = 0
    LARGEST = 1
    LATEST = 2  # the new label replaces all others


UNBOUNDED = np.float32(np.inf)  # `limit` of add_evidence() for unlimited sums
SUM, LARGEST, LATEST = (int(combine) for combine in Combine)  # for the kernels


@device
def label_row(grid, block):
    """Return the evidence row of a block, -1 = none."""
    return grid.label_row[block] if block >= 0 else np.int32(-1)


@device
def labeled_voxel(grid, evidence, block, n):
    """Return the index of voxel n of a block among the labeled voxels, -1 = none.

    The block is -1 if it is not allocated.
    """
    row = label_row(grid, block)
    return evidence.labeled[row, n] if row >= 0 else np.int32(-1)


@device
def best_instance(evidence, voxel):
    """Return the most likely instance of a labeled voxel, 0 = none."""
    return evidence.instance_ids[voxel, 0] if evidence.instance_value[voxel, 0] > 0 else np.int32(0)


@device
def best_counted_instance(evidence, voxel, counts):
    """Return the most likely instance of a labeled voxel with `counts[id]` True, 0 = none."""
    best = np.int32(0)
    best_value = np.float32(0.0)
    for s in range(evidence.instance_ids.shape[1]):
        label = evidence.instance_ids[voxel, s]
        if label > 0 and counts[label]:
            value = evidence.instance_value[voxel, s]
            if value > best_value or (value == best_value and label < best):
                best = label
                best_value = value
    return best


@device
def best_class(evidence, voxel):
    """Return the most likely class of a labeled voxel, as an index into the classes."""
    return np.int32(evidence.class_ids[voxel, 0] - 1)


@device
def add_evidence(labels, values, free, label, added, combine, limit):
    """Add evidence for one label to the slots of a voxel.

    If all slots are used, the label replaces the least likely label, unless that label has at least as much evidence.
    Returns 1 if a label was evicted or not stored, otherwise 0.

    Args:
        labels: The labels (S,) in the slots, modified in place.
        values: The values (S,) of the slots, modified in place.
        free: The label of a free slot.
        label: The label.
        added: The evidence for the label.
        combine: The rule for combining new and old evidence.
        limit: The maximum absolute value of a sum.
    """
    if combine == LATEST:
        for s in range(1, len(labels)):
            labels[s] = free
        labels[0] = label
        values[0] = added
        return 0
    least = 0
    for s in range(len(labels)):
        if labels[s] == label:
            values[s] = min(max(values[s] + added, -limit), limit) if combine == SUM else max(values[s], added)
            return 0
        if labels[s] == free:
            labels[s] = label
            values[s] = added
            return 0
        if values[s] < values[least]:
            least = s
    if values[least] >= added:
        return 1  # the new label itself is the least likely
    labels[least] = label
    values[least] = added
    return 1


@device
def best_first(labels, values, free):
    """Swap the most likely label into slot 0."""
    best = 0
    for s in range(1, len(labels)):
        if labels[s] == free:  # slots are filled from the front
            break
        # ties go to the smaller label, so that slot order has no effect
        if values[s] > values[best] or (values[s] == values[best] and labels[s] < labels[best]):
            best = s
    if best > 0:
        labels[0], labels[best] = labels[best], labels[0]
        values[0], values[best] = values[best], values[0]


@device
def best_class_first(classes, scores):
    """Swap the most likely class into slot 0."""
    best = most_likely_slot(classes, scores)
    if best > 0:
        classes[0], classes[best] = classes[best], classes[0]
        scores[0], scores[best] = scores[best], scores[0]


@device
def sum_classes(classes, scores, measurement, k):
    """Add the class scores of cluster k to the slots of a voxel.

    Returns the number of classes that were evicted or not stored.
    """
    limit, cluster_scores = measurement.max_score, measurement.class_scores[k]
    known, filled, excess = add_scores(classes, scores, cluster_scores, limit)
    for s in range(filled if excess > 0 else 0):  # subtracting preserves the differences between scores
        scores[s] = max(scores[s] - excess, -limit)
    evicted = 0
    rejected = False
    missing = np.uint64(ALL_NAMED & ~known)
    while missing != np.uint64(0):
        m = lowest_bit(missing)
        missing &= missing - ONE
        label = measurement.named_classes[k, m]
        if m > 0 and label == measurement.named_classes[k, 0]:
            break
        evicted += rejected
        if rejected:
            continue  # later classes have lower scores
        score = cluster_scores[label] >> NEW_CLASSES
        slot = filled
        if filled < len(classes):
            filled += 1
        else:
            evicted += 1
            slot = least_likely_slot(scores)
            rejected = scores[slot] >= score  # the new class itself is the least likely
        if not rejected:
            classes[slot] = label
            scores[slot] = score
    return evicted


@device
def update_voxel(evidence, voxel, measurement, list_id):
    """Update the instance and class evidence of a labeled voxel, and return the number of evicted labels.

    The evidence comes from the clusters in a list, which are those at the pixel of the voxel.
    """
    start, end = measurement.offsets[list_id], measurement.offsets[list_id + 1]
    ids = evidence.instance_ids[voxel]
    id_values = evidence.instance_value[voxel]
    classes = evidence.class_ids[voxel]
    class_values = evidence.class_value[voxel]
    combine = measurement.combine
    evicted = 0
    absent = False
    named = start < end
    # evidence of absence: the instance was matched in this frame, but not at this pixel
    for s in range(len(ids) if measurement.absence < 0 else 0):
        if ids[s] == 0:  # slots are filled from the front
            break
        if measurement.matched[ids[s]]:
            covered = False
            for entry in range(start, end):
                covered = covered or measurement.instance_id[measurement.clusters[entry]] == ids[s]
            if not covered:
                id_values[s] += measurement.absence
                absent = True
    for entry in range(start, end):
        k = measurement.clusters[entry]
        instance = measurement.instance_id[k]
        if instance > 0:
            evicted += add_evidence(ids, id_values, 0, instance, measurement.instance_log_odds[k], combine, UNBOUNDED)
        if combine == SUM:
            evicted += sum_classes(classes, class_values, measurement, k)
        else:
            for m in range(NEW_CLASSES):
                label = measurement.named_classes[k, m]
                if m > 0 and label == measurement.named_classes[k, 0]:
                    break
                score = measurement.class_scores[k, label] >> NEW_CLASSES
                evicted += add_evidence(classes, class_values, NO_CLASS, label, score, combine, measurement.max_score)
    if (named or absent) and ids[1] != 0:
        best_first(ids, id_values, 0)
    if named:
        best_class_first(classes, class_values)
    return evicted
