"""Class evidence in the voxels of a semantic map.

The update follows SemanticFusion (McCormac et al., 2017, eq. 2). It is eq. (7) of docs/method.md, with one distribution
per pixel over the background and all classes:

    P(c | I_1..t) = (1/Z) P(c | I_1..t-1) P(O_u = c | I_t)

Here, I_t is image t, O_u is the label observed at the pixel u of the voxel, and Z normalizes the distribution.

In log space, the update is a sum. A voxel stores the log ratio of each class to the background. If no log ratio is
above 0, the voxel is background.

A voxel is *under a mask* if its pixel is inside the mask. It then gets the class distribution of the mask. All pixels
outside the masks are equal evidence for the background, so a voxel only counts these frames. Blocks with voxels under a
mask have a row of evidence.

Each mask *names* its most likely classes. A voxel has slots for at most CLASS_SLOTS named classes. If all slots are
used, a newly named class replaces the least likely one, unless it is itself the least likely. The unnamed classes share
one log ratio, `rest`, which is the initial value of a newly named class.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from framework.baselines.class_evidence_kernels import best_clusters, find_blocks_under_masks, update_classes
from framework.data import Float32, Float64, Int32, PointClusters, UInt8, UInt16
from framework.errors import DataError
from framework.mapping.labels.class_slots import CLASS_SLOTS, NO_CLASS, ClassIds, class_id_type
from framework.mapping.labels.label_evidence import named_classes
from framework.mapping.labels.pixel_lists import PixelLists
from framework.mapping.storage.map_file import check_known, check_like
from framework.mapping.voxels.integration import SeenBlocks
from framework.mapping.voxels.voxel_grid import VoxelGrid, grown
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS

MAX_EXPONENT = 700.0  # maximum log ratio of unnamed classes; float64 can represent exp(700)


class ClassEvidence(NamedTuple):
    """Class evidence of all voxels.

    There are B blocks, R rows of evidence and T class slots per voxel. Slot 0 has the most likely class.
    """

    unmasked: UInt16  # (B, 512) number of frames in which the voxel was outside all masks, for B blocks
    class_ids: ClassIds  # (R, 512, T) in [1, C], 0 = free slot
    log_ratio: Float32  # (R, 512, T) sum of log(P(class) / P(background)) over the frames counted by `masked`
    rest: Float32  # (R, 512) log_ratio of each unnamed class of the voxel
    masked: UInt16  # (R, 512) number of frames in which the voxel was under a mask
    first_frame: Int32  # (R, 512) first frame in which the voxel was under a mask, -1 = none
    last_frame: Int32  # (R, 512) last frame in which the voxel was under a mask, -1 = none


ROW_ARRAYS = ClassEvidence._fields[1:]  # arrays with one entry per row
NO_EVIDENCE = (NO_CLASS, 0, 0, 0, -1, -1)  # values of ROW_ARRAYS in a new row


class MaskClasses(NamedTuple):
    """Class evidence of the N masks of one frame."""

    cluster: Int32  # (H * W,) cluster with the highest score at each pixel, -1 = none
    log_ratio: Float32  # (N, C) log(P(class) / P(background))
    unnamed: Float32  # (N,) log(mean P(unnamed class) / P(background)) of each cluster
    named_classes: UInt16  # (N, NEW_CLASSES) ids of the most likely classes of each cluster
    named_bit: UInt8  # (N, C + 1) by class id, 2^m for the m-th named class of a cluster, 0 = unnamed
    frame: int  # index of the frame


def mask_classes(log_ratio: Float64, clusters: PointClusters, points: PixelLists, frame: int) -> MaskClasses:
    """Return the class evidence of the masks of a frame.

    Args:
        log_ratio: The log ratio (N, C) of each class to the background.
        clusters: The clusters of the masks.
        points: The lists of clusters at the pixels.
        frame: The index of the frame.
    """
    relative, named, bits = named_classes(log_ratio, logarithmic=True)
    best = best_clusters(points.offsets, points.clusters, clusters.scores)
    return MaskClasses(
        best[points.list_ids.ravel()],
        log_ratio.astype(np.float32),
        (log_ratio - relative)[:, :1].sum(axis=1).astype(np.float32),
        named,
        bits,
        frame,
    )


class ClassRows:
    """The class evidence of a voxel grid.

    The kernels modify its `evidence`.
    """

    def __init__(self, voxels: VoxelGrid) -> None:
        self.voxels = voxels
        self.row_count = 0
        self.evicted = 0  # number of slots reassigned to another class
        self.evidence = _free_rows(0)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without unused capacity."""
        unmasked = self.evidence.unmasked[: self.voxels.block_count]
        return {**vars(self), "evidence": self.evidence._replace(unmasked=unmasked)}

    @property
    def byte_count(self) -> int:
        """Size of the arrays in use, bytes."""
        return sum(array.nbytes for array in self.saved().values())

    def begin(self, classes: int) -> None:
        """Set the number of classes before the first update."""
        self.evidence = _free_rows(classes)

    def update(self, seen: SeenBlocks, masks: MaskClasses | None) -> None:
        """Update the class evidence of the voxels near the measured surface.

        Args:
            seen: The blocks updated by the frame, and their voxels near the surface.
            masks: The evidence of the masks, or None if the detector did not run.
        """
        capacity = len(self.voxels.grid.block_coords)
        if len(self.evidence.unmasked) < capacity:
            self.evidence = self.evidence._replace(unmasked=grown(self.evidence.unmasked, capacity, zeros=True))
        if masks is None:
            return
        wants_row = np.empty(len(seen.blocks), np.bool_)
        evicted = np.empty(len(seen.blocks), np.int32)
        find_blocks_under_masks(self.voxels.grid, seen, masks.cluster, wants_row)
        self._add_rows(seen.blocks[wants_row])
        update_classes(self.voxels.grid, seen, self.evidence, masks, evicted)
        self.evicted += int(evicted.sum())

    def saved(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays for a map file."""
        rows = {name: getattr(self.evidence, name)[: self.row_count] for name in ROW_ARRAYS}
        return {"unmasked": self.evidence.unmasked[: self.voxels.block_count], **rows}

    def fill(self, arrays: dict[str, npt.NDArray[Any]], classes: int) -> None:
        """Load the arrays of a map file.

        Args:
            arrays: The arrays of the file.
            classes: The number of classes.

        Raises:
            DataError: If the arrays are invalid.
        """
        free = self.evidence._asdict()
        check_like(arrays, {"unmasked": free.pop("unmasked")}, self.voxels.block_count)
        check_like(arrays, free, len(arrays["rest"]))
        check_known("class_ids", arrays["class_ids"], [NO_CLASS, *range(1, classes + 1)])
        if len(arrays["rest"]) and not classes:
            raise DataError(f"rest: expected 0 rows in a map without classes, got {len(arrays['rest'])}")
        _check_order(arrays["class_ids"], arrays["log_ratio"], arrays["rest"], classes)
        self.evidence = ClassEvidence(**{name: arrays[name] for name in ClassEvidence._fields})
        self.row_count = len(self.evidence.rest)

    def _add_rows(self, blocks: Int32) -> None:
        needed = self.row_count + len(blocks)
        if needed > len(self.evidence.rest):
            capacity = max(needed, 2 * len(self.evidence.rest))
            self.evidence = self.evidence._replace(
                **{name: grown(getattr(self.evidence, name), capacity) for name in ROW_ARRAYS}
            )
        new = slice(self.row_count, needed)
        for name, value in zip(ROW_ARRAYS, NO_EVIDENCE, strict=True):
            getattr(self.evidence, name)[new] = value
        self.voxels.grid.label_row[blocks] = np.arange(self.row_count, needed, dtype=np.int32)
        self.row_count = needed


def _check_order(class_ids: ClassIds, log_ratio: Float32, rest: Float32, classes: int) -> None:
    """Raise DataError unless slot 0 has the most likely class, and all log ratios are in range."""
    named = class_ids != NO_CLASS
    ratios = np.where(named, log_ratio, np.float32(-np.inf))
    best = ratios.max(axis=-1, initial=-np.inf)
    wrong = ratios[..., 0] < best
    if wrong.any():
        raise DataError(
            f"log_ratio: expected {best[wrong][0]:g} (the maximum of the voxel) in slot 0, got {ratios[wrong][0, 0]:g}"
        )
    excess = np.where(named.sum(axis=-1) == classes, rest - np.maximum(best, 0), np.float32(-np.inf))
    if (excess > MAX_EXPONENT).any():
        raise DataError(
            f"rest: expected a log ratio at most {MAX_EXPONENT:g} above the best class in voxels without "
            f"unnamed classes, got {excess.max():g}"
        )


def _free_rows(classes: int) -> ClassEvidence:
    voxels, class_slots = (0, BLOCK_VOXELS), min(classes, CLASS_SLOTS)
    return ClassEvidence(
        unmasked=np.empty(voxels, np.uint16),
        class_ids=np.empty((*voxels, class_slots), class_id_type(classes)),
        log_ratio=np.empty((*voxels, class_slots), np.float32),
        rest=np.empty(voxels, np.float32),
        masked=np.empty(voxels, np.uint16),
        first_frame=np.empty(voxels, np.int32),
        last_frame=np.empty(voxels, np.int32),
    )
