"""Tests for detector=mask_rcnn, with random tiny networks and with a network that detects a known object."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from framework.data import Camera, Frame
from framework.detection.mask_rcnn.network_file import save_network
from framework.detection.masks.binary_masks import mask_overlaps, tight_boxes
from framework.errors import ConfigError, DataError
from plugins.detectors import mask_rcnn
from plugins.detectors.mask_rcnn import MaskRCNNDetector
from tests.support.networks.tiny_mask_rcnn import TINY, tiny_network, tiny_network_file


def picture(color):
    height, width = color.shape[:2]
    camera = Camera(width, height, 500.0, 500.0, width / 2, height / 2)
    return Frame(0, 0.0, color, np.ones((height, width), np.float32), camera)


def noise(seed, shape=(120, 160)):
    return picture(np.random.default_rng(seed).integers(0, 256, (*shape, 3)).astype(np.uint8))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tiny_network_file(tmp_path_factory.mktemp("network"))


@pytest.fixture(scope="module")
def detector(path):
    return MaskRCNNDetector(weights=path, device="cpu")


def test_mask_rcnn_class_row_excludes_background(path):
    """Without suppression, each detection is a label of a proposal and has the softmax score of the label."""
    detector, frame = MaskRCNNDetector(weights=path, device="cpu", agnostic_nms_iou=1.0), noise(0)
    seen = []
    classify = detector._network.classify
    detector._network.classify = lambda *a: seen.append(classify(*a)) or seen[-1]
    found = detector.detect(frame)
    everything = torch.softmax(seen[0][0].double(), dim=1).numpy()
    assert len(found) > 5
    assert everything[:, 0].min() > 0.01, "expected a background probability that is not negligible"
    for score, row in zip(found.scores, found.class_probabilities, strict=True):
        of_objects = everything[:, 1:] / everything[:, 1:].sum(axis=1, keepdims=True)
        nearest = np.abs(of_objects - row).max(axis=1).argmin()
        np.testing.assert_allclose(row, of_objects[nearest], atol=1e-5)
        assert np.abs(everything[nearest, 1:] - score).min() < 1e-5
        assert score < row.max()
    assert (found.scores > detector.score_threshold).all()


def test_mask_rcnn_detections_meet_contract(detector):
    frame = noise(1)
    found = detector.detect(frame)
    assert found.classes == detector.classes == TINY.classes
    assert len(found) > 0
    assert (np.diff(found.scores) <= 0).all()
    np.testing.assert_allclose(found.class_probabilities.sum(axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(found.boxes, tight_boxes(found.masks))
    overlaps = mask_overlaps(found.masks, found.boxes)
    areas = overlaps.diagonal()
    iou = overlaps / (areas[:, None] + areas - overlaps)
    np.fill_diagonal(iou, 0)
    assert iou.max() <= detector.agnostic_nms_iou


def test_mask_rcnn_detection_is_repeatable_and_keeps_input(detector):
    frame = noise(2)
    before = frame.color.copy()
    first = detector.detect(frame)
    detector.detect(noise(3, (90, 130)))
    second = detector.detect(frame)
    np.testing.assert_array_equal(frame.color, before)
    for name in ("masks", "boxes", "scores", "class_probabilities"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("shape", [(120, 160), (33, 57), (24, 400), (1, 1), (3, 700)])
def test_mask_rcnn_blank_image_of_any_size_is_valid(detector, shape):
    for value in (0, 255):
        found = detector.detect(picture(np.full((*shape, 3), value, np.uint8)))
        assert found.masks.shape == (len(found), *shape)


def test_mask_rcnn_proposal_and_detection_limits_are_respected(path, monkeypatch):
    given = []
    propose = mask_rcnn.propose
    monkeypatch.setattr(mask_rcnn, "propose", lambda *a: given.append(propose(*a)) or given[-1])
    few = MaskRCNNDetector(
        weights=path, device="cpu", proposals=7, max_detections=3, agnostic_nms_iou=1.0, score_threshold=0.0
    )
    assert len(few.detect(noise(4))) == 3
    assert len(given[0]) == 7
    one = MaskRCNNDetector(weights=path, device="cpu", proposals_before_nms=1)
    one.detect(noise(4))
    assert len(given[1]) <= 5, "expected at most one proposal per level"


def test_mask_rcnn_sides_default_to_network_settings(path):
    frame = noise(5, (120, 160))
    assert MaskRCNNDetector(weights=path, device="cpu")._resize(frame).shape[2:] == (96, 128)
    assert MaskRCNNDetector(weights=path, device="cpu", short_side=60)._resize(frame).shape[2:] == (60, 80)
    assert MaskRCNNDetector(weights=path, device="cpu", short_side=240)._resize(frame).shape[2:] == (240, 320)
    wide = noise(5, (100, 400))
    assert MaskRCNNDetector(weights=path, device="cpu")._resize(wide).shape[2:] == (40, 160)
    assert MaskRCNNDetector(weights=path, device="cpu", long_side=200)._resize(wide).shape[2:] == (50, 200)


def known_object(folder, monkeypatch, extent, resized):
    """Return a detector that resizes the short side of images to `resized` px and detects one chair.

    `extent` is the box x1 y1 x2 y2 of the chair, px, in an image of 160x120 px.
    """
    network = tiny_network(replace(TINY, short_side=resized, long_side=4 * resized))
    for parameter in network.roi_heads.parameters():
        parameter.data.zero_()
    network.roi_heads.box_predictor.cls_score.bias.data[1] = 6.0
    network.roi_heads.mask_predictor.mask_fcn_logits.bias.data[1] = 4.0
    path = folder / f"{resized}.safetensors"
    save_network(network, path, {})
    detector = MaskRCNNDetector(weights=path, device="cpu")
    box = np.array([extent], np.float32) * np.float32(resized / 120)
    monkeypatch.setattr(mask_rcnn, "propose", lambda *_: box)
    return detector


@pytest.mark.parametrize("resized", [60, 96, 120, 300])
def test_mask_rcnn_detect_at_any_scale_keeps_box_position(tmp_path, monkeypatch, resized):
    """The borders of the pixels u = 20 to 59 and v = 30 to 89 are at 20, 60, 30 and 90."""
    found = known_object(tmp_path, monkeypatch, (20, 30, 60, 90), resized).detect(noise(6))
    assert len(found) == 1
    expected = np.zeros((120, 160), bool)
    expected[30:90, 20:60] = True
    np.testing.assert_array_equal(found.masks[0], expected)
    np.testing.assert_allclose(found.scores, np.exp(6) / (np.exp(6) + 3), rtol=1e-5)
    np.testing.assert_allclose(found.class_probabilities[0, 0], np.exp(6) / (np.exp(6) + 2), rtol=1e-5)


@pytest.mark.parametrize("short_side", [32, 40, 80])
def test_mask_rcnn_resize_keeps_ramp_position(path, short_side):
    """The value of the ramp at u is 5 u."""
    ramp = np.repeat(np.tile(5 * np.arange(50, dtype=np.uint8), (40, 1))[..., None], 3, axis=2)
    image = MaskRCNNDetector(weights=path, device="cpu", short_side=short_side, long_side=400)._resize(picture(ramp))
    places = (np.arange(image.shape[3]) + 0.5) * 40 / short_side - 0.5
    # pixel u' of the resized image shows u = (u' + 0.5) / scale - 0.5; values are rounded to integers
    np.testing.assert_allclose(image[0, 0, 5, 2:-2].numpy(), 5 * places[2:-2], atol=0.51)


def test_mask_rcnn_overflow_raises(tmp_path):
    network = tiny_network()
    network.roi_heads.box_head.fc6.weight.data.fill_(3e38)
    save_network(network, tmp_path / "wild.safetensors", {})
    detector = MaskRCNNDetector(weights=tmp_path / "wild.safetensors", device="cpu")
    with pytest.raises(
        DataError, match=r"^detector\.weights: expected finite outputs of .*wild\.safetensors, got NaN or infinity$"
    ):
        detector.detect(noise(7))


def test_mask_rcnn_without_proposals_detects_nothing(detector, monkeypatch):
    monkeypatch.setattr(mask_rcnn, "propose", lambda *_: np.zeros((0, 4), np.float32))
    assert len(detector.detect(noise(8))) == 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="requires CUDA")
def test_mask_rcnn_half_precision_agrees_with_single(path):
    frame = noise(9)
    half, single = (
        MaskRCNNDetector(weights=path, device="cuda", half_precision=half).detect(frame) for half in (True, False)
    )
    assert len(half) == pytest.approx(len(single), rel=0.2)
    np.testing.assert_allclose(half.scores[:5], single.scores[:5], atol=0.02)


# Errors


@pytest.mark.parametrize(
    ("parameters", "fault"),
    [
        ({"score_threshold": 1.0}, r"detector\.score_threshold: expected a value in \[0, 1\), got 1\.0"),
        ({"nms_iou": 0.0}, r"detector\.nms_iou: expected a value in \(0, 1\]"),
        ({"agnostic_nms_iou": 1.1}, r"detector\.agnostic_nms_iou: expected a value in \(0, 1\]"),
        ({"proposals_before_nms": 0}, r"detector\.proposals_before_nms: expected a value in \[1, "),
        ({"proposals": 0}, r"detector\.proposals: expected a value in \[1, "),
        ({"max_detections": 0}, r"detector\.max_detections: expected a value in \[1, "),
        ({"short_side": 31}, r"detector\.short_side: expected 0 or a value in \[32"),
        ({"long_side": -1}, r"detector\.long_side: expected 0 or a value in \[32"),
        ({"short_side": 200, "long_side": 100}, r"detector\.long_side: expected at least 200 px, got 100"),
        ({"mask_threshold": 1.0}, r"detector\.mask_threshold: expected a value in \(0, 1\)"),
        ({"device": "tpu"}, r"detector\.device: expected auto, cpu or cuda"),
    ],
)
def test_mask_rcnn_invalid_parameter_raises(path, parameters, fault):
    with pytest.raises(ConfigError, match=fault):
        MaskRCNNDetector(**({"weights": path, "device": "cpu"} | parameters))


def test_mask_rcnn_unusable_weights_raise_one_line_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        DataError, match=r"^detector\.weights: .*: expected a file or one of .*resnet50_fpn_coco"
    ) as caught:
        MaskRCNNDetector(weights=Path("no/such.pth"), device="cpu")
    assert "\n" not in str(caught.value)
    (tmp_path / "bad.safetensors").write_bytes(b"bad")
    with pytest.raises(DataError, match=r"^detector\.weights: .*bad\.safetensors: expected a safetensors file"):
        MaskRCNNDetector(weights=Path("bad.safetensors"), device="cpu")


def test_mask_rcnn_weights_attribute_is_resolved_path(path, monkeypatch):
    monkeypatch.chdir(path.parent)
    assert MaskRCNNDetector(weights=Path(path.name), device="cpu").weights == path.resolve()
