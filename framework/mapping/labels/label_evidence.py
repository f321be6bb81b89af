"""Label evidence of the voxels: the likelihood of each instance and class, and its update from a frame.

The paper's rule is a voxel-wise Bayesian update by two independent recursions, eqs. (7) and (8) of docs/method.md:

    P(c | I_1..t) = (1/Z) P(c | I_1..t-1) P(O_u = c | I_t)

Here, c is a class or an instance, I_t is image t, O_u is the label observed at the pixel u of the voxel, and Z
normalizes the distribution.

In log space, the update is a sum of log-likelihoods that starts from a uniform distribution. Only ratios matter.
Therefore, a voxel stores the log-odds of each label over the unnamed labels. A cluster *names* its instance and its
most likely classes. A label is unnamed if no cluster named it at this voxel. Other rules (counts, latest, most
confident) store other values and combine new evidence with old evidence differently; see `Combine`.

A block has an evidence row once one of its voxels has labels. Each labeled voxel has slots. There are B blocks, R
rows, L labeled voxels, and S instance slots and T class slots per labeled voxel.

    grid.label_row[block] ----> labeled[row, n] -------> instance_ids[voxel, :]   instance_value[voxel, :]
       -1 = no row                -1 = no slots          class_ids[voxel, :]      class_value[voxel, :]
       (B,)                       (R, 512)               (L, S) and (L, T), best label in slot 0

Compact storage keeps the most likely labels and evicts the least likely label when another label is named. The evidence
of an evicted or unnamed label is lost. Exact storage has a slot for every class and as many instance slots as needed.
Tests compare compact with exact storage. Class evidence is quantized, so that it is small and independent of the order
of summation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Bool, Float32, Float64, Int32, UInt8
from framework.mapping.labels.class_slots import NEW_CLASSES, NO_CLASS

Integers = npt.NDArray[Any]  # of int16, int32 or int64
MAX_SCORE = 30_000  # maximum quantized class score in compact storage; the excess is subtracted from all scores
MAX_CLUSTER_SCORE = 2**15 - 1 - MAX_SCORE  # maximum quantized score of a cluster; a larger one could overflow int16


class Evidence(NamedTuple):
    """Label evidence of all voxels; see the diagram in the module docstring.

    Voxels are visited in any order. Therefore, the slots of a voxel are contiguous: the arrays of slots are views of
    one structured array. In compact storage, the slots of a voxel take 80 bytes.
    """

    labeled: Int32  # (R, 512) index of a voxel among the voxels with slots, -1 = no slots
    instance_ids: Int32  # (L, S), 0 = free slot; all slots are free if only unmatched clusters updated the voxel
    instance_value: Float32  # (L, S) log-odds over the unnamed instances
    class_ids: UInt8  # (L, T), NO_CLASS = free slot
    class_value: Integers  # (L, T) quantized scores over the unnamed classes; int16, in exact storage int64


class Measurement(NamedTuple):
    """Evidence of the N clusters of one frame for C classes."""

    list_ids: Int32  # (H, W) list of clusters of each pixel, 0 = no cluster; see PixelLists
    offsets: Int32  # (L + 1,) start of each of the L lists in `clusters`
    clusters: Int32  # (offsets[L],) clusters that update voxels
    instance_id: Int32  # (N,) instance associated with each cluster, 0 = none
    instance_log_odds: Float32  # (N,) log-odds of that instance over any other instance
    absence: np.float32  # log-odds, <= 0, of a matched instance in voxels outside its mask
    matched: Bool  # (ids + 1,) indexed by id, True where an instance was matched in this frame
    class_scores: Integers  # (N, NO_CLASS + 1) int32, in exact storage int64; see pack_class_scores()
    named_classes: UInt8  # (N, NEW_CLASSES) most likely classes of each cluster
    combine: int  # value of Combine
    max_score: int  # maximum quantized score of a class in a voxel


def named_classes(evidence: Float64, logarithmic: bool) -> tuple[Float64, UInt8, UInt8]:
    """Return the evidence of N clusters over their unnamed classes, their named classes, and the named bits.

    If the `evidence` (N, C) is log-likelihoods, a cluster names its NEW_CLASSES most likely classes, and each unnamed
    class gets the mean likelihood of the unnamed classes. Otherwise, a cluster names its most likely class, and has no
    evidence for other classes.

    Returns:
        Evidence (N, C) over the unnamed classes; named classes (N, NEW_CLASSES), padded with the first named class;
        named bits (N, NO_CLASS + 1), 2^m for the m-th named class, 0 = unnamed.
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
        else:  # all classes are named; a term common to all classes is no evidence
            mean = unnamed.min(axis=1, keepdims=True, initial=1.0)
        relative = evidence - np.log(np.maximum(mean, 1e-6))
    bits = np.zeros((len(evidence), NO_CLASS + 1), np.uint8)
    np.put_along_axis(bits, named, np.uint8(1) << np.arange(names, dtype=np.uint8)[None], axis=1)
    again = np.repeat(named[:, :1], NEW_CLASSES - names, axis=1)
    return relative, np.concatenate([named, again], axis=1).astype(np.uint8), bits


def pack_class_scores(relative: Float64, scale: int, named_bit: UInt8, kind: type[np.signedinteger[Any]]) -> Integers:
    """Return the evidence `relative` (N, C) over the unnamed classes, quantized and packed with `named_bit`.

    `named_bit` and the result, of type `kind`, are (N, NO_CLASS + 1). The lowest NEW_CLASSES bits of an entry hold the
    named bit, and the bits above hold the evidence times `scale`, rounded. Therefore, a class slot needs one look-up.
    """
    packed = named_bit.astype(np.int64)
    packed[:, : relative.shape[1]] += np.rint(relative * scale).astype(np.int64) << NEW_CLASSES
    return packed.astype(kind)
