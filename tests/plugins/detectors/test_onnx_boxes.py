"""Tests for box detectors in ONNX files, with known outputs and with YOLOX-nano on real images."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.detection.candidates import OutputLayout
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.masks.letterbox import Placement
from framework.errors import ConfigError, DataError
from framework.vocabulary.label_spaces import COCO, ClassNames
from plugins.detectors.onnx_boxes import OnnxBoxes
from tests.support import registered
from tests.support.networks.tiny_networks import constant_network

WEIGHTS = Path("weights") / "yolox_nano" / "yolox_nano.onnx"

# a cup in front of a wall; the input of the network has half the size of the image
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
CUP = np.zeros((120, 160), np.bool_)
CUP[30:70, 40:60] = True
BOX = np.array([19.0, 14.0, 31.0, 36.0])  # x1 y1 x2 y2 in the input: the cup and a margin of two image pixels
SHAPE = (60, 80)
LABELS = ("chair", "cup", "wall")  # nyu40 has the class wall, which is no object


def frame(index=0):
    depth = np.where(CUP, np.float32(1.0), np.float32(2.0))
    return Frame(index, 0.0, np.full((120, 160, 3), 90, np.uint8), depth, CAMERA)


def center_size(box):
    return np.concatenate([(box[:2] + box[2:]) / 2, box[2:] - box[:2]])


def outputs_of(layout):
    """Return the network outputs for a cup (scores 0.6 cup, 0.2 chair), a wall and a weak candidate."""
    boxes = np.array([BOX, BOX + 20, BOX - 10])
    scores = np.array([[0.2, 0.6, 0.0], [0.1, 0.1, 0.9], [0.01, 0.02, 0.0]])
    rows = np.array([center_size(box) for box in boxes])
    if layout is OutputLayout.yolo:
        return {"output0": np.concatenate([rows, scores], axis=1).T[None]}
    if layout is OutputLayout.yolo_objectness:
        return {"output": np.concatenate([rows, np.full((3, 1), 0.5), 2 * scores.clip(0, 0.5)], axis=1)[None]}
    if layout is OutputLayout.yolox:
        table = np.zeros((1, 7 * 10 + 3 * 5 + 1 * 2, 8))
        table[0, 14] = [*(rows[0, :2] / 8 - (4, 1)), *np.log(rows[0, 2:] / 8), 0.8, 0.25, 0.75, 0.0]  # cell (4, 1)
        return {"output": table}
    if layout is OutputLayout.end_to_end:
        return {"output0": np.c_[boxes, [0.6, 0.9, 0.02], [1, 2, 1]][None]}
    unit = boxes / [80, 60, 80, 60]
    if layout is OutputLayout.ssd_unit:
        return {"boxes": unit[None], "scores": np.c_[[0.2, 0, 0.9], scores][None]}
    if layout is OutputLayout.ssd_tensorflow:
        return {
            "detection_boxes": unit[None][..., [1, 0, 3, 2]],
            "detection_scores": np.array([[0.6, 0.9, 0.02]]),
            "detection_classes": np.array([[2, 3, 2]]),
        }
    return {"boxes": boxes, "labels": np.array([2, 3, 2]), "scores": np.array([0.6, 0.9, 0.02])}


EXPECTED = {  # score, and probabilities of chair and cup
    OutputLayout.yolo: (0.6, [0.25, 0.75]),
    OutputLayout.yolo_objectness: (0.5, [2 / 7, 5 / 7]),
    OutputLayout.yolox: (0.6, [0.25, 0.75]),
    OutputLayout.ssd_unit: (0.6, [0.25, 0.75]),
    OutputLayout.ssd_tensorflow: (0.6, [0.25, 0.75]),  # 0.2 0.6 0.2 without the wall
    OutputLayout.ssd_torchvision: (0.6, [0.25, 0.75]),
    OutputLayout.end_to_end: (0.6, [0.25, 0.75]),
}


def tiny(folder, layout, **parameters):
    labels = folder / "labels.txt"
    labels.write_text("\n".join(LABELS))
    weights = constant_network(folder / "tiny.onnx", (1, 3, *SHAPE), outputs_of(layout))
    return OnnxBoxes(weights=weights, sha256="", label_space=str(labels), layout=layout, device="cpu", **parameters)


@pytest.mark.parametrize("layout", EXPECTED)
def test_onnx_boxes_known_network_detects_cup_in_each_layout(tmp_path, layout):
    detector = tiny(tmp_path, layout)
    assert detector.classes == ("cup", "chair")  # order of COCO
    found = detector.detect(frame())
    score, (chair, cup) = EXPECTED[layout]
    np.testing.assert_array_equal(found.masks, CUP[None])
    np.testing.assert_array_equal(found.boxes, tight_boxes(CUP[None]))
    np.testing.assert_allclose(found.scores, [score], rtol=1e-5)
    np.testing.assert_allclose(found.class_probabilities, [[cup, chair]], rtol=1e-5)


@pytest.mark.parametrize("placement", Placement)
def test_onnx_boxes_image_placement_is_inverted(tmp_path, placement):
    """The position of the image in the taller input depends on the placement."""
    top, scale = {Placement.top_left: (0, 0.5), Placement.center: (20, 0.5), Placement.stretch: (0, 5 / 6)}[placement]
    box = np.array([BOX[0], BOX[1] / 0.5 * scale + top, BOX[2], BOX[3] / 0.5 * scale + top])
    weights = constant_network(
        tmp_path / "n.onnx", (1, 3, 100, 80), {"y": np.r_[center_size(box), 0.5, 0.1][None, None]}
    )
    labels = tmp_path / "labels.txt"
    labels.write_text("cup\nchair")
    detector = OnnxBoxes(
        weights=weights,
        sha256="",
        label_space=str(labels),
        layout=OutputLayout.yolo,
        placement=placement,
        device="cpu",
        min_readings=1.0,
    )
    # at constant depth, the mask is the whole box
    flat = replace(frame(), depth=np.ones((120, 160), np.float32))
    (mask,) = detector.detect(flat).masks
    expected = np.zeros_like(mask)
    expected[28:72, 38:62] = True
    np.testing.assert_array_equal(mask, expected)


def test_onnx_boxes_without_depth_are_dropped_and_logged_once(tmp_path, caplog):
    caplog.set_level("WARNING")
    detector = tiny(tmp_path, OutputLayout.yolo)
    blind = replace(frame(7), depth=np.zeros((120, 160), np.float32))
    for dropped in (1, 2):
        assert len(detector.detect(blind)) == 0
        assert detector.boxes_without_depth == dropped
    assert len(detector.detect(frame())) == 1
    assert caplog.messages == [
        "frame 7: 1 of 1 boxes dropped because of too few depth readings for a mask; 1 dropped so far"
    ]


def test_onnx_boxes_nms_keeps_better_of_overlapping_boxes(tmp_path):
    boxes = np.stack([center_size(BOX), center_size(BOX) + 0.5])
    rows = np.concatenate([boxes, [[0.2, 0.6, 0.0], [0.5, 0.4, 0.0]]], axis=1)
    labels = tmp_path / "labels.txt"
    labels.write_text("\n".join(LABELS))
    weights = constant_network(tmp_path / "n.onnx", (1, 3, *SHAPE), {"y": rows[None]})
    parameters = {
        "weights": weights,
        "sha256": "",
        "label_space": str(labels),
        "layout": OutputLayout.yolo,
        "device": "cpu",
    }
    np.testing.assert_allclose(OnnxBoxes(**parameters).detect(frame()).scores, [0.6])
    np.testing.assert_allclose(OnnxBoxes(**parameters, agnostic_nms_iou=1.0).detect(frame()).scores, [0.6, 0.5])


def test_onnx_boxes_unsupported_network_shape_or_label_raises(tmp_path):
    weights = constant_network(tmp_path / "n.onnx", (1, 3, *SHAPE), {"y": np.zeros((1, 6, 9))})
    with pytest.raises(DataError, match="84 columns"):
        OnnxBoxes(weights=weights, sha256="", layout=OutputLayout.yolo, device="cpu")
    (tmp_path / "labels.txt").write_text("chair\nflibbertigibbet")
    labels = {"label_space": str(tmp_path / "labels.txt"), "class_names": ClassNames.COCO}
    with pytest.raises(ConfigError, match="flibbertigibbet"):
        OnnxBoxes(weights=weights, **labels, layout=OutputLayout.yolo, device="cpu")


@pytest.mark.parametrize(
    "parameters",
    [
        {"score_threshold": 0.0},
        {"score_threshold": float("nan")},
        {"nms_iou": 0.0},
        {"agnostic_nms_iou": 1.5},
        {"max_detections": 0},
        {"min_foreground_fraction": 1.1},
        {"max_slant": 90.0},
        {"min_readings": -0.1},
        {"padding": 256},
        {"white_level": 0.0},
        {"input_size": -1},
        {"sha256": "abc"},
        {"device": "tpu"},
    ],
)
def test_onnx_boxes_invalid_parameter_raises(parameters, tmp_path):
    (name,) = parameters
    with pytest.raises(ConfigError, match=f"detector.{name}: expected .*, got"):
        OnnxBoxes(weights=tmp_path / "absent.onnx", **parameters)


# YOLOX-nano


def shared_frame(shared, scene, index):
    folder = shared / "data" / scene
    color = cv2.imread(str(folder / "color" / f"{index:06d}.jpg"))
    if color is None:
        pytest.skip(f"frame {index} does not exist in {folder}")
    depth = cv2.imread(str(folder / "depth" / f"{index:06d}.png"), cv2.IMREAD_UNCHANGED)
    meters = np.where(depth == 65535, 0, depth / 1000).astype(np.float32)
    return Frame(index, 0.0, color[..., ::-1].copy(), meters, Camera(640, 480, 585.0, 585.0, 319.5, 239.5))


@pytest.fixture(scope="module")
def nano(shared):
    if not (shared / WEIGHTS).is_file():
        pytest.skip(f"{shared / WEIGHTS} does not exist")
    return OnnxBoxes(weights=shared / WEIGHTS, device="cpu")


@pytest.mark.parametrize(
    ("scene", "index", "expected"),
    [
        ("redkitchen", 0, {"dining table": 0.75, "chair": 0.65, "cup": 0.6}),
        ("redkitchen", 290, {"cup": 0.75, "chair": 0.65, "dining table": 0.65, "tv": 0.6}),
        ("mit76", 3, {"couch": 0.75, "chair": 0.45}),
    ],
)
def test_yolox_nano_detects_expected_objects(shared, nano, scene, index, expected):
    found = nano.detect(shared_frame(shared, scene, index))
    best = {}
    for score, row in zip(found.scores, found.class_probabilities, strict=True):
        best.setdefault(found.classes[row.argmax()], float(score))
    assert all(best.get(name, 0) > score for name, score in expected.items()), best


def test_yolox_nano_output_matches_opencv(shared, nano):
    image = cv2.resize(shared_frame(shared, "redkitchen", 0).color, nano._network.shape[::-1]).astype(np.float32)
    reference = cv2.dnn.readNetFromONNX(str(shared / WEIGHTS))
    reference.setInput(image.transpose(2, 0, 1)[None].copy())
    (found,) = nano._network._network(image).values()
    np.testing.assert_allclose(found, reference.forward(), atol=1e-3)


def test_onnx_boxes_config_defaults_fit_yolox_nano(shared, nano):
    detector = registered.built("detector", "onnx_boxes", "device=cpu", f"detector.weights={shared / WEIGHTS}")
    assert detector.classes == nano.classes == COCO
    found = detector.detect(shared_frame(shared, "redkitchen", 0))
    np.testing.assert_array_equal(found.scores, nano.detect(shared_frame(shared, "redkitchen", 0)).scores)


def test_onnx_boxes_missing_weights_parameter_error_has_url():
    with pytest.raises(ConfigError, match=r"got none; set detector\.weights=\.\.\.; yolox_nano\.onnx .* https://"):
        registered.built("detector", "onnx_boxes")
