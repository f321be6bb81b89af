"""Tests for the published Mask R-CNN 2Go on real images, in 8-bit integers and in float."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from framework.data import Camera, Frame
from framework.detection.masks.binary_masks import mask_overlaps, tight_boxes
from framework.detection.runtimes.caffe2_network import has_int8_kernels, network_between
from framework.errors import ConfigError, DataError
from framework.files.search_paths import PROJECT_ROOT
from framework.vocabulary.label_spaces import COCO
from plugins.detectors import maskrcnn2go
from plugins.detectors.maskrcnn2go import SHA256, MaskRCNN2Go, _read_network

SHARED = Path(__file__).resolve().parents[4] / "shared"
WEIGHTS = PROJECT_ROOT / "plugins" / "detectors" / "maskrcnn2go_int8"


def picture(color):
    height, width = color.shape[:2]
    camera = Camera(width, height, 500.0, 500.0, width / 2, height / 2)
    return Frame(0, 0.0, color, np.ones((height, width), np.float32), camera)


def shared_picture(scene, index):
    path = SHARED / "data" / scene / "color" / f"{index:06d}.jpg"
    if not path.exists():
        pytest.skip(f"{path} does not exist")
    return picture(cv2.imread(str(path))[..., ::-1].copy())


in_integers = pytest.mark.skipif(not has_int8_kernels(), reason="requires a CPU with VNNI")


@pytest.fixture(scope="module", params=[pytest.param(True, marks=in_integers), False], ids=["int8", "float"])
def detector(request):
    return MaskRCNN2Go(device="cpu", int8=request.param)


def best_scores(detections):
    best = {}
    for score, row in zip(detections.scores, detections.class_probabilities, strict=True):
        name = detections.classes[row.argmax()]
        best[name] = max(best.get(name, 0.0), float(score))
    return best


# The network


@pytest.mark.parametrize(
    ("scene", "index", "expected"),
    [
        ("redkitchen", 0, {"chair": 0.9, "dining table": 0.9, "cup": 0.4, "book": 0.4}),
        ("redkitchen", 290, {"chair": 0.9, "dining table": 0.9, "cup": 0.9, "tv": 0.8, "book": 0.7}),
        ("mit76", 0, {"chair": 0.9, "couch": 0.75, "potted plant": 0.75}),
        ("mit76", 3, {"couch": 0.9, "chair": 0.8}),
    ],
)
def test_maskrcnn2go_detects_expected_objects_in_real_images(detector, scene, index, expected):
    found = best_scores(detector.detect(shared_picture(scene, index)))
    missing = {name: score for name, score in expected.items() if found.get(name, 0) < score}
    assert not missing, f"expected {expected}, got {found}"


def test_maskrcnn2go_mask_of_bed_overlaps_ground_truth(detector):
    root = SHARED / "data" / "replica_floor2"
    if not root.is_dir():
        pytest.skip(f"{root} does not exist")
    beds = [int(i) for i, about in json.loads((root / "instances.json").read_text()).items() if about["class"] == "bed"]
    ious = []
    for index in range(0, 123, 2):
        detections = detector.detect(shared_picture("replica_floor2", index))
        ids = cv2.imread(str(root / "instance" / f"{index:06d}.png"), cv2.IMREAD_UNCHANGED)
        for mask, score, row in zip(detections.masks, detections.scores, detections.class_probabilities, strict=True):
            if score > 0.7 and COCO[row.argmax()] == "bed":
                ious.append(max((mask & (ids == i)).sum() / (mask | (ids == i)).sum() for i in beds))
    assert len(ious) >= 5
    assert np.median(ious) > 0.7  # pillows have separate labels and are not part of the bed


def test_maskrcnn2go_mask_grids_match_full_graph():
    """The complete graph computes a mask for all 81 classes instead of one class per detection."""
    detector = MaskRCNN2Go(device="cpu", int8=False)
    graph, tensors, _ = _read_network(WEIGHTS)
    whole = network_between(graph, tensors, ("_[mask]_pool5_int8",), ("mask_fcn_logits_up_int8",))
    pooled = torch.from_numpy(np.random.default_rng(10).normal(0, 0.3, (4, 128, 6, 6)).astype(np.float32))
    label = np.array([1, 80, 57, 57], np.int32)
    with torch.inference_mode():
        expected = torch.sigmoid(whole(pooled)[0])[torch.arange(4), torch.from_numpy(label).long()]
        np.testing.assert_allclose(detector._mask_grids(pooled, label), expected.numpy(), atol=1e-5)


@in_integers
def test_maskrcnn2go_int8_detections_agree_with_float():
    """For each confident float detection, the best int8 mask of the same class is compared."""
    integers, real = MaskRCNN2Go(device="cpu"), MaskRCNN2Go(device="cpu", int8=False)
    agreements = []
    for scene, index in (("redkitchen", 0), ("redkitchen", 290), ("mit76", 0), ("replica_floor2", 40)):
        frame = shared_picture(scene, index)
        a, b = integers.detect(frame), real.detect(frame)
        for mask, row, score in zip(b.masks, b.class_probabilities, b.scores, strict=True):
            if score > 0.7:
                same = a.masks[a.class_probabilities.argmax(axis=1) == row.argmax()]
                agreements.append(max(((mask & m).sum() / (mask | m).sum() for m in same), default=0.0))
    assert len(agreements) > 8
    assert np.median(agreements) > 0.9
    assert min(agreements) > 0.6


@in_integers
def test_maskrcnn2go_without_int8_kernels_uses_float(monkeypatch, caplog):
    here = MaskRCNN2Go(device="cpu").fingerprint()
    monkeypatch.setattr(maskrcnn2go, "has_int8_kernels", lambda: False)
    caplog.set_level("INFO")
    detector = MaskRCNN2Go(device="cpu")
    assert "detector.int8: expected a CPU with VNNI for exact 8-bit convolutions, got none" in caplog.text
    assert detector.fingerprint() != here
    frame = shared_picture("redkitchen", 0)
    np.testing.assert_array_equal(
        detector.detect(frame).scores, MaskRCNN2Go(device="cpu", int8=False).detect(frame).scores
    )


@in_integers
def test_maskrcnn2go_int8_restores_thread_count(monkeypatch):
    seen = []
    detector = MaskRCNN2Go(device="cpu")
    inner = detector._resize
    monkeypatch.setattr(detector, "_resize", lambda frame: (seen.append(torch.get_num_threads()), inner(frame))[1])
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        detector.detect(shared_picture("redkitchen", 0))
        assert (seen, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


def test_maskrcnn2go_detections_meet_contract(detector):
    frame = shared_picture("redkitchen", 290)
    detections = detector.detect(frame)
    assert detections.classes == detector.classes == COCO
    assert detections.masks.shape == (len(detections), *frame.camera.shape)
    assert len(detections) > 5
    np.testing.assert_allclose(detections.class_probabilities.sum(axis=1), 1, atol=1e-5)
    assert (np.diff(detections.scores) <= 0).all()
    assert detections.scores.min() > 0.1
    np.testing.assert_array_equal(detections.boxes, tight_boxes(detections.masks))
    assert detections.masks.any(axis=(1, 2)).all()


def test_maskrcnn2go_detection_is_repeatable_and_keeps_input(detector):
    frame = shared_picture("mit76", 0)
    before = frame.color.copy()
    first = detector.detect(frame)
    detector.detect(shared_picture("mit76", 4))
    second = detector.detect(frame)
    np.testing.assert_array_equal(frame.color, before)
    for name in ("masks", "boxes", "scores", "class_probabilities"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_maskrcnn2go_agnostic_nms_removes_duplicate_masks(detector):
    frame = shared_picture("redkitchen", 0)
    found = detector.detect(frame)
    overlaps = mask_overlaps(found.masks, found.boxes)
    areas = overlaps.diagonal()
    iou = overlaps / (areas[:, None] + areas - overlaps)
    np.fill_diagonal(iou, 0)
    assert iou.max() <= detector.agnostic_nms_iou
    assert len(MaskRCNN2Go(device="cpu", agnostic_nms_iou=1.0).detect(frame)) > len(overlaps)


@pytest.mark.parametrize("shape", [(480, 640), (33, 57), (240, 1280), (1, 1), (5, 2000)])
def test_maskrcnn2go_blank_image_of_any_size_is_valid(detector, shape):
    for value in (0, 255):
        detections = detector.detect(picture(np.full((*shape, 3), value, np.uint8)))
        assert detections.masks.shape == (len(detections), *shape)


def test_maskrcnn2go_detects_same_objects_in_resized_image(detector):
    frame = shared_picture("redkitchen", 290)
    small = picture(cv2.resize(frame.color, (400, 300), interpolation=cv2.INTER_AREA))
    found = best_scores(detector.detect(small))
    assert found["dining table"] > 0.9
    assert found["chair"] > 0.8


def test_maskrcnn2go_default_weights_load_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert MaskRCNN2Go(device="cpu").classes == COCO


# Errors


def test_maskrcnn2go_missing_weights_error_has_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError) as caught:
        MaskRCNN2Go(weights=Path("no/such/folder"), device="cpu")
    message = str(caught.value)
    assert message.startswith("detector.weights: expected the folder")
    assert str(tmp_path / "no/such/folder") in message
    assert all(name in message for name in SHA256)
    assert "\n" not in message
    with pytest.raises(DataError, match=r"graph\.json: expected a readable file"):
        MaskRCNN2Go(weights=tmp_path, device="cpu")


def test_maskrcnn2go_damaged_weights_raise(tmp_path):
    for name in SHA256:
        (tmp_path / name).write_bytes((WEIGHTS / name).read_bytes())
    damaged = tmp_path / "maskrcnn2go_coco_int8.npz"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with pytest.raises(DataError, match=r"maskrcnn2go_coco_int8\.npz: expected sha256"):
        MaskRCNN2Go(weights=tmp_path, device="cpu")


@pytest.mark.parametrize(
    "parameters",
    [
        {"score_threshold": 1.0},
        {"score_threshold": float("nan")},
        {"nms_iou": 0.0},
        {"agnostic_nms_iou": 1.5},
        {"proposals": 0},
        {"max_detections": 0},
        {"short_side": 8},
        {"long_side": 100},
        {"mask_threshold": 1.0},
        {"device": "tpu"},
    ],
)
def test_maskrcnn2go_invalid_parameter_raises(parameters):
    (name,) = parameters
    with pytest.raises(ConfigError, match=f"detector.{name}: expected .*, got"):
        MaskRCNN2Go(**parameters)
