"""The voxel-wise Bayesian update: class and instance distributions as two independent recursions, eqs. [7] and [8].

    P(c | I_1..t) = (1/Z) P(c | I_1..t-1) P(O_u = c | I_t)

runs in log space as a sum of log-likelihoods, from a uniform start. Only the ratios between labels matter, so a voxel
stores each label's sum relative to the labels that nobody named there, whose sum is 0 by that definition ("the rest").
A voxel keeps the SLOTS most likely instances and classes and drops the least likely one when another one is named (an
eviction, counted). What a dropped or unnamed label would have gained over the rest is lost; everything that stays is
exact.

Rows of 512 voxels exist only for blocks in which something was detected: 8 bytes an instance slot, 6 a class slot, so
56 bytes a labelled voxel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Bool, Float32, Int32
from framework.mapping.integration import SeenBlocks
from framework.mapping.voxel_grid import BLOCK_VOXELS, VoxelGrid, device, grown, one_more

SLOTS = 4  # instances and classes that a voxel can tell apart
NEW_CLASSES = 4  # a detection can bring its best so many classes into a voxel's slots


class Evidence(NamedTuple):
    """Log-likelihoods of labels, relative to every label not named. The best label is always in slot 0."""

    instance_ids: Int32  # (R, 512, SLOTS), 0 = free slot
    instance_log: Float32  # (R, 512, SLOTS)
    class_ids: npt.NDArray[np.int16]  # (R, 512, SLOTS), -1 = free slot
    class_log: Float32  # (R, 512, SLOTS)


class Measurement(NamedTuple):
    """What one frame's clusters say, P(O_u | I_t): N clusters, C classes."""

    first_point: Int32  # (H, W) the first entry of each pixel's list of cluster points, -1 = under no cluster
    next_point: Int32  # (P,) the next entry of the same pixel, -1 = last
    cluster: Int32  # (P,) whose point it is
    instance_id: Int32  # (N,) the instance that each cluster was associated with, 0 = none: it says nothing
    instance_gain: Float32  # (N,) log P(O = that instance) / P(O = any other)
    absence_loss: np.float32  # log-likelihood ratio, negative, for an instance matched in this frame but not seen here
    matched: Bool  # (ids + 1,) which instances were matched in this frame, by id
    class_gain: Float32  # (N, C) log P(O = c) / P(O = a class not named)
    named_classes: npt.NDArray[np.int16]  # (N, NEW_CLASSES) each cluster's best classes


@device
def best_instance(evidence, row, n):
    """The most likely instance of a voxel, 0 when none is more likely than the rest."""
    return evidence.instance_ids[row, n, 0] if evidence.instance_log[row, n, 0] > 0 else np.int32(0)


@device
def best_counted_instance(evidence, row, n, counts):
    """The most likely instance of a voxel among those that count, by id in counts; 0 when none is likelier than the
    rest.
    """
    best = np.int32(0)
    best_log = np.float32(0.0)
    for s in range(SLOTS):
        label = evidence.instance_ids[row, n, s]
        if label > 0 and counts[label]:
            log = evidence.instance_log[row, n, s]
            if log > best_log or (log == best_log and label < best):
                best = label
                best_log = log
    return best


@device
def best_class(evidence, row, n):
    """The most likely class of a voxel, -1 when none was ever named."""
    return np.int32(evidence.class_ids[row, n, 0])


@device
def add_evidence(labels, logs, free, label, gain):
    """Adds `gain` to a label's slot, or gives it the free or least likely one. Returns 1 when that evicted another."""
    least = 0
    for s in range(SLOTS):
        if labels[s] == label:
            logs[s] += gain
            return 0
        if labels[s] == free:
            labels[s] = label
            logs[s] = gain
            return 0
        if logs[s] < logs[least]:
            least = s
    if logs[least] >= gain:
        return 1  # the newcomer is itself the least likely: it is the one that is dropped
    labels[least] = label
    logs[least] = gain
    return 1


@device
def _best_first(labels, logs, free):
    """Moves the most likely label to slot 0; ties go to the smaller label, so that the order of arrival does not
    matter.
    """
    best = 0
    for s in range(1, SLOTS):
        if labels[s] != free and (logs[s] > logs[best] or (logs[s] == logs[best] and labels[s] < labels[best])):
            best = s
    if best > 0:
        labels[0], labels[best] = labels[best], labels[0]
        logs[0], logs[best] = logs[best], logs[0]


@device
def update_voxel(evidence, row, n, measurement, point):
    """Both recursions for one voxel that is seen at a pixel whose list of cluster points starts at `point`, -1 = empty.

    Returns the number of evictions.
    """
    ids = evidence.instance_ids[row, n]
    if point < 0 and ids[0] == 0:
        return 0  # nothing is known of the voxel, and nothing is said about it
    id_logs = evidence.instance_log[row, n]
    classes = evidence.class_ids[row, n]
    class_logs = evidence.class_log[row, n]
    evicted = 0
    # evidence of absence: an instance that was found in this frame, but not here
    for s in range(SLOTS):
        if ids[s] > 0 and measurement.matched[ids[s]]:
            covered = False
            p = point
            while p >= 0:
                covered = covered or measurement.instance_id[measurement.cluster[p]] == ids[s]
                p = measurement.next_point[p]
            if not covered:
                id_logs[s] += measurement.absence_loss
    p = point
    while p >= 0:
        k = measurement.cluster[p]
        p = measurement.next_point[p]
        if measurement.instance_id[k] == 0:
            continue
        evicted += add_evidence(ids, id_logs, 0, measurement.instance_id[k], measurement.instance_gain[k])
        for s in range(SLOTS):
            if classes[s] >= 0:
                class_logs[s] += measurement.class_gain[k, classes[s]]
        for m in range(NEW_CLASSES):
            label = measurement.named_classes[k, m]
            known = False
            for s in range(SLOTS):
                known = known or classes[s] == label
            if not known:
                evicted += add_evidence(classes, class_logs, -1, label, measurement.class_gain[k, label])
    _best_first(ids, id_logs, 0)
    _best_first(classes, class_logs, -1)
    return evicted


@njit(cache=True, nogil=True, parallel=True)
def _find_blocks_under_clusters(grid, seen, measurement, first_point, wants_row):
    """Notes in wants_row (A,) the blocks without a row that have a voxel under some cluster with an instance."""
    for a in prange(seen.blocks.shape[0]):
        wants_row[a] = False
        if seen.near[a] and grid.label_row[seen.blocks[a]] < 0:
            pixels = seen.near_pixel[a]
            under = np.int32(0)
            for n in range(BLOCK_VOXELS):  # without a branch, so that it is vectorised: most blocks are under none
                pixel = pixels[n]
                under = one_more(under, (pixel >= 0) & (first_point[max(pixel, np.int32(0))] >= 0))
            for n in range(BLOCK_VOXELS if under > 0 else 0):
                pixel = pixels[n]
                p = first_point[pixel] if pixel >= 0 else np.int32(-1)
                while p >= 0 and measurement.instance_id[measurement.cluster[p]] == 0:
                    p = measurement.next_point[p]
                if p >= 0:
                    wants_row[a] = True
                    break


@njit(cache=True, nogil=True, parallel=True)
def _update(grid, seen, evidence, measurement, first_point, evicted):
    """Updates the near voxels of the seen blocks that have a row; evicted (A,) counts slots given away."""
    for a in prange(seen.blocks.shape[0]):
        evicted[a] = 0
        row = grid.label_row[seen.blocks[a]]
        if seen.near[a] and row >= 0:
            for n in range(BLOCK_VOXELS):
                pixel = seen.near_pixel[a, n]
                if pixel >= 0:
                    evicted[a] += update_voxel(evidence, row, n, measurement, first_point[pixel])


@njit(cache=True, nogil=True, parallel=True)
def _merge(evidence, rows, kept, dropped):
    for row in prange(rows):
        for n in range(BLOCK_VOXELS):
            ids = evidence.instance_ids[row, n]
            logs = evidence.instance_log[row, n]
            for s in range(SLOTS):
                if ids[s] == dropped:
                    gain = logs[s]
                    last = SLOTS - 1  # slots stay filled from the front
                    while ids[last] == 0:
                        last -= 1
                    ids[s], logs[s] = ids[last], logs[last]
                    ids[last], logs[last] = 0, 0
                    add_evidence(ids, logs, 0, kept, gain)
                    _best_first(ids, logs, 0)
                    break


class EvidenceRows:
    """Owns the label evidence of a grid's blocks and makes it grow. The kernels work on `self.evidence`."""

    def __init__(self, voxels: VoxelGrid) -> None:
        self.voxels = voxels
        self.row_count = 0
        self.evicted = 0  # slots given to another label so far
        self.evidence = Evidence(
            instance_ids=np.empty((64, BLOCK_VOXELS, SLOTS), np.int32),
            instance_log=np.empty((64, BLOCK_VOXELS, SLOTS), np.float32),
            class_ids=np.empty((64, BLOCK_VOXELS, SLOTS), np.int16),
            class_log=np.empty((64, BLOCK_VOXELS, SLOTS), np.float32),
        )

    @property
    def byte_count(self) -> int:
        """Of the rows in use."""
        return sum(array[: self.row_count].nbytes for array in self.evidence)

    def update(self, seen: SeenBlocks, measurement: Measurement) -> None:
        """Updates the voxels near the measured surface of the blocks that a frame has seen."""
        if not measurement.instance_id.any():
            return  # the frame says nothing, neither for an instance nor against one
        first_point = measurement.first_point.ravel()
        wants_row = np.empty(len(seen.blocks), np.bool_)
        evicted = np.empty(len(seen.blocks), np.int32)
        _find_blocks_under_clusters(self.voxels.grid, seen, measurement, first_point, wants_row)
        self._add_rows(seen.blocks[wants_row])
        _update(self.voxels.grid, seen, self.evidence, measurement, first_point, evicted)
        self.evicted += int(evicted.sum())

    def merge_instances(self, kept: int, dropped: int) -> None:
        """Adds the evidence for instance `dropped` to that for `kept` in every voxel.

        Rare, and it visits the whole map.
        """
        _merge(self.evidence, self.row_count, np.int32(kept), np.int32(dropped))

    def _add_rows(self, blocks: Int32) -> None:
        """Gives each of these blocks a row, in the order given."""
        needed = self.row_count + len(blocks)
        if needed > len(self.evidence.instance_ids):
            capacity = max(needed, 2 * len(self.evidence.instance_ids))
            self.evidence = Evidence(
                instance_ids=grown(self.evidence.instance_ids, capacity),
                instance_log=grown(self.evidence.instance_log, capacity),
                class_ids=grown(self.evidence.class_ids, capacity),
                class_log=grown(self.evidence.class_log, capacity),
            )
        new = slice(self.row_count, needed)
        self.evidence.instance_ids[new] = 0
        self.evidence.instance_log[new] = 0
        self.evidence.class_ids[new] = -1
        self.evidence.class_log[new] = 0
        self.voxels.grid.label_row[blocks] = np.arange(self.row_count, needed, dtype=np.int32)
        self.row_count = needed
