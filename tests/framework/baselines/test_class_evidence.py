"""Tests for the class evidence of a voxel, compared with a recursion over all classes."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from framework.baselines.class_evidence import ClassEvidence, ClassRows, MaskClasses, mask_classes
from framework.baselines.class_evidence_kernels import observe_mask
from framework.data import MAX_CLASSES, PointClusters
from framework.mapping.labels.class_slots import CLASS_SLOTS, NEW_CLASSES, NO_CLASS
from framework.mapping.labels.pixel_lists import list_points_by_pixel
from framework.mapping.voxels.voxel_grid import VoxelGrid


def one_voxel(classes: int) -> ClassEvidence:
    voxels = VoxelGrid(0.01, 0.1, 8)
    voxels.allocate(np.zeros((1, 3), np.int32))
    rows = ClassRows(voxels)
    rows.begin(classes)
    rows._add_rows(np.zeros(1, np.int32))
    return rows.evidence


def masks_of(log_ratio: np.ndarray, frame: int = 0) -> MaskClasses:
    """Return N masks of one pixel each, with the log ratios (N, C) of their classes."""
    n, c = log_ratio.shape
    clusters = PointClusters(
        np.zeros((n, 3), np.float32),
        np.stack([np.arange(n), np.zeros(n)], axis=1).astype(np.int32),
        np.arange(n, dtype=np.int32),
        np.full((n, c), 1 / c, np.float32),
        np.ones(n, np.float32),
        tuple(map(str, range(c))),
    )
    return mask_classes(log_ratio, clusters, list_points_by_pixel(clusters, (1, n)), frame)


@njit
def observe(evidence, masks, k):
    return observe_mask(evidence, 0, 0, masks, k)


def sums(evidence: ClassEvidence, classes: int) -> np.ndarray:
    """Return the summed log ratios (C,) of the voxel. Classes without a slot have the common value."""
    found = np.full(classes, evidence.rest[0, 0], np.float64)
    for label, value in zip(evidence.class_ids[0, 0], evidence.log_ratio[0, 0], strict=True):
        if label != NO_CLASS:
            found[label - 1] = value
    return found


def test_class_evidence_few_classes_match_dense_recursion() -> None:
    rng = np.random.default_rng(0)
    log_ratios = rng.normal(0, 2, (30, 5))
    masks, evidence = masks_of(log_ratios), one_voxel(5)
    assert sum(observe(evidence, masks, k) for k in range(30)) == 0
    np.testing.assert_allclose(sums(evidence, 5), log_ratios.sum(axis=0), atol=1e-4)
    assert evidence.class_ids[0, 0, 0] == 1 + log_ratios.sum(axis=0).argmax()
    assert evidence.masked[0, 0] == 30


def test_class_evidence_of_later_class_includes_earlier_masks() -> None:
    """Each mask has separate log ratios for 8 of the 14 classes and a common log ratio for the others."""
    rng = np.random.default_rng(1)
    log_ratios = np.full((20, 14), -3.0)
    for row in log_ratios:
        row[rng.choice(14, NEW_CLASSES, replace=False)] = rng.normal(0, 1, NEW_CLASSES)
    masks, evidence = masks_of(log_ratios), one_voxel(14)
    assert sum(observe(evidence, masks, k) for k in range(20)) == 0
    np.testing.assert_allclose(sums(evidence, 14), log_ratios.sum(axis=0), atol=1e-4)


def test_class_evidence_full_voxel_evicts_least_likely_classes() -> None:
    message = np.full((3, 40), -5.0)
    message[0, :8], message[1, 8:16], message[2, 16:24] = 1.0, 2.0, 9.0
    masks, evidence = masks_of(message), one_voxel(40)
    assert evidence.class_ids.shape[2] == CLASS_SLOTS
    assert [observe(evidence, masks, k) for k in range(3)] == [0, 0, 8]
    # summed log ratios: 1 - 5 - 5 for classes 0 to 7, -5 + 2 - 5 for 8 to 15, and -5 - 5 + 9 for 16 to 23
    assert set(evidence.class_ids[0, 0].tolist()) == set(range(9, 25))
    assert evidence.class_ids[0, 0, 0] == 17
    assert evidence.log_ratio[0, 0, 0] == pytest.approx(-1)


def test_class_evidence_stores_count_first_and_last_frame() -> None:
    evidence = one_voxel(2)
    for frame in (4, 7, 9):
        observe(evidence, masks_of(np.zeros((1, 2)), frame), 0)
    assert (evidence.masked[0, 0], evidence.first_frame[0, 0], evidence.last_frame[0, 0]) == (3, 4, 9)
    assert (evidence.masked[0, 1], evidence.first_frame[0, 1], evidence.last_frame[0, 1]) == (0, -1, -1)


def test_mask_classes_pixel_uses_highest_scoring_mask() -> None:
    clusters = PointClusters(
        np.zeros((5, 3), np.float32),
        np.int32([[0, 0], [0, 0], [1, 0], [0, 0], [2, 0]]),
        np.int32([0, 1, 1, 2, -1]),
        np.full((3, 2), 0.5, np.float32),
        np.float32([0.4, 0.9, 0.9]),
        ("chair", "bed"),
    )
    masks = mask_classes(np.zeros((3, 2)), clusters, list_points_by_pixel(clusters, (1, 4)), 0)
    assert masks.cluster.tolist() == [1, 1, -1, -1]


@pytest.mark.parametrize("classes", [255, 256, MAX_CLASSES])
def test_class_evidence_of_last_class_is_stored(classes: int) -> None:
    message = np.full((1, classes), -5.0)
    message[0, -1] = 2.0
    evidence = one_voxel(classes)
    assert evidence.class_ids.itemsize == (1 if classes == 255 else 2)
    observe(evidence, masks_of(message), 0)
    assert evidence.class_ids[0, 0, 0] == classes
    assert sums(evidence, classes)[-1] == 2
