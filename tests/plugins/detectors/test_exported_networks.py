"""Tests for networks with the outputs of published exports, with random values and one known detection."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto

from framework.data import Camera, Frame
from framework.detection.candidates import OutputLayout
from framework.detection.masks.letterbox import ImageFormatChoice, Placement
from framework.errors import ConfigError, DataError
from framework.vocabulary.category_ids import CategoryIds
from plugins.detectors.onnx_boxes import OnnxBoxes
from plugins.detectors.onnx_segmentation import OnnxSegmentation
from tests.support.networks.exported_networks import (
    BOX,
    cells,
    detections,
    detectron2,
    detr,
    end2end,
    export,
    mask_rcnn,
    mmdeploy,
    prototypes,
    rf_detr,
    rows,
    tensorflow,
    yolo26,
)
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


@pytest.mark.parametrize("ids", [CategoryIds.AUTO, None])
@pytest.mark.parametrize("last", [False, True])
def test_onnx_boxes_background_column_is_first_or_last(tmp_path: Path, last: bool, ids: CategoryIds | None) -> None:
    scores = np.full((1, 40, 81), 0.001)
    scores[..., 80 if last else 0] = 0.9
    scores[0, 0, 56 if last else 57], scores[0, 0, 80 if last else 0] = 0.9, 0.01
    boxes = np.tile(np.array(BOX) * [320, 240, 320, 240], (1, 40, 1))
    weights = constant_network(tmp_path / "n.onnx", (1, 3, 240, 320), {"boxes": boxes, "scores": scores})
    given = ids or (CategoryIds.FROM_ZERO if last else CategoryIds.FROM_ONE)
    detector = OnnxBoxes(weights=weights, device="cpu", layout=OutputLayout.ssd_torchvision, category_ids=given)
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


SIDES = (480, 640)
YOLO = (1, 3, *SIDES)


def swapped(table: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return table.transpose(0, 2, 1)


def pair(table: np.ndarray[Any, Any], rows_first: bool = False) -> dict[str, np.ndarray[Any, Any]]:
    with_coefficients, maps = prototypes(table, *SIDES)
    return {"516": maps, "output0": with_coefficients if rows_first else swapped(with_coefficients)}


def rt_detr() -> np.ndarray[Any, Any]:
    boxes, scores, labels = detections(56, 1, 1)
    centers = np.concatenate([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]], axis=1)
    return np.concatenate([centers, np.eye(80)[labels] * scores[:, None]], axis=1)[None]


def batched() -> dict[str, np.ndarray[Any, Any]]:
    """Return outputs of an RT-DETR or D-FINE, whose labels count from 0 under torchvision's names."""
    return {name: array[None] for name, array in mask_rcnn(56, SIDES).items() if name != "masks"}


BOX_EXPORTS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "tensorflow": ((1, 240, 320, 3), tensorflow(62), {"element": TensorProto.UINT8}),
    "efficientdet": ((1, 480, 640, 3), rows(62, *SIDES, "efficientdet"), {"element": TensorProto.UINT8}),
    "yolov5": (YOLO, {"output0": cells(56, *SIDES, "objectness classes", 3)}, {}),
    "yolov6": (YOLO, {"outputs": cells(56, *SIDES, "ones classes")}, {}),
    "yolov7_end2end": (YOLO, rows(56, *SIDES, "yolov7"), {}),
    "yolo_nas": (YOLO, rows(56, *SIDES, "yolo_nas"), {"dynamic": True, "empty": True}),
    "yolov8": (YOLO, {"output0": swapped(cells(56, *SIDES, "classes"))}, {}),
    "yolov9_end2end": (YOLO, end2end(56, *SIDES), {}),
    "yolox_decoded": (YOLO, {"output": cells(56, *SIDES, "objectness classes")}, {}),
    "rt_detr": (YOLO, {"output0": rt_detr()}, {}),
    "detr": (YOLO, detr(62), {}),
    "mmdeploy": (YOLO, mmdeploy(56, *SIDES, ""), {}),
    "paddle": (YOLO, rows(56, *SIDES, "paddle"), {"sizes": {"scale_factor": TensorProto.FLOAT}}),
    "paddle_empty": (YOLO, rows(56, *SIDES, "paddle"), {"dynamic": True, "empty": True}),
}
MASK_EXPORTS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "tensorflow": ((1, 240, 320, 3), tensorflow(62, masks=True), {"element": TensorProto.UINT8}),
    "yolov5": (YOLO, pair(cells(56, *SIDES, "objectness classes", 3), rows_first=True), {}),
    "yolov8": (YOLO, pair(cells(56, *SIDES, "classes")), {}),
    "detr": (YOLO, detr(62, masks=True), {}),
    "mmdeploy": (YOLO, mmdeploy(56, *SIDES, "in boxes"), {}),
    "mmdeploy_bytes": (YOLO, mmdeploy(56, *SIDES, "bytes"), {}),
    "mmdeploy_logits": (YOLO, mmdeploy(56, *SIDES, "logits"), {}),
    "torchvision_int32": (WIDE, mask_rcnn(62, WIDE[1:]) | {"labels": np.full(5, 62, np.int32)}, {"dynamic": True}),
    "detectron2_bytes": (WIDE, detectron2(56, WIDE[1:]), {"element": TensorProto.UINT8}),
}


@pytest.mark.parametrize(("shape", "outputs", "how"), BOX_EXPORTS.values(), ids=BOX_EXPORTS)
def test_onnx_boxes_common_export_finds_chair(tmp_path: Path, shape: Any, outputs: Any, how: Any) -> None:
    name, mask, _ = the_object(OnnxBoxes(weights=export(tmp_path / "n.onnx", shape, outputs, **how), device="cpu"))
    assert (name, iou(mask) > 0.9) == ("chair", True)


@pytest.mark.parametrize(("shape", "outputs", "how"), MASK_EXPORTS.values(), ids=MASK_EXPORTS)
def test_onnx_segmentation_common_export_finds_chair(tmp_path: Path, shape: Any, outputs: Any, how: Any) -> None:
    weights = export(tmp_path / "n.onnx", shape, outputs, **how)
    name, mask, _ = the_object(OnnxSegmentation(weights=weights, device="cpu"))
    assert (name, iou(mask) > 0.9) == ("chair", True)


@pytest.mark.parametrize(
    ("export_name", "placement", "bgr", "white"),
    [
        ("tensorflow", Placement.stretch, False, 255.0),
        ("yolov5", Placement.center, False, 1.0),
        ("yolov8", Placement.center, False, 1.0),
        ("yolox_decoded", Placement.top_left, True, 255.0),
        ("rt_detr", Placement.stretch, False, 1.0),
    ],
)
def test_onnx_boxes_common_export_gets_its_image_format(
    tmp_path: Path, export_name: str, placement: Placement, bgr: bool, white: float
) -> None:
    shape, outputs, how = BOX_EXPORTS[export_name]
    detector = OnnxBoxes(weights=export(tmp_path / "n.onnx", shape, outputs, **how), device="cpu")
    found = detector._network.format
    assert (found.placement, found.bgr, found.white) == (placement, bgr, white)


@pytest.mark.parametrize("export_name", ["mmdeploy", "yolo_nas"])
def test_onnx_boxes_unknown_image_format_warns(
    tmp_path: Path, export_name: str, caplog: pytest.LogCaptureFixture
) -> None:
    shape, outputs, how = BOX_EXPORTS[export_name]
    weights = export(tmp_path / "n.onnx", shape, outputs, **how)
    OnnxBoxes(weights=weights, device="cpu", preprocessing=ImageFormatChoice.CUSTOM)
    assert "known image format" not in caplog.text
    OnnxBoxes(weights=weights, device="cpu")
    assert "detector.preprocessing: expected a network with a known image format" in caplog.text


def queries() -> dict[str, np.ndarray[Any, Any]]:
    found = rf_detr(56, columns=81, queries=100)
    return {"class_queries_logits": found["labels"], "masks_queries_logits": found["masks"]}


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (batched(), r"set detector\.category_ids=COCO_91 or detector\.category_ids=FROM_ONE or .*=FROM_ZERO"),
        ({"boxes": batched()["boxes"], "scores": np.zeros((1, 5, 80))}, r"set detector\.layout=ssd_torchvision if"),
        (queries(), r"set detector=onnx_segmentation for a network with masks"),
        ({"y": np.zeros((0, 6))}, r"set detector\.layout=end_to_end or detector\.layout=label_first"),
        ({"y": np.zeros((0, 7))}, r"set detector\.layout=image_first or detector\.layout=yolo_nas"),
        ({"Identity": cells(56, *SIDES, "classes")}, r"Ultralytics detector\.layout=yolo detector\.placement=center"),
        (pair(cells(56, *SIDES, "classes")), r"set detector=onnx_segmentation for a network with masks"),
    ],
    ids=["rt_detr_postprocessed", "yolo_nas", "mask2former", "rows", "rows_with_image", "yolov8_tf", "yolov8_seg"],
)
def test_onnx_boxes_uncertain_export_error_names_setting(tmp_path: Path, outputs: Any, message: str) -> None:
    with pytest.raises((ConfigError, DataError), match=message):
        OnnxBoxes(weights=export(tmp_path / "n.onnx", YOLO, outputs), device="cpu")


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (queries(), r"as of Mask2Former, .*set detector=transformers_segmentation"),
        (
            {"output0": swapped(cells(56, *SIDES, "classes"))},
            r"expected masks, got boxes only .*set detector=onnx_boxes",
        ),
        (pair(cells(0, *SIDES, "classes")[..., :5]), r"label_space: expected 116 columns"),
    ],
    ids=["mask2former", "boxes", "fastsam"],
)
def test_onnx_segmentation_other_export_error_names_setting(tmp_path: Path, outputs: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        OnnxSegmentation(weights=export(tmp_path / "n.onnx", YOLO, outputs), device="cpu")


def test_onnx_segmentation_class_agnostic_network_finds_object(tmp_path: Path) -> None:
    weights = export(tmp_path / "n.onnx", YOLO, pair(cells(0, *SIDES, "classes")[..., :5]))  # as FastSAM
    name, mask, _ = the_object(OnnxSegmentation(weights=weights, device="cpu", label_space="agnostic"))
    assert (name, iou(mask) > 0.9) == ("object", True)


def test_onnx_boxes_input_of_image_size_is_given(tmp_path: Path) -> None:
    sizes = {"orig_target_sizes": TensorProto.INT64}  # as in RT-DETR and D-FINE
    weights = export(tmp_path / "n.onnx", YOLO, batched(), sizes=sizes)
    detector = OnnxBoxes(weights=weights, device="cpu", category_ids=CategoryIds.FROM_ZERO)
    assert the_object(detector)[0] == "chair"
    assert detector._network._network._sizes["orig_target_sizes"].tolist() == [[640, 480]]


def test_onnx_boxes_export_of_transformers_finds_chair(tmp_path: Path) -> None:
    outputs = {**detr(62), "last_hidden_state": np.zeros((1, 100, 256))}
    weights = export(
        tmp_path / "n.onnx", YOLO, outputs, sizes={"pixel_mask": TensorProto.INT64}, size_shape=(1, 64, 64)
    )
    detector = OnnxBoxes(weights=weights, device="cpu")
    assert the_object(detector)[0] == "chair"
    assert detector._network._network._sizes["pixel_mask"].all()


@pytest.mark.parametrize(
    ("detector", "outputs"),
    [
        (OnnxBoxes, {"output0": yolo26(0)["output0"][..., :6]}),
        (OnnxBoxes, {"output0": swapped(cells(0, *SIDES, "classes")[..., :6])}),
        (OnnxSegmentation, yolo26(0)),
        (OnnxSegmentation, pair(cells(0, *SIDES, "classes")[..., :6])),
    ],
    ids=["boxes_end_to_end", "boxes", "end_to_end", "segmentation"],
)
def test_own_classes_of_network_error_lists_names(tmp_path: Path, detector: Any, outputs: Any) -> None:
    side = 640 if outputs["output0"].shape[1] == 300 else SIDES[0]
    weights = export(tmp_path / "n.onnx", (1, 3, side, 640), outputs)
    model = onnx.load(weights)
    onnx.helper.set_model_props(model, {"names": "{0: 'forklift', 1: 'pallet'}", "author": "Ultralytics"})
    onnx.save(model, weights)
    with pytest.raises((ConfigError, DataError), match=r"label_space: expected .*\(forklift, pallet\), got 80 names"):
        detector(weights=weights, device="cpu")
