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

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Bool, Float32, Float64, Int32, UInt8
from framework.mapping.labels.class_slots import (
    NEW_CLASSES,
    NO_CLASS,
)

Integers = npt.NDArray[Any]  # of int16, int32 or int64
MOST_UNITS = 30_000  # of class evidence in compact storage; where more speaks for a class, all lose what is too much
MOST_GAIN = 2**15 - 1 - MOST_UNITS  # units that one cluster may add there: what int16 has room for


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
