"""Tests for YOLO segmentation networks with known boxes, scores and masks."""

import cv2
import numpy as np
import onnx
import pytest

from framework.data import Camera, Frame
from framework.detection.masks.binary_masks import tight_boxes
from framework.errors import ConfigError, DataError
from framework.testing.contracts import DetectorContract
from plugins.detectors.onnx_segmentation import OnnxSegmentation
from tests.support.networks.tiny_networks import constant_network
from tests.support.recordings.rewritten_exports import LAYOUTS, rewritten

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
V, U = np.indices((120, 160))
LABELS = ("chair", "cup", "wall")
SIZE = 80  # px, side of the input; the image is scaled by 1/2 and placed 10 px from the top
CELL = 2  # px in the input


def frame():
    return Frame(0, 0.0, np.full((120, 160, 3), 90, np.uint8), np.ones((120, 160), np.float32), CAMERA)


def outputs(objectness=False, transposed=False):
    """Return the network outputs for a cup in the left half of its box and a chair in the lower half of its box.

    The prototypes are linear in the pixel coordinates.
    """
    cells = SIZE // CELL
    prototypes = np.stack(
        [np.tile(np.arange(cells) - 10.4, (cells, 1)), np.tile(np.arange(cells) - 25.4, (cells, 1)).T]
    )
    boxes = [[20, 30, 30, 20], [60, 50, 20, 20], [40, 40, 9, 9], [60, 50, 19, 20]]  # center and size
    scores = [[0.1, 0.6, 0.1], [0.4, 0.05, 0.05], [0.0, 0.2, 0.9], [0.3, 0.0, 0.0]]
    coefficients = [[-1, 0], [0, 1], [1, 1], [0, 1]]
    certain = np.ones((4, 1 if objectness else 0))
    rows = np.concatenate([boxes, certain, scores, coefficients], axis=1)
    return {"output0": rows[None] if transposed else rows.T[None], "output1": prototypes[None]}


def tiny(folder, objectness=False, transposed=False, **parameters):
    labels = folder / "labels.txt"
    labels.write_text("\n".join(LABELS))
    weights = constant_network(folder / "tiny.onnx", (1, 3, SIZE, SIZE), outputs(objectness, transposed))
    return OnnxSegmentation(weights=weights, label_space=str(labels), objectness=objectness, device="cpu", **parameters)


@pytest.fixture
def detector(tmp_path):
    return tiny(tmp_path)


class TestContract(DetectorContract):
    @pytest.fixture(autouse=True)
    def network(self, detector):
        self.plugin = lambda: detector


@pytest.mark.parametrize(("objectness", "transposed"), [(False, False), (True, True)])
def test_onnx_segmentation_known_network_matches_expected_output(tmp_path, objectness, transposed):
    check_cup_and_chair(tiny(tmp_path, objectness, transposed).detect(frame()))


def check_cup_and_chair(found):
    # the center of image pixel u is at (u + 0.5) / 2 px in the input and at (u + 0.5) / 4 - 0.5 in cells
    cup = ((U + 0.5) / 4 - 0.5 < 10.4) & (U >= 10) & (U < 70) & (V >= 20) & (V < 60)
    chair = (((V + 0.5) / 2 + 10) / 2 - 0.5 > 25.4) & (U >= 100) & (U < 140) & (V >= 60) & (V < 100)
    np.testing.assert_array_equal(found.masks, [cup, chair])
    np.testing.assert_array_equal(found.boxes, tight_boxes(np.stack([cup, chair])))
    np.testing.assert_allclose(found.scores, [0.6, 0.4], rtol=1e-5)
    assert found.classes == ("cup", "chair")
    np.testing.assert_allclose(found.class_probabilities, [[6 / 7, 1 / 7], [1 / 9, 8 / 9]], rtol=1e-5)


def test_onnx_segmentation_channels_last_export_is_decoded(tmp_path):
    table, prototypes = outputs().values()
    table[:, :4] /= SIZE
    (tmp_path / "labels.txt").write_text("\n".join(LABELS))
    weights = constant_network(
        tmp_path / "n.onnx", (1, SIZE, SIZE, 3), {"a": np.moveaxis(prototypes, 1, -1), "b": table}
    )
    detector = OnnxSegmentation(weights=weights, label_space=str(tmp_path / "labels.txt"), device="cpu")
    check_cup_and_chair(detector.detect(frame()))


def test_onnx_segmentation_tflite_file_error_names_converter(tmp_path):
    with pytest.raises(ConfigError, match=r"weights: expected an ONNX file \(converted with tf2onnx.*n\.tflite"):
        OnnxSegmentation(weights=tmp_path / "n.tflite", device="cpu")


def suppressed(folder, **parameters):
    """Return a detector with the same candidates, in the layout of networks that suppress duplicates."""
    table, prototypes = outputs(transposed=True).values()
    (folder / "labels.txt").write_text("\n".join(LABELS))
    center, size, scores = table[0, :, :2], table[0, :, 2:4], table[0, :, 4:7]
    label, best = scores.argmax(axis=1)[:, None], scores.max(axis=1)[:, None]
    rows = np.concatenate([center - size / 2, center + size / 2, best, label, table[0, :, 7:]], axis=1)
    weights = constant_network(folder / "n.onnx", (1, 3, SIZE, SIZE), {"a": rows[None], "b": prototypes})
    return OnnxSegmentation(weights=weights, label_space=str(folder / "labels.txt"), device="cpu", **parameters)


@pytest.mark.parametrize(("spread", "expected"), [(1.0, [0.6, 0.5]), (0.5, [0.8, 0.7]), (0.0, [1.0, 1.0])])
def test_onnx_segmentation_single_class_spreads_remaining_mass(tmp_path, spread, expected, caplog):
    """The probability is at least 0.5 with spread 1, so that the label remains the best of two classes."""
    with caplog.at_level("INFO"):
        found = suppressed(tmp_path, class_spread=spread).detect(frame())
    assert "n.onnx reports one class per detection" in caplog.text
    whole = tiny(tmp_path).detect(frame())
    np.testing.assert_array_equal(found.masks, whole.masks)
    np.testing.assert_allclose(found.scores, whole.scores)
    own = found.class_probabilities[[0, 1], [0, 1]]
    np.testing.assert_allclose(own, expected, rtol=1e-6)
    np.testing.assert_allclose(found.class_probabilities.sum(axis=1), 1)


def test_onnx_segmentation_different_class_names_are_logged(tmp_path, caplog):
    tiny(tmp_path)
    assert not caplog.text
    model = onnx.load(tmp_path / "tiny.onnx")
    onnx.helper.set_model_props(model, {"names": "{0: 'chair', 1: 'fork', 2: 'wall'}"})
    onnx.save(model, tmp_path / "named.onnx")
    OnnxSegmentation(weights=tmp_path / "named.onnx", label_space=str(tmp_path / "labels.txt"), device="cpu")
    assert "named.onnx: 1 of its 3 classes differ from detector.label_space=" in caplog.text
    assert "1 is 'fork', expected 'cup'" in caplog.text


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"output1": np.zeros((1, 3, 40, 40))},
            r"detector\.label_space: expected 10 columns for box, classes and .* coefficients",
        ),
        (
            {"output1": np.zeros((1, 40, 40))},
            r"expected two outputs, a table \(1, 4 \+ classes \+ M, K\), or .*, got output0",
        ),
        ({"more": np.zeros((1, 2))}, r"got output0 \(1, 9, 4\), output1 \(1, 2, 40, 40\), more \(1, 2\)"),
    ],
)
def test_onnx_segmentation_unsupported_network_shape_raises(tmp_path, changed, message):
    (tmp_path / "labels.txt").write_text("\n".join(LABELS))
    weights = constant_network(tmp_path / "n.onnx", (1, 3, SIZE, SIZE), {**outputs(), **changed})
    with pytest.raises(DataError, match=message):
        OnnxSegmentation(weights=weights, label_space=str(tmp_path / "labels.txt"), device="cpu")


@pytest.mark.parametrize(
    "parameters",
    [
        {"class_spread": 1.1},
        {"score_threshold": 0.0},
        {"nms_iou": 1.1},
        {"agnostic_nms_iou": 0.0},
        {"max_detections": 0},
        {"mask_threshold": 1.0},
        {"padding": -1},
        {"white_level": float("inf")},
        {"device": "tpu"},
    ],
)
def test_onnx_segmentation_invalid_parameter_raises(tmp_path, parameters):
    (name,) = parameters
    with pytest.raises(ConfigError, match=f"detector.{name}: expected .*, got"):
        OnnxSegmentation(**{"weights": tmp_path / "absent.onnx", **parameters})


IMAGES = ("mit76/color/000000.jpg", "redkitchen/color/000240.jpg", "replica_floor2/color/000048.jpg")


@pytest.fixture(scope="module")
def yolo(shared):
    """Return the path of YOLO11n-seg in the original layout."""
    path = shared / "weights" / "yolo11n_seg" / "yolo11n_seg.onnx"
    if not path.is_file():
        pytest.skip(f"{path} does not exist")
    return path


@pytest.fixture(scope="module")
def photographs(shared_data):
    """Return frames of three real videos."""
    colors = [cv2.cvtColor(cv2.imread(str(shared_data / name)), cv2.COLOR_BGR2RGB) for name in IMAGES]
    cameras = [Camera(c.shape[1], c.shape[0], 500.0, 500.0, 0.0, 0.0) for c in colors]
    return [Frame(k, 0.0, c, np.ones(c.shape[:2], np.float32), cameras[k]) for k, c in enumerate(colors)]


@pytest.fixture(scope="module")
def expected(yolo, photographs):
    return [OnnxSegmentation(weights=yolo, device="cpu").detect(frame) for frame in photographs]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_onnx_segmentation_yolo_agrees_in_all_layouts(tmp_path, yolo, photographs, expected, layout):
    detector = OnnxSegmentation(weights=rewritten(yolo, layout, tmp_path / "n.onnx"), device="cpu")
    assert detector._layout.suppressed == ("suppressed" in layout or "best rows" in layout)
    for photograph, wanted in zip(photographs, expected, strict=True):
        found = detector.detect(photograph)
        assert len(found) == len(wanted) > 2
        np.testing.assert_allclose(found.scores, wanted.scores, atol=1e-5)
        np.testing.assert_array_equal(
            found.class_probabilities.argmax(axis=1), wanted.class_probabilities.argmax(axis=1)
        )
        both = (found.masks & wanted.masks).sum(axis=(1, 2)) / (found.masks | wanted.masks).sum(axis=(1, 2))
        assert both.min() > 0.995
        # the score is the probability of the label; the other classes have equal probabilities
        if detector._layout.suppressed:
            best = np.maximum(found.scores, 1 / len(found.classes))
            np.testing.assert_allclose(found.class_probabilities.max(axis=1), best, rtol=1e-5)
            np.testing.assert_allclose(found.class_probabilities.min(axis=1), (1 - best) / 79, atol=1e-6)
        else:
            np.testing.assert_allclose(found.class_probabilities, wanted.class_probabilities, atol=1e-4)
