"""Label evidence of the voxels: the likelihood of each instance and class.

The paper updates each voxel by two independent Bayesian recursions, eqs. (7) and (8) of docs/method.md:

    P(c | I_1..t) = (1/Z) P(c | I_1..t-1) P(O_u = c | I_t)

Here, c is a class or an instance, I_t is image t, O_u is the label observed at the pixel u of the voxel, and Z
normalizes the distribution.

In log space, the update is a sum of log-likelihoods. A cluster *names* its instance and its most likely classes. A
voxel stores the log-odds of each label that a cluster named at this voxel over the unnamed labels. Other label rules
combine new and old evidence differently; see `Combine`.

A block has an evidence row if any of its voxels has labels. Each labeled voxel has S instance slots and T class slots.
There are B blocks, R rows and L labeled voxels.

    grid.label_row[block] ----> labeled[row, n] -------> instance_ids[voxel, :]   instance_value[voxel, :]
       -1 = no row                -1 = no slots          class_ids[voxel, :]      class_value[voxel, :]
       (B,)                       (R, 512)               (L, S) and (L, T), best label in slot 0

Compact storage keeps only the most likely labels. If a new label needs a slot, the least likely label is evicted, and
its evidence is lost. Exact storage keeps all labels. Class evidence is quantized, so that it is small and independent
of the order of summation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Bool, Float32, Float64, Int32, UInt8, UInt16
from framework.mapping.labels.class_slots import NEW_CLASSES, ClassIds

Integers = npt.NDArray[Any]  # of int16, int32 or int64
MAX_SCORE = 30_000  # maximum quantized class score in compact storage; the excess is subtracted from all scores
LARGEST_SCORE = 2**62  # maximum quantized class score in exact storage
MAX_CLUSTER_SCORE = 2**15 - 1 - MAX_SCORE  # maximum quantized score of a cluster; a larger one could overflow int16

# log-odds of the most likely class over a class that no detector could detect; exp(-UNSEEN) is 0 in float32
UNSEEN = 110.0


class Evidence(NamedTuple):
    """The label evidence of all voxels.

    See the module docstring. The arrays of slots are views of one structured array, so that the slots of a voxel are
    contiguous in memory.
    """

    labeled: Int32  # (R, 512) index of a voxel among the voxels with slots, -1 = no slots
    instance_ids: Int32  # (L, S), 0 = free slot; all slots are free if only unmatched clusters updated the voxel
    instance_value: Float32  # (L, S) log-odds over the unnamed instances
    class_ids: ClassIds  # (L, T) in [1, C], 0 = free slot
    class_value: Integers  # (L, T) quantized scores over the unnamed classes; int16, in exact storage int64


class Measurement(NamedTuple):
    """The evidence of the N clusters of one frame for C classes."""

    list_ids: Int32  # (H, W) list of clusters of each pixel, 0 = no cluster; see PixelLists
    offsets: Int32  # (L + 1,) start of each of the L lists in `clusters`
    clusters: Int32  # (offsets[L],) clusters that update voxels
    instance_id: Int32  # (N,) instance associated with each cluster, 0 = none
    instance_log_odds: Float32  # (N,) log-odds of that instance over any other instance
    absence: np.float32  # log-odds, <= 0, of a matched instance in voxels outside its mask
    matched: Bool  # (ids + 1,) indexed by id, True where an instance was matched in this frame
    class_scores: Integers  # (N, C + 1) quantized scores by class id with named bits; int32, in exact storage int64
    named_classes: UInt16  # (N, NEW_CLASSES) ids of the most likely classes of each cluster
    combine: int  # rule for combining new and old evidence, a value of Combine
    max_score: int  # maximum quantized score of a class in a voxel


def named_classes(evidence: Float64, logarithmic: bool) -> tuple[Float64, UInt16, UInt8]:
    """Return the class evidence relative to the unnamed classes, the named classes and their bits.

    With log-likelihoods, a cluster names its NEW_CLASSES most likely classes. Every unnamed class gets the mean
    likelihood of the unnamed classes. Otherwise, a cluster names only its most likely class.

    Args:
        evidence: The class evidence (N, C) of the clusters.
        logarithmic: True if the evidence consists of log-likelihoods.

    Returns:
        The relative evidence (N, C).
        The ids (N, NEW_CLASSES) of the named classes, padded with the first named class.
        The bits (N, C + 1) by class id, 2^m for the m-th named class and 0 for unnamed classes.
    """
    c = evidence.shape[1]
    names = min(c, NEW_CLASSES) if logarithmic else min(c, 1)
    named = np.argsort(-evidence, axis=1, kind="stable")[:, :names]
    relative = evidence
    if logarithmic:
        unnamed = np.exp(evidence)
        if c > names:
            np.put_along_axis(unnamed, named, 0, axis=1)
            mean = unnamed.sum(axis=1, keepdims=True) / (c - names)
        else:  # all classes are named; a term common to all classes is not evidence
            mean = unnamed.min(axis=1, keepdims=True, initial=1.0)
        relative = evidence - np.log(np.maximum(mean, 1e-6))
    bits = np.zeros((len(evidence), c + 1), np.uint8)
    np.put_along_axis(bits, named + 1, np.uint8(1) << np.arange(names, dtype=np.uint8)[None], axis=1)
    again = np.repeat(named[:, :1], NEW_CLASSES - names, axis=1)
    return relative, (np.concatenate([named, again], axis=1) + 1).astype(np.uint16), bits


def pack_class_scores(relative: Float64, scale: int, named_bit: UInt8, kind: type[np.signedinteger[Any]]) -> Integers:
    """Return the quantized class evidence (N, C + 1) of the clusters by class id, packed with the named bits.

    An entry contains the named bit in its lowest NEW_CLASSES bits, and the quantized evidence above. A single look-up
    then reads both.

    Args:
        relative: The class evidence (N, C) relative to the unnamed classes.
        scale: The quantized score for evidence of 1.
        named_bit: The bits (N, C + 1) of the named classes.
        kind: The integer type of the result.
    """
    packed = named_bit.astype(np.int64)
    packed[:, 1:] += np.rint(relative * scale).astype(np.int64) << NEW_CLASSES
    return packed.astype(kind)
