"""Tests for the evidence rows of labeled voxels, compared with a voxel-by-voxel reference."""

import numpy as np
import pytest

from framework.data import MAX_CLASSES, Float32, Int32
from framework.mapping.labels import evidence_rows
from framework.mapping.labels.evidence_rows import SLOTS, EvidenceRows, Storage
from framework.mapping.labels.evidence_rows_kernels import _merge_voxel
from framework.mapping.labels.label_evidence import MAX_SCORE, Evidence
from framework.mapping.labels.label_evidence_kernels import Combine, best_class, update_voxel
from framework.mapping.voxels.integration import SeenBlocks
from framework.mapping.voxels.integration_kernels import GROUP
from framework.mapping.voxels.voxel_grid import VoxelGrid
from tests.support.one_pixel import COVERED, FLOOR, SCORE_SCALE, blank, distribution, measured, voted
from tests.support.thread_counts import by_one_thread_and_two

pytestmark = pytest.mark.integration


def with_voxels(count: int) -> EvidenceRows:
    """Return the evidence rows of a stored map with `count` labeled voxels."""
    labeled = np.full(-(-count // 512) * 512, -1, np.int32)
    labeled[:count] = np.arange(count)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 100))
    rows.fill(Evidence(labeled.reshape(-1, 512), *(np.zeros((count, slots)) for slots in (4, 4, 16, 16))))
    return rows


@pytest.mark.parametrize(
    ("ids", "logs", "merged_ids", "merged_logs"),
    [
        ([1, 2, 3, 0], [5, 4, 3, 0], [3, 1, 0, 0], [7, 5, 0, 0]),  # voxel with both instances: the sum is the best
        # voxel with only the dropped instance, which is renamed
        ([2, 1, 4, 5], [5, 4, 3, 2], [3, 1, 4, 5], [5, 4, 3, 2]),
        ([1, 2, 3, 4], [5, 4, -6, 1], [1, 4, 3, 0], [5, 1, -2, 0]),  # negative evidence is added, too
        ([1, 3, 4, 0], [5, 4, 3, 0], [1, 3, 4, 0], [5, 4, 3, 0]),  # voxel without the dropped instance: no change
    ],
)
def test_evidence_merge_adds_evidence_and_keeps_best_first(
    ids: list[int], logs: list[float], merged_ids: list[int], merged_logs: list[float]
) -> None:
    rows = with_voxels(1)
    rows.evidence.instance_ids[0], rows.evidence.instance_value[0] = ids, logs
    rows.merge_instances(3, 2)
    found = dict(zip(rows.evidence.instance_ids[0].tolist(), rows.evidence.instance_value[0].tolist(), strict=True))
    assert found == dict(zip(merged_ids, merged_logs, strict=True))
    assert rows.evidence.instance_ids[0, 0] == merged_ids[0]
    assert ((rows.evidence.instance_ids[0] > 0) == (np.array(merged_ids) > 0)).all(), (
        "expected the used slots before the empty slots"
    )


@pytest.mark.parametrize("count", [1, 511, 512, 513, 2000])
def test_evidence_merge_updates_all_labeled_voxels(count: int) -> None:
    """The first voxel, the last voxel and a voxel between them contain the dropped instance."""
    rows = with_voxels(count)
    evidence = rows.evidence
    evidence.instance_ids[: count + 100], evidence.instance_value[: count + 100] = [4, 2, 0, 0], [7, 5, 0, 0]
    known = np.unique([0, count // 3, count - 1])
    evidence.instance_ids[known, 1] = 3
    evidence.instance_ids[count : count + 100, 1] = 3
    before = evidence.instance_ids[: count + 100].copy()
    rows.merge_instances(4, 3)
    expected = before.copy()
    expected[known] = [4, 0, 0, 0]
    np.testing.assert_array_equal(evidence.instance_ids[: count + 100], expected)
    value = np.tile(np.float32([7, 5, 0, 0]), (count + 100, 1))
    value[known] = [12, 0, 0, 0]
    np.testing.assert_array_equal(evidence.instance_value[: count + 100], value)


@pytest.mark.parametrize("stored", [False, True])
def test_evidence_removal_matches_reference(stored: bool) -> None:
    """Each voxel has a random number of instances. The rows are those of a stored map, or have exact instance sets."""

    def removed() -> tuple[Int32, Float32]:
        rng = np.random.default_rng(5)
        rows = with_voxels(9 * 512)
        evidence = rows.in_use()
        for voxel in range(rows.voxel_count):
            ids = rng.choice(np.arange(1, 200), rng.integers(0, 5), replace=False)
            evidence.instance_ids[voxel, : len(ids)] = ids
            evidence.instance_value[voxel, : len(ids)] = np.sort(rng.normal(size=len(ids)))[::-1]
        if not stored:
            rows.remove_instances([150])
            sets = [set(evidence.instance_ids[labeled].ravel().tolist()) - {0} for labeled in evidence.labeled]
            bits = [sum(1 << k for k in {k % 64 for k in ids}) for ids in sets]
            assert rows._row_bits[: rows.row_count].tolist() == bits
        before, values = evidence.instance_ids.copy(), evidence.instance_value.copy()
        gone = [7, 71, 150, 3, 200]
        rows.remove_instances(gone)
        for voxel in range(rows.voxel_count):
            kept = [k for k in range(4) if before[voxel, k] and before[voxel, k] not in gone]
            kept.sort(key=lambda k: (-values[voxel, k], before[voxel, k]))
            found = dict(zip(evidence.instance_ids[voxel], evidence.instance_value[voxel], strict=True))
            assert evidence.instance_ids[voxel, 0] == (before[voxel, kept[0]] if kept else 0)
            assert (evidence.instance_ids[voxel, : len(kept)] > 0).all()
            assert not evidence.instance_ids[voxel, len(kept) :].any()
            assert not evidence.instance_value[voxel, len(kept) :].any()
            assert {k: v for k, v in found.items() if k} == {before[voxel, k]: values[voxel, k] for k in kept}
        return evidence.instance_ids.copy(), evidence.instance_value.copy()

    for one, other in zip(*by_one_thread_and_two(removed), strict=True):
        np.testing.assert_array_equal(one, other)


def at_pixel(block: int, *voxels: int) -> SeenBlocks:
    """Return the seen blocks of an image with one pixel, to which these voxels of a block project."""
    pixel = np.full((1, 512), -1, np.int32)
    pixel[0, voxels] = 0
    return seen_at(np.array([block], np.int32), pixel)


def seen_at(blocks: Int32, pixels: Int32) -> SeenBlocks:
    """Return the seen blocks of a frame. `pixels` (A, 512) has the pixel of each voxel, -1 = far from the surface."""
    block, voxel = np.nonzero(pixels >= 0)
    count = np.bincount(block, minlength=len(blocks))
    return SeenBlocks(
        blocks,
        np.cumsum(count) - count,
        count.astype(np.int32),
        voxel.astype(np.uint16),
        pixels[block, voxel],
    )


def test_evidence_rows_allocate_only_labeled_voxels() -> None:
    for storage in Storage:
        rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10), storage=storage)
        rows.begin(6)
        rows.voxels.allocate(np.array([[0, 0, 0], [1, 0, 0]], np.int32))
        rows.update(at_pixel(1, 7), voted([0, 7], [1.0, 1.0], [3, 2], Combine.SUM))
        labeled = np.flatnonzero(rows.evidence.labeled[0] >= 0)
        assert labeled.tolist() == [7]
        assert rows.voxels.grid.label_row[:2].tolist() == [-1, 0]
        assert best_class(rows.evidence, rows.evidence.labeled[0, 7]) == 2
        rows.update(at_pixel(0, 3), voted([0], [1.0], [3], Combine.SUM))
        assert (rows.row_count, rows.voxel_count) == (1, 1), "expected no allocation for a cluster without an instance"
        assert len(rows.in_use().class_ids) == 1


@pytest.mark.parametrize(("blocks", "frames", "max_blocks"), [(4, 40, 4), (4, 40, 400), (3 * GROUP + 5, 8, 400)])
def test_evidence_update_of_many_blocks_matches_reference(
    blocks: int, frames: int, max_blocks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each pixel has any number of clusters, with or without an instance. Some updates need new slots."""
    monkeypatch.setattr(evidence_rows, "RESERVED", 1 if max_blocks == 4 else 128)
    first, other = by_one_thread_and_two(lambda: _updated(blocks, frames, max_blocks))
    for one, two in zip(first, other, strict=True):
        np.testing.assert_array_equal(one, two)


def _updated(block_count: int, frames: int, max_blocks: int) -> Evidence:
    """Return the evidence of some blocks, after comparing every update and merge with the reference."""
    rng = np.random.default_rng(3)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, max_blocks))
    rows.begin(6)
    rows.voxels.allocate(np.array([[k, 0, 0] for k in range(block_count)], np.int32))
    by_voxel: dict[tuple[int, int], Evidence] = {}
    evicted = 0
    for frame in range(frames):  # the last of 40 frames has no new voxel
        instances = [0, 1, 2, 3 + frame]
        measurement = voted(instances, [1.0, 0.5, 2.0, 1.5], rng.integers(0, 6, 4).tolist(), Combine.SUM)
        points = 12
        cluster = rng.integers(0, 4, points).astype(np.int32)
        pixel_of = rng.integers(0, 8, points)  # pixels 8 and 9 have no cluster
        lists = [[k for k in cluster[pixel_of == pixel] if instances[k]] for pixel in range(10)]
        measurement = measurement._replace(
            list_ids=np.arange(1, 11, dtype=np.int32)[None],
            offsets=np.cumsum([0, 0, *map(len, lists)], dtype=np.int32),
            clusters=np.array([k for clusters in lists for k in clusters], np.int32),
            absence=np.float32(-0.2),
        )
        # types and limits of compact storage
        measurement = measurement._replace(class_scores=measurement.class_scores.astype(np.int32), max_score=MAX_SCORE)
        blocks = rng.permutation(block_count)[1:].astype(np.int32)
        pixels = rng.integers(-1, 10, (len(blocks), 512)).astype(np.int32)
        pixels[rng.random(pixels.shape) > 4 / block_count] = -1
        pixels[-1] = -1
        rows.update(seen_at(blocks, pixels), measurement)
        for a, n in np.argwhere(pixels >= 0).tolist():
            key, pixel = (int(blocks[a]), n), pixels[a, n]
            if lists[pixel] or key in by_voxel:
                evicted += update_voxel(by_voxel.setdefault(key, blank()), 0, measurement, np.int32(pixel + 1))
    evidence = rows.in_use()
    assert len(by_voxel) == rows.voxel_count > 100
    for (block, n), own in by_voxel.items():
        voxel = evidence.labeled[rows.voxels.grid.label_row[block], n]
        for name in SLOTS:
            np.testing.assert_array_equal(getattr(evidence, name)[voxel], getattr(own, name)[0], err_msg=name)
    assert rows.evicted == evicted
    for kept, dropped in ((41, 42), *((2, k) for k in range(3, 42)), (1, 2)):
        rows.merge_instances(kept, dropped)
        for own in by_voxel.values():
            _merge_voxel(own.instance_ids[0], own.instance_value[0], kept, dropped, int(Combine.SUM))
    for (block, n), own in by_voxel.items():
        voxel = evidence.labeled[rows.voxels.grid.label_row[block], n]
        np.testing.assert_array_equal(evidence.instance_ids[voxel], own.instance_ids[0])
        np.testing.assert_array_equal(evidence.instance_value[voxel], own.instance_value[0])
    return evidence


def test_evidence_rows_count_evictions_of_new_voxel() -> None:
    measurement = voted([1, 2, 3, 4, 5, 6], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0] * 6, Combine.SUM)
    expected = update_voxel(blank(), 0, measurement, COVERED)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10))
    rows.begin(6)
    rows.voxels.allocate(np.zeros((1, 3), np.int32))
    rows.update(at_pixel(0, 5), measurement)
    assert rows.evicted == expected == 2


@pytest.mark.parametrize(("classes", "size"), [(255, 80), (256, 96), (MAX_CLASSES, 96)])
@pytest.mark.parametrize("storage", Storage)
def test_evidence_rows_store_last_class(classes: int, size: int, storage: Storage) -> None:
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10), storage=storage)
    rows.begin(classes)
    rows.voxels.allocate(np.zeros((1, 3), np.int32))
    measurement = voted([1], [1.0], [classes - 1], Combine.SUM, classes)
    if storage is Storage.COMPACT:
        measurement = measurement._replace(class_scores=measurement.class_scores.astype(np.int32), max_score=MAX_SCORE)
    before = rows.byte_count
    rows.update(at_pixel(0, 5), measurement)
    assert best_class(rows.evidence, 0) == classes - 1
    counts = np.array([False, True])
    expected = np.zeros((2, classes))
    expected[1, -1] = 100 / rows.score_scale
    np.testing.assert_array_equal(rows.classes_of_instances(counts, classes), expected)
    of_row = 4 * 512 + 8
    if storage is Storage.COMPACT:
        assert rows.byte_count - before == of_row + size


@pytest.mark.parametrize("storage", Storage)
def test_evidence_rows_256th_class_keeps_evidence(storage: Storage) -> None:
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10), storage=storage)
    rows.begin(255)
    rows.voxels.allocate(np.zeros((1, 3), np.int32))
    rows.update(at_pixel(0, 5), voted([1], [1.0], [254], Combine.SUM, 255))
    before = rows.in_use()
    rows.add_class(256, logarithmic=False)
    after = rows.in_use()
    assert (before.class_ids.dtype, after.class_ids.dtype) == (np.uint8, np.uint16)
    for name in SLOTS:
        kept = getattr(after, name)[:, : getattr(before, name).shape[1]]
        np.testing.assert_array_equal(kept, getattr(before, name), err_msg=name)
    assert after.class_ids.shape[1] == before.class_ids.shape[1] + (storage is Storage.EXACT)


@pytest.mark.parametrize("classes", [30, 300])
def test_evidence_rows_exact_storage_keeps_all_evidence(classes: int) -> None:
    """There are more instances and classes than slots in compact storage."""
    rng = np.random.default_rng(0)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10), storage=Storage.EXACT)
    rows.begin(classes)
    rows.voxels.allocate(np.zeros((1, 3), np.int32))
    class_log, instance_log = np.zeros(classes), np.zeros(21)
    for _ in range(100):
        ids = rng.choice(np.arange(1, 21), 3, replace=False)
        p = np.array([distribution(rng, classes) for _ in ids])
        rows.update(at_pixel(0, 5), measured(ids.tolist(), [0.9] * 3, p, 1.0, 20))
        assert rows.evicted == 0
        class_log += np.log(p).sum(axis=0)
        instance_log[ids] += np.log(0.9 / FLOOR)
    labels, values = rows.evidence.class_ids[0], rows.evidence.class_value[0] / SCORE_SCALE
    assert sorted(labels.tolist()) == list(range(1, classes + 1))
    assert np.allclose(values - values[0], class_log[labels - 1] - class_log[labels[0] - 1], atol=1e-2)
    named = rows.evidence.instance_ids[0] > 0
    assert np.allclose(rows.evidence.instance_value[0][named], instance_log[rows.evidence.instance_ids[0][named]])
    assert named.sum() == 20
