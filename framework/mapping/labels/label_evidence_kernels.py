"""Kernels of label_evidence.py."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from framework.mapping.labels.class_slots import (
    ALL_NAMED,
    NEW_CLASSES,
    NO_CLASS,
    add_said,
    least_likely_slot,
    likeliest_slot,
)
from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.voxel_grid_kernels import device


class Combine(IntEnum):
    """How a label's new evidence meets the old one."""

    SUM = 0
    LARGEST = 1
    LATEST = 2  # which also forgets what the other labels had


UNBOUNDED = np.float32(np.inf)
SUM, LARGEST, LATEST = (int(combine) for combine in Combine)  # for the kernels


@device
def label_row(grid, block):
    """The row of a block, -1 = of none, in Evidence.labeled; -1 if it has none."""
    return grid.label_row[block] if block >= 0 else np.int32(-1)


@device
def labeled_voxel(grid, evidence, block, n):
    """The number of voxel n of a block, -1 = of none, among those that have slots; -1 if it has none."""
    row = label_row(grid, block)
    return evidence.labeled[row, n] if row >= 0 else np.int32(-1)


@device
def best_instance(evidence, voxel):
    """The most likely instance of a labelled voxel, 0 when none is more likely than the rest."""
    return evidence.instance_ids[voxel, 0] if evidence.instance_value[voxel, 0] > 0 else np.int32(0)


@device
def next_instance(evidence, voxel):
    """The most likely instance of a labelled voxel after that in slot 0, 0 when none is more likely than the rest."""
    best = np.int32(0)
    best_value = np.float32(0.0)
    for s in range(1, evidence.instance_ids.shape[1]):
        label, value = evidence.instance_ids[voxel, s], evidence.instance_value[voxel, s]
        if label > 0 and (value > best_value or (value == best_value and label < best)):
            best = label
            best_value = value
    return best


@device
def best_counted_instance(evidence, voxel, counts):
    """The most likely instance of a labelled voxel among those that count, by id in counts; 0 when none is likelier
    than the rest.
    """
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
    """The most likely class of a labelled voxel."""
    return np.int32(evidence.class_ids[voxel, 0])


@device
def add_evidence(labels, values, free, label, gain, combine, most):
    """Combines `gain` with a label's slot, to at most `most`, or gives it the free or least likely one.

    Returns 1 when that evicted another.
    """
    if combine == LATEST:
        for s in range(1, len(labels)):
            labels[s] = free
        labels[0] = label
        values[0] = gain
        return 0
    least = 0
    for s in range(len(labels)):
        if labels[s] == label:
            values[s] = min(max(values[s] + gain, -most), most) if combine == SUM else max(values[s], gain)
            return 0
        if labels[s] == free:
            labels[s] = label
            values[s] = gain
            return 0
        if values[s] < values[least]:
            least = s
    if values[least] >= gain:
        return 1  # the newcomer is itself the least likely: it is the one that is dropped
    labels[least] = label
    values[least] = gain
    return 1


@device
def best_first(labels, values, free):
    """Moves the most likely label to slot 0; ties go to the smaller label, so that the order of arrival does not
    matter.
    """
    best = 0
    for s in range(1, len(labels)):
        if labels[s] == free:  # slots are filled from the front
            break
        if values[s] > values[best] or (values[s] == values[best] and labels[s] < labels[best]):
            best = s
    if best > 0:
        labels[0], labels[best] = labels[best], labels[0]
        values[0], values[best] = values[best], values[0]


@device
def best_class_first(classes, units):
    """best_first() of class slots."""
    best = likeliest_slot(classes, units)
    if best > 0:
        classes[0], classes[best] = classes[best], classes[0]
        units[0], units[best] = units[best], units[0]


@device
def sum_classes(classes, units, measurement, k):
    """Adds what cluster k says to the class slots of a voxel.

    Returns the number of evictions.
    """
    most, said_by = measurement.most_units, measurement.class_said[k]
    known, filled, too_much = add_said(classes, units, said_by, most)
    for s in range(filled if too_much > 0 else 0):  # the distances stay, and with them the likeliest class
        units[s] = max(units[s] - too_much, -most)
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
            continue  # so is each one after it, of which the cluster says less
        gain = said_by[label] >> NEW_CLASSES
        place = filled
        if filled < len(classes):
            filled += 1
        else:
            evicted += 1
            place = least_likely_slot(units)
            rejected = units[place] >= gain  # the newcomer is itself the least likely: it is the one that is dropped
        if not rejected:
            classes[place] = label
            units[place] = gain
    return evicted


@device
def update_voxel(evidence, voxel, measurement, number):
    """Both recursions for one labelled voxel, seen at a pixel with that `number` of a list of clusters.

    Returns the number of evictions.
    """
    first, last = measurement.first[number], measurement.first[number + 1]
    ids = evidence.instance_ids[voxel]
    id_values = evidence.instance_value[voxel]
    classes = evidence.class_ids[voxel]
    class_values = evidence.class_value[voxel]
    combine = measurement.combine
    evicted = 0
    absent = False
    said = first < last
    # evidence of absence: an instance that was found in this frame, but not here
    for s in range(len(ids) if measurement.absence < 0 else 0):
        if ids[s] == 0:  # slots are filled from the front
            break
        if measurement.matched[ids[s]]:
            covered = False
            for place in range(first, last):
                covered = covered or measurement.instance_id[measurement.cluster[place]] == ids[s]
            if not covered:
                id_values[s] += measurement.absence
                absent = True
    for place in range(first, last):
        k = measurement.cluster[place]
        evicted += add_evidence(
            ids, id_values, 0, measurement.instance_id[k], measurement.instance_gain[k], combine, UNBOUNDED
        )
        if combine == SUM:
            evicted += sum_classes(classes, class_values, measurement, k)
        else:
            for m in range(NEW_CLASSES):
                label = measurement.named_classes[k, m]
                if m > 0 and label == measurement.named_classes[k, 0]:
                    break
                gain = measurement.class_said[k, label] >> NEW_CLASSES
                evicted += add_evidence(classes, class_values, NO_CLASS, label, gain, combine, measurement.most_units)
    if (said or absent) and ids[1] != 0:
        best_first(ids, id_values, 0)
    if said:
        best_class_first(classes, class_values)
    return evicted
