"""Label evidence in the voxels: how likely each instance and each class is there, and how a frame changes that.

The paper's rule is the voxel-wise Bayesian update, two independent recursions, eqs. [7] and [8]:

    P(c | I_1..t) = (1/Z) P(c | I_1..t-1) P(O_u = c | I_t)

In log space it is a sum of log-likelihoods, from a uniform start. Only the ratios between labels matter, so a voxel
stores each label's sum relative to the labels that nobody named there, whose sum is 0 by that definition ("the rest").
Other rules (a count of detections, the latest one, the most confident one) keep other numbers in the same place, and
differ in how new evidence for a label meets the old one: `Combine`.

Compact storage keeps a voxel's likeliest instances and classes and drops the least likely one when another one is
named (an eviction, counted). What a dropped or unnamed label would have gained over the rest is lost. Exact storage has
a slot for every class, and as many for instances as no voxel ever fills: the oracle that the compact one is compared
with. On real detections (maskrcnn2go, replica_floor2) the likeliest instance is the same in every labelled voxel, the
likeliest class in 99.6 %; with 12 class slots in 99.5 %, with a slot for each of the 80 classes in 99.6 %, too: what
speaks for a class before somebody names it is lost.

Class evidence is kept in whole units, so that it can be small and its sums do not depend on their order.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Bool, Float32, Float64, Int32, UInt8
from framework.mapping.labels.class_slots import (
    ALL_NAMED,
    NEW_CLASSES,
    NO_CLASS,
    add_said,
    least_likely_slot,
    likeliest_slot,
)
from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.voxel_grid import device

Integers = npt.NDArray[Any]  # of int16, int32 or int64

MOST_UNITS = 30_000  # of class evidence in compact storage; where more speaks for a class, all lose what is too much
MOST_GAIN = 2**15 - 1 - MOST_UNITS  # units that one cluster may add there: what int16 has room for


class Combine(IntEnum):
    """How a label's new evidence meets the old one."""

    SUM = 0
    LARGEST = 1
    LATEST = 2  # which also forgets what the other labels had


UNBOUNDED = np.float32(np.inf)
SUM, LARGEST, LATEST = (int(combine) for combine in Combine)  # for the kernels


class Evidence(NamedTuple):
    """How much speaks for each label, relative to every label not named. The best label is always in slot 0.

    The slots of a voxel lie together, 80 bytes in compact storage: voxels are seen in no order, and what waits for the
    memory is then two cache lines, not four. So the arrays of slots are views of one.
    """

    labeled: Int32  # (R, 512) the number of a voxel among those that have slots, -1 = it has none
    instance_ids: Int32  # (L, S), 0 = free slot
    instance_value: Float32  # (L, S)
    class_ids: UInt8  # (L, T), NO_CLASS = free slot
    class_value: Integers  # (L, T) units, int16 or in exact storage int64


class Measurement(NamedTuple):
    """What one frame's clusters say: N clusters, C classes."""

    of_pixel: Int32  # (H, W) the number of each pixel's list of clusters, as in PixelLists, 0 = under none
    first: Int32  # (L + 1,) where the clusters of each list begin
    cluster: Int32  # (first[L],) those that were associated with an instance: others say nothing
    instance_id: Int32  # (N,) the instance that each cluster was associated with, 0 = none
    instance_gain: Float32  # (N,) for that instance, over any other
    absence: np.float32  # not above 0, for an instance matched in this frame but not seen here
    matched: Bool  # (ids + 1,) which instances were matched in this frame, by id
    class_said: Integers  # (N, NO_CLASS + 1) int32 or, for exact storage, int64: of each class and none, class_said()
    named_classes: UInt8  # (N, NEW_CLASSES) each cluster's best classes
    combine: int  # Combine
    most_units: int  # that a class may have


def named_classes(evidence: Float64, logarithmic: bool) -> tuple[Float64, UInt8, UInt8]:
    """What clusters say of classes, evidence (N, C): (gains (N, C), named_classes, named_bit), the latter two as a
    Measurement has them.

    Of log-likelihoods a cluster names its NEW_CLASSES best classes, and the others share the mean of what is left;
    otherwise it names its best one, and for those that it does not name it says nothing.
    """
    c = evidence.shape[1]
    names = min(c, NEW_CLASSES) if logarithmic else min(c, 1)
    named = np.argsort(-evidence, axis=1, kind="stable")[:, :names]
    gains = evidence
    if logarithmic:
        rest = np.exp(evidence)
        if c > names:
            np.put_along_axis(rest, named, 0, axis=1)
            mean = rest.sum(axis=1, keepdims=True) / (c - names)
        else:  # none is left: what is common to all classes says nothing
            mean = rest.min(axis=1, keepdims=True, initial=1.0)
        gains = evidence - np.log(np.maximum(mean, 1e-6))
    bits = np.zeros((len(evidence), NO_CLASS + 1), np.uint8)
    np.put_along_axis(bits, named, np.uint8(1) << np.arange(names, dtype=np.uint8)[None], axis=1)
    again = np.repeat(named[:, :1], NEW_CLASSES - names, axis=1)  # names the first one again, which changes nothing
    return gains, np.concatenate([named, again], axis=1).astype(np.uint8), bits


def class_said(gains: Float64, units: int, named_bit: UInt8, kind: type[np.signedinteger[Any]]) -> Integers:
    """What clusters say of each class in one number, so that a voxel looks up one: the `gains` (N, C) over those that
    the cluster does not name, in whole units, times 2^NEW_CLASSES, and in the lowest bits the class's `named_bit`.
    """
    said = named_bit.astype(np.int64)
    said[:, : gains.shape[1]] += np.rint(gains * units).astype(np.int64) << NEW_CLASSES
    return said.astype(kind)


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
