"""Tests for networks with the outputs of published exports, with random values and one known detection."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.detection.candidates import OutputLayout
from framework.detection.masks.letterbox import ImageFormatChoice, Placement
from framework.errors import ConfigError, DataError
from framework.vocabulary.category_ids import CategoryIds
from plugins.detectors.onnx_boxes import OnnxBoxes
from plugins.detectors.onnx_segmentation import OnnxSegmentation
from tests.support.networks.exported_networks import BOX, detectron2, export, mask_rcnn, rf_detr, yolo26
from tests.support.networks.tiny_networks import constant_network

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
SQUARE, WIDE = (1, 3, 432, 432), (3, 240, 320)
X1, Y1, X2, Y2 = (round(value * side) for value, side in zip(BOX, (160, 120, 160, 120), strict=True))
CHAIR = np.zeros((120, 160), np.bool_)  # the known detection, in an input with the aspect ratio of the image
CHAIR[Y1:Y2, X1:X2] = True


def frame() -> Frame:
    depth = np.where(CHAIR, np.float32(1.0), np.float32(2.0))
    return Frame(0, 0.0, np.full((120, 160, 3), 90, np.uint8), depth, CAMERA)


def the_object(detector: OnnxBoxes | OnnxSegmentation) -> tuple[str, np.ndarray[Any, Any], float]:
    """Return class, mask and score of the single confident detection."""
    found = detector.detect(frame())
    assert (found.scores > 0.2).sum() == 1
    return found.classes[int(found.class_probabilities[0].argmax())], found.masks[0], float(found.scores[0])


def iou(mask: np.ndarray[Any, Any], other: np.ndarray[Any, Any] = CHAIR) -> float:
    return float((mask & other).sum() / (mask | other).sum())


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize(
    ("shape", "outputs", "dynamic", "score"),
    [
        (SQUARE, rf_detr(62), False, 1 / (1 + np.exp(-3))),
        (SQUARE, rf_detr(61, columns=90), False, 1 / (1 + np.exp(-3))),
        (SQUARE, rf_detr(56, columns=80), False, 1 / (1 + np.exp(-3))),
        (WIDE, mask_rcnn(62, WIDE[1:]), True, 0.9),
        (WIDE, mask_rcnn(62, WIDE[1:], grid=14, count=2), True, 0.9),
        (WIDE, detectron2(56, WIDE[1:]), True, 0.9),
    ],
    ids=["rf_detr", "rf_detr_90", "rf_detr_80", "torchvision", "torchvision_two", "detectron2"],
)
def test_onnx_segmentation_published_export_finds_chair(
    tmp_path: Path, shape: Any, outputs: Any, dynamic: bool, score: float, empty: bool
) -> None:
    weights = export(tmp_path / "n.onnx", shape, outputs, dynamic, empty)
    name, mask, found = the_object(OnnxSegmentation(weights=weights, device="cpu"))
    assert name == "chair"
    assert found == pytest.approx(score, abs=1e-5)
    assert iou(mask) > 0.9


def test_onnx_segmentation_dynamic_input_needs_size(tmp_path: Path) -> None:
    weights = export(tmp_path / "n.onnx", (3, "height", "width"), mask_rcnn(62, (320, 320)), dynamic=True, empty=True)
    with pytest.raises(ConfigError, match=r"set detector\.input_size=640"):
        OnnxSegmentation(weights=weights, device="cpu")
    name, mask, _ = the_object(OnnxSegmentation(weights=weights, device="cpu", input_size=320))
    assert name == "chair"
    letterboxed = np.zeros_like(CHAIR)  # the image covers the upper 240 of 320 px
    letterboxed[40:120, X1:X2] = True
    assert iou(mask, letterboxed) > 0.9


def test_onnx_segmentation_complete_torchvision_mask_is_read(tmp_path: Path) -> None:
    outputs = mask_rcnn(62, WIDE[1:])
    pasted = np.zeros((5, 1, *WIDE[1:]))
    pasted[0, 0, 60:180, 40:120] = 0.9  # masks pasted into the input, as torchvision's postprocessing writes them
    weights = export(tmp_path / "n.onnx", WIDE, outputs | {"masks": pasted}, dynamic=True)
    name, mask, _ = the_object(OnnxSegmentation(weights=weights, device="cpu"))
    assert (name, iou(mask)) == ("chair", 1.0)


def test_onnx_segmentation_end_to_end_yolo_finds_chair(tmp_path: Path) -> None:
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 640, 640), yolo26(56))
    detector = OnnxSegmentation(weights=weights, device="cpu", placement=Placement.stretch)
    name, mask, score = the_object(detector)
    assert (name, score) == ("chair", pytest.approx(0.9))
    assert iou(mask) > 0.95


@pytest.mark.parametrize(
    ("shape", "outputs"),
    [
        (SQUARE, rf_detr(62, masks=False)),
        (WIDE, {name: value for name, value in mask_rcnn(62, WIDE[1:]).items() if name != "masks"}),
        (WIDE, {name: value for name, value in detectron2(56, WIDE[1:]).items() if name != "6903"}),
        ((1, 3, 480, 640), {"output0": yolo26(56)["output0"][..., :6] * [1, 0.75, 1, 0.75, 1, 1]}),
        ((1, 3, 480, 640), {"output0": yolo26(56)["output0"][..., :6] / [640, 640, 640, 640, 1, 1]}),
    ],
    ids=["rf_detr", "torchvision", "detectron2", "yolo26", "yolo26_unit"],
)
def test_onnx_boxes_published_export_finds_chair(tmp_path: Path, shape: Any, outputs: Any) -> None:
    detector = OnnxBoxes(weights=export(tmp_path / "n.onnx", shape, outputs), device="cpu")
    name, mask, _ = the_object(detector)
    assert name == "chair"
    assert iou(mask) > 0.9


def test_onnx_segmentation_recognized_network_gets_its_image_format(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    weights = export(tmp_path / "n.onnx", SQUARE, rf_detr(62))
    with caplog.at_level(logging.INFO):
        wanted = OnnxSegmentation(weights=weights, device="cpu")._network.format
    assert wanted.placement is Placement.stretch
    np.testing.assert_allclose(wanted.white, [2.2489, 2.4286, 2.64], atol=1e-4)  # ImageNet's, RGB
    assert "detector.preprocessing: image format of RF-DETR" in caplog.text
    custom = OnnxSegmentation(weights=weights, device="cpu", preprocessing=ImageFormatChoice.CUSTOM)._network.format
    assert (custom.placement, custom.black, custom.white) == (Placement.center, 0.0, 1.0)
    traced = export(tmp_path / "d.onnx", WIDE, detectron2(56, WIDE[1:]))
    wanted = OnnxSegmentation(weights=traced, device="cpu")._network.format
    assert (wanted.bgr, wanted.black, wanted.white) == (True, 0.0, 255.0)


def renamed(outputs: Any, **names: str) -> Any:
    return {names.get(name, name): value for name, value in outputs.items()}


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (rf_detr(0, columns=81), r"category_ids: expected the numbering of 81 class columns .*=FROM_ONE .*=FROM_ZERO"),
        (rf_detr(0, columns=12), r"label_space: expected 80 or 81, or 91 class columns, got 12"),
        (rf_detr(0, masks=False), r"expected masks, got a network with boxes only .*; set detector=onnx_boxes"),
        (
            renamed(mask_rcnn(62, SQUARE[2:]), labels="6570", boxes="6568"),
            r"category_ids: expected the numbering of .*set detector\.category_ids=COCO_91 or detector\.category_ids=F",
        ),
        (
            mask_rcnn(62, SQUARE[2:]) | {"boxes": np.tile([200.0, 200.0, 90.0, 90.0], (5, 1))},
            r"weights: expected corners x1 y1 x2 y2 .*set detector\.box_format=CENTER",
        ),
        (mask_rcnn(12, SQUARE[2:]), r"category_ids: expected labels 1 to 90 of 80 classes, got 12"),
    ],
)
def test_onnx_segmentation_ambiguous_export_raises(tmp_path: Path, outputs: Any, message: str) -> None:
    weights = export(tmp_path / "n.onnx", SQUARE, outputs)
    with pytest.raises((ConfigError, DataError), match=message) as refused:
        OnnxSegmentation(weights=weights, device="cpu").detect(frame())
    assert "\n" not in str(refused.value)


def ssd(label: int, tensorflow: bool = True) -> dict[str, np.ndarray[Any, Any]]:
    boxes = np.array(BOX)[None]
    names = ("detection_boxes", "detection_classes", "detection_scores")
    if not tensorflow:
        boxes, names = boxes * [320, 240, 320, 240], ("boxes", "labels", "scores")
    else:
        boxes = boxes[:, [1, 0, 3, 2]][None]
    axis = (1, 1) if tensorflow else (1,)
    return dict(zip(names, (boxes, np.full(axis, float(label)), np.full(axis, 0.9)), strict=True))


@pytest.mark.parametrize(
    ("label", "ids", "name"),
    [
        (62, CategoryIds.AUTO, "chair"),
        (63, CategoryIds.AUTO, "couch"),
        (90, CategoryIds.AUTO, "toothbrush"),
        (57, CategoryIds.FROM_ONE, "chair"),
        (56, CategoryIds.FROM_ZERO, "chair"),
    ],
)
@pytest.mark.parametrize("layout", [OutputLayout.ssd_tensorflow, OutputLayout.ssd_torchvision])
def test_onnx_boxes_ssd_labels_are_coco_ids(
    tmp_path: Path, layout: OutputLayout, label: int, ids: CategoryIds, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    outputs = ssd(label, layout is OutputLayout.ssd_tensorflow)
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 240, 320), outputs)
    with caplog.at_level(logging.INFO):
        detector = OnnxBoxes(weights=weights, device="cpu", layout=layout, category_ids=ids)
    assert the_object(detector)[0] == name
    assert "detector.category_ids: labels of the network read as" in caplog.text


@pytest.mark.parametrize("columns", [80, 81, 90, 91])
def test_onnx_boxes_ssd_class_columns_follow_their_number(tmp_path: Path, columns: int) -> None:
    scores = np.zeros((1, 1, columns))
    scores[0, 0, {80: 56, 81: 57, 90: 61, 91: 62}[columns]] = 0.9
    outputs = {"detection_boxes": ssd(1)["detection_boxes"], "detection_multiclass_scores": scores}
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 240, 320), outputs)
    detector = OnnxBoxes(weights=weights, device="cpu", layout=OutputLayout.ssd_tensorflow)
    assert the_object(detector)[0] == "chair"


@pytest.mark.parametrize(
    ("label", "fix"), [(12, "FROM_ONE"), (26, "FROM_ONE"), (45, "FROM_ONE"), (83, "FROM_ONE"), (0, "FROM_ZERO")]
)
def test_onnx_boxes_ssd_label_without_class_raises(tmp_path: Path, label: int, fix: str) -> None:
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 240, 320), ssd(label))
    with pytest.raises(DataError, match=rf"got {label}; .* detector\.category_ids={fix} if labels have no gaps"):
        OnnxBoxes(weights=weights, device="cpu", layout=OutputLayout.ssd_tensorflow)


def test_onnx_boxes_ssd_unit_labels_need_numbering(tmp_path: Path) -> None:
    outputs = {"boxes": np.array(BOX)[None], "labels": np.array([57.0]), "scores": np.array([0.9])}
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 240, 320), outputs)
    with pytest.raises(ConfigError, match=r"set detector\.category_ids=COCO_91 or detector\.category_ids=FROM_ONE or"):
        OnnxBoxes(weights=weights, device="cpu", layout=OutputLayout.ssd_unit)
    numbered = OnnxBoxes(weights=weights, device="cpu", layout=OutputLayout.ssd_unit, category_ids=CategoryIds.FROM_ONE)
    assert the_object(numbered)[0] == "chair"


def test_onnx_boxes_tensorflow_outputs_error_names_layout(tmp_path: Path) -> None:
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 240, 320), ssd(62))
    with pytest.raises(DataError, match=r"set detector\.layout=ssd_tensorflow detector\.placement=stretch"):
        OnnxBoxes(weights=weights, device="cpu")
