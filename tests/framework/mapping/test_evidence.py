"""The compact Bayesian update against the two recursions written out over all labels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.data import Int32
from framework.errors import DataError
from framework.mapping import evidence as evidence_module
from framework.mapping.evidence import (
    INSTANCE_SLOTS,
    MOST_GAIN,
    MOST_UNITS,
    SLOTS,
    Combine,
    Evidence,
    EvidenceRows,
    Measurement,
    Storage,
    _merge_voxel,
    add_evidence,
    best_class,
    best_counted_instance,
    best_instance,
    class_said,
    named_classes,
    update_voxel,
)
from framework.mapping.integration import SeenBlocks
from framework.mapping.slot_vectors import ALL_NAMED, CLASS_SLOTS, NEW_CLASSES, NO_CLASS
from framework.mapping.voxel_grid import VoxelGrid
from tests.thread_counts import by_one_thread_and_two

FLOOR = 0.05
UNITS = 1 << 16  # as fine as in exact storage
BARE, COVERED = np.int32(0), np.int32(1)  # numbers of the lists of clusters over a pixel: none, all of a measurement


def blank() -> Evidence:
    """Of one voxel with slots."""
    return Evidence(
        np.zeros((1, 512), np.int32),
        np.zeros((1, INSTANCE_SLOTS), np.int32),
        np.zeros((1, INSTANCE_SLOTS), np.float32),
        np.full((1, CLASS_SLOTS), NO_CLASS, np.uint8),
        np.zeros((1, CLASS_SLOTS), np.int64),
    )


def measured(
    ids: list[int],
    scores: list[float],
    distributions: np.ndarray,
    absence: float,
    last_id: int,
) -> Measurement:
    """Every cluster covers the one pixel that there is."""
    said = np.flatnonzero(ids).astype(np.int32)
    matched = np.zeros(last_id + 1, np.bool_)
    matched[ids] = True
    gains, named, bits = named_classes(np.log(distributions), logarithmic=True)
    return Measurement(
        np.full((1, 1), COVERED),
        np.array([0, 0, len(said)], np.int32),
        said,
        np.array(ids, np.int32),
        np.log(np.array(scores) / FLOOR).astype(np.float32),
        np.float32(np.log(absence)),
        matched,
        class_said(gains, UNITS, bits, np.int64),
        named,
        int(Combine.SUM),
        1 << 62,
    )


def voted(ids: list[int], weights: list[float], classes: list[int], combine: Combine, number: int = 6) -> Measurement:
    """Clusters over the one pixel, each for an instance and one class, by a rule that is not Bayes'."""
    evidence = np.zeros((len(ids), number))
    evidence[np.arange(len(ids)), classes] = weights
    gains, named, bits = named_classes(evidence, logarithmic=False)
    every = measured(ids, weights, np.full((len(ids), 1), 1.0), 1.0, max(ids))
    return every._replace(
        instance_gain=np.array(weights, np.float32),
        class_said=class_said(gains, 100, bits, np.int64),
        named_classes=named,
        combine=int(combine),
    )


def distribution(rng: np.random.Generator, classes: int) -> np.ndarray:
    p = rng.dirichlet(np.full(classes, 0.3))
    return 0.9 * p + 0.1 / classes


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), labels=st.integers(1, INSTANCE_SLOTS))
def test_equals_the_full_recursion_while_the_labels_fit(seed: int, labels: int) -> None:
    """With no more labels than slots, nothing is ever dropped, so posteriors are exact: eqs. [7] and [8]."""
    rng = np.random.default_rng(seed)
    classes = labels  # every class is named
    evidence = blank()
    instance_log = np.zeros(labels + 1)  # [0]: every other instance
    class_log = np.zeros(classes)
    for _ in range(20):
        instance = int(rng.integers(1, labels + 1))
        score = float(rng.uniform(0.2, 1))
        p = distribution(rng, classes)
        evicted = update_voxel(evidence, 0, measured([instance], [score], p[None], 1.0, labels), COVERED)
        assert evicted == 0
        # P(O = instance) = score, P(O = any other) = FLOOR
        instance_log += np.log(FLOOR)
        instance_log[instance] += np.log(score / FLOOR)
        class_log += np.log(p)
    found = {int(i): float(v) for i, v in zip(evidence.instance_ids[0], evidence.instance_value[0], strict=True) if i}
    for i, log in found.items():
        assert abs(log - (instance_log[i] - instance_log[0])) < 1e-3
    assert best_instance(evidence, 0) == 1 + np.argmax(instance_log[1:])
    order = evidence.class_ids[0][: min(classes, CLASS_SLOTS)]
    ours = evidence.class_value[0][: len(order)] / UNITS
    exact = class_log[order]
    assert np.allclose(ours - ours[0], exact - exact[0], atol=2e-3)
    assert best_class(evidence, 0) == np.argmax(class_log)


def test_agrees_with_the_full_recursion_for_eighty_classes() -> None:
    """More classes than slots: the argmax still agrees nearly always, and evictions are counted."""
    rng = np.random.default_rng(0)
    agree = 0
    evictions = 0
    voxels = 300
    for _ in range(voxels):
        evidence = blank()
        log = np.zeros(80)
        true = int(rng.integers(80))
        for _ in range(12):
            logits = rng.normal(0, 1, 80)
            logits[true] += 2.5
            p = np.exp(logits) / np.exp(logits).sum()
            p = 0.9 * p + 0.1 / 80
            log += np.log(p)
            evictions += update_voxel(evidence, 0, measured([1], [0.9], p[None], 1.0, 1), COVERED)
        agree += best_class(evidence, 0) == np.argmax(log)
    assert agree >= 0.97 * voxels
    assert evictions > 0


def test_a_voxel_under_two_masks_hears_both() -> None:
    evidence = blank()
    p = np.full((2, 3), 1 / 3)
    update_voxel(evidence, 0, measured([1, 2], [0.9, 0.5], p, 1.0, 2), COVERED)
    found = dict(zip(evidence.instance_ids[0].tolist(), evidence.instance_value[0].tolist(), strict=True))
    assert found[1] == np.float32(np.log(0.9 / FLOOR))
    assert found[2] == np.float32(np.log(0.5 / FLOOR))


def test_absence_counts_only_against_instances_found_in_the_frame() -> None:
    evidence = blank()
    one = np.full((1, 3), 1 / 3)
    update_voxel(evidence, 0, measured([1], [0.9], one, 0.5, 2), COVERED)
    before = float(evidence.instance_value[0, 0])
    update_voxel(evidence, 0, measured([2], [0.9], one, 0.5, 2), BARE)  # instance 2 found, not here
    assert float(evidence.instance_value[0, 0]) == before
    update_voxel(evidence, 0, measured([1], [0.9], one, 0.5, 2), BARE)  # instance 1 found, not here
    assert float(evidence.instance_value[0, 0]) == np.float32(before + np.log(0.5))
    for _ in range(10):
        update_voxel(evidence, 0, measured([1], [0.9], one, 0.5, 2), BARE)
    assert best_instance(evidence, 0) == 0, "the rest has become more likely"


def test_a_cluster_without_instance_says_nothing() -> None:
    evidence = blank()
    update_voxel(evidence, 0, measured([0], [0.9], np.full((1, 3), 1 / 3), 0.5, 1), COVERED)
    assert (evidence.instance_ids == 0).all()
    assert (evidence.class_ids == NO_CLASS).all()


def test_class_gains_are_relative_to_the_classes_not_named() -> None:
    p = np.array([[0.5, 0.2, 0.1, 0.06, 0.04, 0.03, 0.025, 0.02, 0.01, 0.009, 0.006]])
    gains, named, bits = named_classes(np.log(p), logarithmic=True)
    assert named.tolist() == [list(range(NEW_CLASSES))]
    assert bits[0, :NEW_CLASSES].tolist() == [1, 2, 4, 8, 16, 32, 64, 128]
    assert not bits[0, NEW_CLASSES:].any()
    rest = p[0, NEW_CLASSES:].mean()
    assert np.allclose(gains, np.log(p / rest), atol=1e-5)


def with_voxels(count: int) -> EvidenceRows:
    """Labels of a map from before, of so many voxels, whose slots hold anything."""
    labeled = np.full(-(-count // 512) * 512, -1, np.int32)
    labeled[:count] = np.arange(count)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 100))
    rows.fill(Evidence(labeled.reshape(-1, 512), *(np.zeros((count, slots)) for slots in (4, 4, 16, 16))))
    return rows


@pytest.mark.parametrize(
    ("ids", "logs", "merged_ids", "merged_logs"),
    [
        ([1, 2, 3, 0], [5, 4, 3, 0], [3, 1, 0, 0], [7, 5, 0, 0]),  # both there: the sum becomes the best
        ([2, 1, 4, 5], [5, 4, 3, 2], [3, 1, 4, 5], [5, 4, 3, 2]),  # only the dropped one there: it is renamed
        ([1, 2, 3, 4], [5, 4, -6, 1], [1, 4, 3, 0], [5, 1, -2, 0]),  # evidence against either counts too
        ([1, 3, 4, 0], [5, 4, 3, 0], [1, 3, 4, 0], [5, 4, 3, 0]),  # the dropped one not there: nothing changes
    ],
)
def test_merging_adds_evidence_and_keeps_the_best_first(
    ids: list[int], logs: list[float], merged_ids: list[int], merged_logs: list[float]
) -> None:
    rows = with_voxels(1)
    rows.evidence.instance_ids[0], rows.evidence.instance_value[0] = ids, logs
    rows.merge_instances(3, 2)
    found = dict(zip(rows.evidence.instance_ids[0].tolist(), rows.evidence.instance_value[0].tolist(), strict=True))
    assert found == dict(zip(merged_ids, merged_logs, strict=True))
    assert rows.evidence.instance_ids[0, 0] == merged_ids[0]
    assert ((rows.evidence.instance_ids[0] > 0) == (np.array(merged_ids) > 0)).all(), "filled from the front"


@pytest.mark.parametrize("count", [1, 511, 512, 513, 2000])
def test_merging_finds_every_voxel(count: int) -> None:
    """Of thousands, a few know the instance: the first and the last in use, and some between; none beyond."""
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


def test_a_fifth_label_takes_the_place_of_the_least_likely_one_or_none() -> None:
    labels, logs = np.arange(1, 5, dtype=np.int32), np.float32([4, 1, 2, 3])
    assert add_evidence(labels, logs, 0, np.int32(9), np.float32(0.5), Combine.SUM, np.float32(9)) == 1
    assert labels.tolist() == [1, 2, 3, 4], "the newcomer itself is the least likely"
    assert add_evidence(labels, logs, 0, np.int32(9), np.float32(1.5), Combine.SUM, np.float32(9)) == 1
    assert dict(zip(labels.tolist(), logs.tolist(), strict=True)) == {1: 4, 9: 1.5, 3: 2, 4: 3}


def test_the_likeliest_instance_that_counts_need_not_be_the_likeliest() -> None:
    evidence = blank()
    evidence.instance_ids[0], evidence.instance_value[0] = [1, 5, 3, 2], [9, 4, 7, -1]
    counts = np.ones(6, np.bool_)
    assert best_counted_instance(evidence, 0, counts) == 1
    counts[1] = False
    assert best_counted_instance(evidence, 0, counts) == 3
    counts[[3, 5]] = False
    assert best_counted_instance(evidence, 0, counts) == 0, "the rest is likelier than 2"


SEEN = [([1], [0.9], [2]), ([2], [0.4], [3]), ([2], [0.5], [3]), ([3], [0.6], [2])]
"""What four frames say of a voxel: instances, scores, classes."""


@pytest.mark.parametrize(
    ("combine", "weighed", "instance", "label"),
    [
        (Combine.SUM, False, 2, 2),  # counts: instance 2 twice; classes 2 and 3 twice each, and the smaller one wins
        (Combine.LARGEST, True, 1, 2),
        (Combine.LATEST, False, 3, 2),
    ],
)
def test_the_other_rules(combine: Combine, weighed: bool, instance: int, label: int) -> None:
    evidence = blank()
    for ids, scores, classes in SEEN:
        update_voxel(evidence, 0, voted(ids, scores if weighed else [1.0], classes, combine), COVERED)
    assert best_instance(evidence, 0) == instance
    assert best_class(evidence, 0) == label


def test_the_later_of_two_clusters_over_one_pixel_is_what_was_written_last() -> None:
    evidence = blank()
    update_voxel(evidence, 0, voted([1, 2], [1.0, 1.0], [4, 5], Combine.LATEST), COVERED)
    assert best_instance(evidence, 0) == 2
    assert best_class(evidence, 0) == 5
    assert (evidence.instance_ids[0, 1:] == 0).all()


def test_counts_are_counts() -> None:
    evidence = blank()
    for _ in range(3):
        assert update_voxel(evidence, 0, voted([7], [1.0], [2], Combine.SUM), COVERED) == 0
    assert evidence.instance_value[0].tolist() == [3, 0, 0, 0]
    assert evidence.class_value[0, 0] == 300, "units"
    assert evidence.class_ids[0].tolist() == [2, *[NO_CLASS] * (CLASS_SLOTS - 1)]


def test_small_numbers_saturate_and_do_not_wrap() -> None:
    evidence = blank()._replace(class_value=np.zeros((1, CLASS_SLOTS), np.int16))
    said = voted([7, 7], [1.0, 1.0], [2, 3], Combine.SUM)._replace(most_units=MOST_UNITS)
    gains = np.zeros((2, 6))
    gains[:, 2], gains[:, 3] = MOST_GAIN, -MOST_GAIN
    bits = (said.class_said & ALL_NAMED).astype(np.uint8)
    for _ in range(40):
        update_voxel(evidence, 0, said._replace(class_said=class_said(gains, 1, bits, np.int32)), COVERED)
    assert evidence.class_value[0, :2].tolist() == [MOST_UNITS, -MOST_UNITS]
    assert best_class(evidence, 0) == 2


@pytest.mark.parametrize(("classes", "best"), [(2, 0.7), (3, 0.6), (9, 0.8), (80, 0.5)])
def test_the_likeliest_class_stays_the_likeliest_however_often_it_is_seen(classes: int, best: float) -> None:
    """The same distribution 1000 times, its best class the last one and most of the rest on the first."""
    p = np.full((1, classes), 0.1 * (1 - best) / max(classes - 2, 1))
    p[0, 0], p[0, -1] = 1 - best - p[0, 1:-1].sum(), best
    gains, named, bits = named_classes(np.log(0.9 * p + 0.1 / classes), logarithmic=True)
    evidence = blank()._replace(class_value=np.zeros((1, CLASS_SLOTS), np.int16))
    said = measured([1], [0.9], p, 1.0, 1)._replace(
        class_said=class_said(gains, 64, bits, np.int32), named_classes=named, most_units=MOST_UNITS
    )
    for _ in range(1000):
        update_voxel(evidence, 0, said, COVERED)
        assert best_class(evidence, 0) == classes - 1


def test_too_many_classes_are_refused() -> None:
    with pytest.raises(DataError, match="255 classes apart, and the detector has 256"):
        EvidenceRows(VoxelGrid(0.01, 0.05, 10)).begin(256)


def at_pixel(block: int, *voxels: int) -> SeenBlocks:
    """A frame that sees these voxels of one block at the one pixel that there is."""
    pixel = np.full((1, 512), -1, np.int32)
    pixel[0, voxels] = 0
    return seen_at(np.array([block], np.int32), pixel)


def seen_at(blocks: Int32, pixels: Int32) -> SeenBlocks:
    """A frame that sees the voxels of some blocks at pixels (A, 512), -1 = not near."""
    block, voxel = np.nonzero(pixels >= 0)
    count = np.bincount(block, minlength=len(blocks))
    return SeenBlocks(
        blocks,
        np.cumsum(count) - count,
        count.astype(np.int32),
        voxel.astype(np.uint16),
        pixels[block, voxel],
    )


def test_only_voxels_that_are_named_have_slots() -> None:
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
        assert (rows.row_count, rows.voxel_count) == (1, 1), "nothing was said"
        assert len(rows.in_use().class_ids) == 1


@pytest.mark.parametrize("max_blocks", [4, 400])
def test_many_blocks_are_updated_as_voxel_by_voxel(max_blocks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels under no, one or several clusters, some without an instance; slots that have to grow, and some that need
    not; whatever the order of the threads.
    """
    monkeypatch.setattr(evidence_module, "RESERVED", 1 if max_blocks == 4 else 128)
    first, other = by_one_thread_and_two(lambda: _updated(max_blocks))
    for one, two in zip(first, other, strict=True):
        np.testing.assert_array_equal(one, two)


def _updated(max_blocks: int) -> Evidence:
    """The evidence of four blocks after a few frames, compared with each voxel's own."""
    rng = np.random.default_rng(3)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, max_blocks))
    rows.begin(6)
    rows.voxels.allocate(np.array([[k, 0, 0] for k in range(4)], np.int32))
    by_voxel: dict[tuple[int, int], Evidence] = {}
    evicted = 0
    for frame in range(40):  # in the last of which no voxel is new
        instances = [0, 1, 2, 3 + frame]
        said = voted(instances, [1.0, 0.5, 2.0, 1.5], rng.integers(0, 6, 4).tolist(), Combine.SUM)
        points = 12
        cluster = rng.integers(0, 4, points).astype(np.int32)
        pixel_of = rng.integers(0, 8, points)  # of 10 pixels, so that two are under none
        lists = [[k for k in cluster[pixel_of == pixel] if instances[k]] for pixel in range(10)]
        said = said._replace(
            of_pixel=np.arange(1, 11, dtype=np.int32)[None],
            first=np.cumsum([0, 0, *map(len, lists)], dtype=np.int32),
            cluster=np.array([k for clusters in lists for k in clusters], np.int32),
            absence=np.float32(-0.2),
        )
        said = said._replace(class_said=said.class_said.astype(np.int32), most_units=MOST_UNITS)  # as compact storage
        blocks = rng.permutation(4)[:3].astype(np.int32)
        pixels = rng.integers(-1, 10, (3, 512)).astype(np.int32)
        pixels[2] = -1
        rows.update(seen_at(blocks, pixels), said)
        for a in range(2):
            for n in range(512):
                key, pixel = (int(blocks[a]), n), pixels[a, n]
                if pixel >= 0 and (lists[pixel] or key in by_voxel):
                    evicted += update_voxel(by_voxel.setdefault(key, blank()), 0, said, np.int32(pixel + 1))
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


def test_slots_that_a_new_voxel_gives_away_count() -> None:
    said = voted([1, 2, 3, 4, 5, 6], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0] * 6, Combine.SUM)
    expected = update_voxel(blank(), 0, said, COVERED)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10))
    rows.begin(6)
    rows.voxels.allocate(np.zeros((1, 3), np.int32))
    rows.update(at_pixel(0, 5), said)
    assert rows.evicted == expected == 2


def test_both_kinds_of_integers_say_the_same() -> None:
    """The largest gains that compact storage allows."""
    gains = np.array([[MOST_GAIN, -MOST_GAIN, 0.4, -0.6]])
    bits = np.zeros((1, NO_CLASS + 1), np.uint8)
    bits[0, :4] = 1 << np.arange(4)
    narrow, wide = (class_said(gains, 1, bits, kind) for kind in (np.int32, np.int64))
    assert narrow.dtype == np.int32
    np.testing.assert_array_equal(narrow, wide)
    assert (wide[0, :4] >> NEW_CLASSES).tolist() == [MOST_GAIN, -MOST_GAIN, 0, -1]


def test_exact_storage_never_forgets() -> None:
    """Many more instances and classes than the compact slots: every sum is there."""
    rng = np.random.default_rng(0)
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 10), storage=Storage.EXACT)
    rows.begin(30)
    rows.voxels.allocate(np.zeros((1, 3), np.int32))
    class_log, instance_log = np.zeros(30), np.zeros(21)
    for _ in range(100):
        ids = rng.choice(np.arange(1, 21), 3, replace=False)
        p = np.array([distribution(rng, 30) for _ in ids])
        rows.update(at_pixel(0, 5), measured(ids.tolist(), [0.9] * 3, p, 1.0, 20))
        assert rows.evicted == 0
        class_log += np.log(p).sum(axis=0)
        instance_log[ids] += np.log(0.9 / FLOOR)
    labels, values = rows.evidence.class_ids[0], rows.evidence.class_value[0] / UNITS
    assert sorted(labels.tolist()) == list(range(30))
    assert np.allclose(values - values[0], class_log[labels] - class_log[labels[0]], atol=1e-2)
    named = rows.evidence.instance_ids[0] > 0
    assert np.allclose(rows.evidence.instance_value[0][named], instance_log[rows.evidence.instance_ids[0][named]])
    assert named.sum() == 20
