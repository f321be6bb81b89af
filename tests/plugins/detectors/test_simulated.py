"""Tests for the simulated detector and the statistics of its errors."""

from dataclasses import fields, replace

import numpy as np
import pytest

from framework.data import Camera, Frame, FrameTruth
from framework.detection.masks.binary_masks import tight_boxes
from framework.errors import ConfigError, DataError
from framework.vocabulary.label_spaces import COCO
from plugins.detectors.ground_truth import GroundTruthDetector
from plugins.detectors.simulated import (
    CLUTTER_CLASSES,
    LOOKALIKES,
    SimulatedDetector,
    confusion_kernel,
    ellipse,
    signed_distance,
    smooth_field,
    touching_pairs,
)

PERFECT = SimulatedDetector(
    merge_rate=0,
    miss_rate=0,
    miss_size_scale=0,
    truncated_miss_rate=0,
    split_rate=0,
    shift=0,
    bleed=0,
    boundary_noise=0,
    mask_grid=0,
    confusion=0,
    score_concentration=0,
    score_threshold=0,
    false_positives=0,
)
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
IDS = np.zeros((120, 160), np.int32)
IDS[20:60, 20:60] = 5  # a chair
IDS[20:60, 60:100] = 6  # a couch that touches the chair
IDS[70:90, 40:60] = 9  # a small cup
IDS[80:120, 100:160] = 12  # a bed at the image corner
IDS[0:10, 0:10] = 30  # an object without a class
TRUTH = FrameTruth(IDS, {5: "chair", 6: "couch", 9: "cup", 12: "bed", 30: None})


def frame(index=0, depth=1.0):
    return Frame(
        index, 0.0, np.zeros((120, 160, 3), np.uint8), np.full((120, 160), depth, np.float32), CAMERA, truth=TRUTH
    )


def same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("masks", "boxes", "scores", "class_probabilities")
    )


def count_of(detector, mask, frames=400):
    """Return the number of frames with a detection whose center pixel is in `mask`."""
    return sum(bool((d.masks & mask).any()) for d in (detector.detect(frame(k)) for k in range(frames)))


def test_simulated_zero_error_rates_give_ground_truth():
    for index in range(3):
        assert same(PERFECT.detect(frame(index)), GroundTruthDetector().detect(frame(index)))


def test_simulated_default_detections_meet_contract():
    detector = SimulatedDetector(false_positives=3)
    for index in range(30):
        detections = detector.detect(frame(index))
        np.testing.assert_allclose(detections.class_probabilities.sum(axis=1), 1, atol=1e-5)
        assert detections.class_probabilities.size == 0 or detections.class_probabilities.min() > 0
        assert (np.diff(detections.scores) <= 0).all()
        assert (detections.scores >= detector.score_threshold).all()
        assert detections.masks.any(axis=(1, 2)).all()
        np.testing.assert_array_equal(detections.boxes, tight_boxes(detections.masks))


def test_simulated_results_depend_on_seed_and_frame_not_order():
    detector = SimulatedDetector(seed=3)
    forward = [detector.detect(frame(k)) for k in range(6)]
    backward = [SimulatedDetector(seed=3).detect(frame(k)) for k in reversed(range(6))][::-1]
    assert all(same(a, b) for a, b in zip(forward, backward, strict=True))
    assert not same(forward[0], forward[1])
    assert not same(forward[0], SimulatedDetector(seed=4).detect(frame(0)))


def test_simulated_error_types_have_independent_random_streams():
    """With a higher miss rate, the remaining detections are unchanged."""
    few = SimulatedDetector(miss_rate=0.0, false_positives=0, merge_rate=0)
    many = replace(few, miss_rate=0.5)
    for index in range(20):
        a, b = few.detect(frame(index)), many.detect(frame(index))
        assert {m.tobytes() for m in b.masks} <= {m.tobytes() for m in a.masks}


def test_simulated_miss_rates_match_parameters():
    chair, cup, bed = IDS == 5, IDS == 9, IDS == 12
    assert count_of(replace(PERFECT, miss_rate=0.3), chair) == pytest.approx(400 * 0.7, abs=30)  # 3 sigma
    smaller = replace(PERFECT, miss_size_scale=20.0)
    assert count_of(smaller, cup) == pytest.approx(400 * (1 - np.exp(-1)), abs=30)
    assert count_of(smaller, chair) == pytest.approx(400 * (1 - np.exp(-2)), abs=22)
    truncated = replace(PERFECT, truncated_miss_rate=0.4)
    assert count_of(truncated, chair) == 400
    assert count_of(truncated, bed) == pytest.approx(400 * 0.6, abs=30)


def test_simulated_split_object_gives_two_parts_at_split_rate():
    detections = replace(PERFECT, split_rate=1.0).detect(frame())
    assert len(detections) == 8
    assert (detections.masks.sum(axis=0) == np.isin(IDS, (5, 6, 9, 12))).all()
    assert detections.scores.max() < 0.7  # each part covers about half of the object
    rate = np.mean([len(replace(PERFECT, split_rate=0.25).detect(frame(k))) - 4 for k in range(200)]) / 4
    assert rate == pytest.approx(0.25, abs=0.05)


def test_simulated_only_touching_neighbors_merge_at_merge_rate():
    detections = replace(PERFECT, merge_rate=1.0).detect(frame())
    assert len(detections) == 3
    assert sum((mask == np.isin(IDS, (5, 6))).all() for mask in detections.masks) == 1
    rate = np.mean([4 - len(replace(PERFECT, merge_rate=0.3).detect(frame(k))) for k in range(300)])
    assert rate == pytest.approx(0.3, abs=0.08)


def test_simulated_depth_step_separates_neighbors():
    flat = frame()
    assert touching_pairs(flat).tolist() == [[5, 6]]
    depth = np.where(IDS == 6, 2.0, 1.0).astype(np.float32)
    assert touching_pairs(replace(flat, depth=depth)).shape == (0, 2)


def test_simulated_bleed_grows_mask_by_given_pixels():
    for bleed, side in ((3.0, 46), (-4.0, 32)):
        detections = replace(PERFECT, bleed=bleed).detect(frame())
        (box,) = [b for b, m in zip(detections.boxes, detections.masks, strict=True) if m[40, 40] and not m[40, 90]]
        assert box.tolist() == [40 - side / 2, 40 - side / 2, 39 + side / 2, 39 + side / 2]
    bed = max(replace(PERFECT, bleed=-4.0).detect(frame()).masks, key=lambda m: m[110, 150])
    assert bed[119, 159], "expected a mask that does not shrink at the image border"


def test_simulated_shift_and_border_noise_have_given_deviation():
    detector = replace(PERFECT, shift=2.0)
    centers = []
    for k in range(200):
        detections = detector.detect(frame(k))
        (box,) = [b for b, m in zip(detections.boxes, detections.masks, strict=True) if m[40, 40] and not m[40, 90]]
        centers.append((box[:2] + box[2:]) / 2)
    assert np.std(centers, axis=0) == pytest.approx(2.0, rel=0.2)
    assert np.mean(centers, axis=0) == pytest.approx(39.5, abs=0.5)

    fields = np.stack([smooth_field(np.random.default_rng(k), (90, 70), 12.0) for k in range(200)])
    assert fields.mean() == pytest.approx(0, abs=0.05)
    assert fields.std(axis=0) == pytest.approx(1, abs=0.3)
    assert fields.std() == pytest.approx(1, abs=0.05)
    # after blurring with sigma = scale, the correlation at distance d is exp(-d^2 / (4 scale^2))
    for distance in (1, 12, 24):
        correlation = np.mean(fields[:, :, distance:] * fields[:, :, :-distance]) / fields.var()
        assert correlation == pytest.approx(np.exp(-((distance / 24) ** 2)), abs=0.08)


def test_signed_distance_of_half_plane_is_exact():
    mask = np.zeros((5, 10), np.uint8)
    mask[:, 4:] = 1
    np.testing.assert_allclose(signed_distance(mask)[2], np.arange(10) - 3.5)


def test_simulated_coarse_mask_grid_keeps_square_and_blurs_comb():
    fine, coarse = PERFECT.detect(frame()), replace(PERFECT, mask_grid=28).detect(frame())
    assert (fine.masks ^ coarse.masks).mean() < 1e-3
    comb = np.zeros((120, 160), np.int32)
    comb[10:110, 10:150:2] = 5
    detail = replace(frame(), truth=FrameTruth(comb, {5: "chair"}))
    (mask,) = replace(PERFECT, mask_grid=8, score_threshold=0.0).detect(detail).masks
    assert np.mean(mask != (comb == 5)) > 0.2


def test_confusion_kernel_is_larger_for_similar_classes():
    kernel = confusion_kernel(COCO, 0.25)
    np.testing.assert_allclose(kernel.sum(axis=1), 1)
    np.testing.assert_allclose(np.diag(kernel), 0.75)
    chair, couch, cup = (COCO.index(name) for name in ("chair", "couch", "cup"))
    assert kernel[chair, couch] > 10 * kernel[chair, cup] > 0
    assert all(name in COCO for group in LOOKALIKES for name in group)
    np.testing.assert_array_equal(confusion_kernel(COCO, 0.0), np.eye(80))


def distributions(detector, frames):
    """Return the class distributions (frames, classes) of the couch, which is identified by its position."""
    rows = []
    for k in range(frames):
        detections = detector.detect(frame(k))
        (row,) = [p for p, m in zip(detections.class_probabilities, detections.masks, strict=True) if m[40, 80]]
        rows.append(row)
    return np.array(rows)


def test_simulated_class_rows_average_to_confusion_kernel():
    couch = COCO.index("couch")
    detector = replace(PERFECT, confusion=0.3, confusion_concentration=3.0, confusion_consistency=0.0)
    rows = distributions(detector, 600)
    assert rows.mean(axis=0) == pytest.approx(confusion_kernel(COCO, 0.3)[couch], abs=0.04)
    wrong = np.mean(rows.argmax(axis=1) != couch)
    assert 0.05 < wrong < 0.4
    steady = distributions(replace(detector, confusion_concentration=1e6), 20)
    assert steady == pytest.approx(np.tile(confusion_kernel(COCO, 0.3)[couch], (20, 1)), abs=0.01)


def test_simulated_consistent_confusion_repeats_in_all_frames():
    detector = replace(PERFECT, confusion=0.3, confusion_consistency=1.0)
    assert np.ptp(distributions(detector, 10), axis=0).max() == 0
    half = distributions(replace(detector, confusion_consistency=0.5), 300)
    _, counts = np.unique(half.round(5), axis=0, return_counts=True)
    assert counts.max() / 300 == pytest.approx(0.5, abs=0.09)


def test_simulated_scores_correlate_with_detection_quality():
    detector = replace(PERFECT, score_concentration=20.0, boundary_noise=6.0, bleed=4.0, confusion=0.2)
    scores, quality = [], []
    for k in range(150):
        detections = detector.detect(frame(k))
        for mask, score, row in zip(detections.masks, detections.scores, detections.class_probabilities, strict=True):
            true = max((5, 6, 9, 12), key=lambda i, m=mask: (m & (i == IDS)).sum()) == IDS
            scores.append(score)
            quality.append((mask & true).sum() / (mask | true).sum() * row.max())
    assert np.corrcoef(scores, quality)[0, 1] > 0.6
    assert np.mean(scores) == pytest.approx(np.mean(quality), abs=0.02)


def test_simulated_false_positives_have_given_rate_and_score():
    detector = replace(PERFECT, false_positives=1.5, score_concentration=20.0)
    empty = replace(frame(), truth=FrameTruth(np.zeros_like(IDS), {}))
    found = [detector.detect(replace(empty, index=k)) for k in range(200)]
    assert np.mean([len(d) for d in found]) == pytest.approx(1.5, abs=0.3)
    assert np.mean(np.concatenate([d.scores for d in found])) == pytest.approx(0.25, abs=0.04)


THING = np.zeros((120, 160), np.int32)
THING[20:60, 20:60] = 5  # a chair
THING[20:50, 60:90] = 31  # an object without a class that touches the chair
THING[80:110, 20:50] = 32  # an object without a class that touches no other object
ROOM = FrameTruth(THING, {5: "chair", **dict.fromkeys(range(31, 200))})


def test_simulated_attached_neighbor_is_same_in_all_frames():
    taken = []
    for seed in range(200):
        detector = replace(PERFECT, attach_rate=0.3, seed=seed)
        masks = [detector.detect(replace(frame(k), truth=ROOM)).masks[0] for k in range(3)]
        assert all(np.array_equal(mask, masks[0]) for mask in masks)
        assert np.array_equal(masks[0], (THING == 5) | (THING == 31) & masks[0][30, 70])
        taken.append(masks[0][30, 70])
    assert np.mean(taken) == pytest.approx(0.3, abs=0.09)
    large = THING.copy()
    large[20:120, 60:160] = 31  # an object of more than twice the size of the chair
    alone = replace(PERFECT, attach_rate=1.0).detect(replace(frame(), truth=FrameTruth(large, ROOM.class_names)))
    np.testing.assert_array_equal(alone.masks[0], large == 5)


def test_simulated_clutter_has_same_class_in_all_frames():
    detector = replace(PERFECT, clutter_rate=0.4, score_concentration=20.0)
    taken = 0
    for thing in range(31, 200):
        truth = FrameTruth(np.where(THING == 32, thing, 0).astype(np.int32), ROOM.class_names)
        found = [detector.detect(replace(frame(k), truth=truth)) for k in range(3)]
        assert len({len(d) for d in found}) == 1
        assert len({row.argmax() for d in found for row in d.class_probabilities}) == len(found[0])
        assert all(np.array_equal(d.masks[0], THING == 32) for d in found if len(d))
        taken += len(found[0])
    assert taken / 169 == pytest.approx(0.4, abs=0.12)


def test_simulated_miss_spread_varies_miss_rate_between_objects():
    alike = replace(PERFECT, miss_rate=0.5)
    apart = replace(alike, miss_spread=2.0)

    def seen(detector):
        found = [sum(len(detector.detect(replace(frame(k), truth=one))) for k in range(20)) / 20 for one in objects]
        return np.array(found)

    objects = [FrameTruth(np.where(IDS == 9, i, 0).astype(np.int32), {i: "cup"}) for i in range(100, 160)]
    even, uneven = seen(alike), seen(apart)
    assert even.mean() == pytest.approx(0.5, abs=0.05)
    assert uneven.mean() == pytest.approx(0.5, abs=0.13)
    assert ((even > 0.1) & (even < 0.9)).all()
    # rates below 10 % or above 90 % correspond to logits outside +-2.2: 27 % of a normal distribution with deviation 2
    assert ((uneven < 0.1) | (uneven > 0.9)).mean() == pytest.approx(0.27, abs=0.15)


def test_simulated_false_positives_keep_world_position():
    detector = replace(PERFECT, false_positives=1.0, recurring_fraction=1.0)
    wall = np.full((120, 160), 2.0, np.float32)
    places, classes = [], []
    for k in range(40):
        moved = np.eye(4)
        moved[0, 3] = 0.01 * k  # m, along the wall
        seen = replace(frame(k), depth=wall, T_world_camera=moved, truth=FrameTruth(np.zeros_like(IDS), {}))
        found = detector.detect(seen)
        for mask, row in zip(found.masks, found.class_probabilities, strict=True):
            u = np.nonzero(mask)[1].mean()
            places.append((u - CAMERA.cx) * 2.0 / CAMERA.fx + moved[0, 3])
            classes.append(int(row.argmax()))
    assert 20 < len(places) < 60
    _, counts = np.unique(classes, return_counts=True)
    assert counts.max() > 20, "expected one position in most frames"
    first = np.array(places)[np.array(classes) == np.bincount(classes).argmax()]
    assert np.ptp(first) < 0.55, "expected positions within a width of 0.5 m"


def test_simulated_recurring_false_positives_need_poses():
    detector = replace(PERFECT, false_positives=1.0, recurring_fraction=1.0)
    empty = [replace(frame(k), truth=FrameTruth(np.zeros_like(IDS), {})) for k in range(5)]
    found = [detector.detect(one) for one in empty]
    assert sum(map(len, found)) > 0
    anywhere = replace(detector, recurring_fraction=0.0)
    assert all(same(a, anywhere.detect(one)) for a, one in zip(found, empty, strict=True))


def test_simulated_score_scale_multiplies_scores():
    np.testing.assert_allclose(replace(PERFECT, score_scale=0.5).detect(frame()).scores, 0.5)


def test_simulated_touching_pairs_match_reference():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        ids = np.kron(rng.integers(0, 9, (12, 16)), np.ones((10, 10), int)).astype(np.int32)
        depth = np.kron(rng.uniform(1, 1.5, (12, 16)), np.ones((10, 10))).astype(np.float32)
        expected = set()
        for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            near = np.abs(depth[here] - depth[there]) < 0.1
            touch = near & (ids[here] > 0) & (ids[there] > 0) & (ids[here] != ids[there])
            expected |= {tuple(sorted(pair)) for pair in zip(ids[here][touch], ids[there][touch], strict=True)}
        seen = replace(frame(), depth=depth, truth=FrameTruth(ids, {}))
        assert touching_pairs(seen).tolist() == sorted(map(list, expected))
        assert 3 < len(expected) < 36  # of 36 possible pairs


@pytest.mark.parametrize("place", [(80.3, 60.2), (0.0, 0.0), (159.9, 119.9), (3.5, 118.0)])
def test_simulated_ellipse_matches_reference(place):
    x, y = place
    v, u = np.ogrid[:120, :160]
    for seed, (a, b) in enumerate(((12.0, 80.0), (40.5, 13.0), (79.0, 80.0))):
        wobble = smooth_field(np.random.default_rng(seed), (120, 160), 12.0) * np.float32(0.4)
        for field in (wobble, wobble + np.float32(3)):  # the second size gives an empty ellipse
            expected = np.hypot((u - x) / a, (v - y) / b) + field < 1
            np.testing.assert_array_equal(ellipse(x, y, a, b, field), expected)


def test_simulated_missing_truth_raises():
    with pytest.raises(DataError, match="expected instance ground truth"):
        SimulatedDetector().detect(replace(frame(), truth=None))


def test_simulated_frame_without_instances_has_no_detections():
    assert len(PERFECT.detect(replace(frame(), truth=FrameTruth(np.zeros_like(IDS), {})))) == 0


@pytest.mark.parametrize(
    "parameters",
    [
        {"seed": -1},
        {"min_pixels": 0},
        {"miss_rate": 1.1},
        {"miss_size_scale": -1.0},
        {"bleed": float("nan")},
        {"boundary_scale": 1.0},
        {"mask_grid": 3},
        {"confusion": 1.0},
        {"confusion_concentration": 0.0},
        {"false_positives": -1.0},
        {"false_positive_score": 1.0},
        {"clutter_rate": 1.1},
        {"attach_rate": -0.1},
        {"miss_spread": -1.0},
        {"score_scale": 0.0},
        {"recurring_fraction": 2.0},
    ],
)
def test_simulated_invalid_parameter_raises(parameters):
    (name,) = parameters
    with pytest.raises(ConfigError, match=f"detector.{name}: expected .*, got"):
        SimulatedDetector(**parameters)


OWN_TRUTH = FrameTruth(IDS, {5: "forklift", 6: "pallet", 9: "forklift", 12: "chair", 30: None})


def own_detector(folder, *names, **parameters):
    (folder / "names.txt").write_text("\n".join(names))
    return SimulatedDetector(label_space=str(folder / "names.txt"), **parameters)


def test_simulated_own_classes_without_errors_give_ground_truth(tmp_path):
    names = "forklift", "pallet", "chair"
    perfect = {field.name: getattr(PERFECT, field.name) for field in fields(PERFECT) if field.name != "label_space"}
    own = own_detector(tmp_path, *names, **perfect)
    truth = GroundTruthDetector(label_space=own.label_space)
    assert own.classes == truth.classes == names
    image = replace(frame(), truth=OWN_TRUTH)
    assert same(own.detect(image), truth.detect(image))


def test_simulated_own_classes_are_confused_equally():
    kernel = confusion_kernel(("forklift", "chair", "couch", "pallet"), 0.3)
    np.testing.assert_allclose(kernel[0], [0.7, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(kernel[1], [0.03, 0.7, 0.24, 0.03])  # a chair is similar to a couch


@pytest.mark.parametrize("classes", [("object",), ("chair", "couch"), ("forklift", "pallet")])
def test_simulated_confusions_of_few_classes_are_distributions(classes):
    kernel = confusion_kernel(classes, 0.3)
    np.testing.assert_allclose(kernel.sum(axis=1), 1)
    assert kernel[0, 0] == pytest.approx(1.0 if len(classes) == 1 else 0.7)


def test_simulated_clutter_has_own_classes(tmp_path):
    """The label space has no class of CLUTTER_CLASSES."""
    own = own_detector(tmp_path, "forklift", "pallet", clutter_rate=1.0, false_positives=3, recurring_fraction=1.0)
    image = replace(frame(), truth=FrameTruth(IDS, {5: None, 6: "pallet"}), T_world_camera=np.eye(4))
    assert {own.classes[k] for k in own.detect(image).class_probabilities.argmax(axis=1)} <= {"forklift", "pallet"}


def test_simulated_coco_classes_are_unchanged():
    """A label space must not change the random numbers of the default."""
    detector = SimulatedDetector()
    assert detector.classes == COCO
    assert [COCO[k] for k in detector._clutter_ids] == list(CLUTTER_CLASSES)
    index = {name: k for k, name in enumerate(COCO)}
    alike = [{other for group in LOOKALIKES if name in group for other in group} - {name} for name in COCO]
    expected = np.zeros((len(COCO), len(COCO)))
    for k, similar in enumerate(alike):
        fraction = 0.8 if similar else 0.0
        expected[k] = 0.25 * (1 - fraction) / (len(COCO) - 1 - len(similar))
        expected[k, [index[name] for name in similar]] = 0.25 * fraction / max(len(similar), 1)
        expected[k, k] = 0.75
    np.testing.assert_allclose(detector._kernel, expected, rtol=1e-12)
