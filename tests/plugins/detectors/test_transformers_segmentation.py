"""Tests for the transformers detector, with a random tiny network of each family and reference decoders."""

import json
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn import functional

from framework.data import Camera, Frame
from framework.errors import ConfigError, DataError

# the contract tests of registered detectors, which run on the networks below
from framework.testing.contracts import DetectorContract
from framework.vocabulary.label_spaces import COCO, COCO_BY_ID
from plugins.detectors.transformers_segmentation import (
    FAMILIES,
    Checkpoint,
    Preprocessing,
    TransformersSegmentation,
    class_distributions,
    resample_masks,
)
from tests.support.networks.tiny_transformers import FIXED, LABELS, MODELS, write_network

transformers = pytest.importorskip("transformers")

CLASSES = ("chair", "couch", "tv")
MEANING = {0: 0, 2: 1, 3: 0, 4: 2}  # index in CLASSES of each label
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    return {kind: write_network(tmp_path_factory.mktemp(kind), kind) for kind in MODELS}


def built(folder, **parameters):
    return TransformersSegmentation(**{"model": str(folder), "device": "cpu", **parameters})


@pytest.fixture(params=MODELS)
def detector(request, folders):
    return built(folders[request.param], score_threshold=0.02, agnostic_nms_iou=0.9)


class TestContract(DetectorContract):
    @pytest.fixture(autouse=True)
    def network(self, detector):
        self.plugin = lambda: detector


def frame(seed=0, camera=CAMERA):
    color = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    color = np.kron(color, np.ones((camera.height // 6, camera.width // 8, 1), np.uint8))
    return Frame(seed, 0.0, color, np.ones(camera.shape, np.float32), camera)


def test_transformers_all_model_families_are_covered():
    assert set(MODELS) == set(FAMILIES)


def test_transformers_tiny_networks_return_detections(detector):
    found = [detector.detect(frame(seed)) for seed in range(3)]
    assert sum(map(len, found)) >= 3, "expected detections, which the other tests need"
    assert detector.classes == CLASSES
    assert not np.array_equal(found[0].masks, found[1].masks)


def slow_decoding(detector, kind, image, threshold):
    """Return the score, mask and class distribution of each query before suppression, the best one first."""
    pixels, (down, right) = detector._preprocessing(image.color, torch.device("cpu"))
    output = detector._network(pixel_values=pixels)
    instance = "masks_queries_logits" not in output
    logits = output["logits" if instance else "class_queries_logits"][0].double()
    grids = output["pred_masks" if instance else "masks_queries_logits"]
    height, width = pixels.shape[2:]
    whole = functional.interpolate(grids, (height, width), mode="bilinear")[..., : round(down * height), :]
    whole = functional.interpolate(whole[..., : round(right * width)], image.camera.shape, mode="bilinear")[0]
    rows = []
    for row, mask in zip(logits, whole, strict=True):
        if kind == "rf_detr":
            labels = torch.sigmoid(row)
            only = [labels[k] * math.prod(1 - p for j, p in enumerate(labels) if j != k) for k in range(len(LABELS))]
            only = torch.tensor(only)
        else:
            labels = only = torch.softmax(row, dim=0)[:-1]
        sums = [float(sum(only[k] for k, c in MEANING.items() if c == wanted)) for wanted in range(len(CLASSES))]
        score = float(labels.max())
        inside = mask > 0
        if kind not in ("detr", "rf_detr"):
            score *= float(torch.sigmoid(mask)[inside].mean()) if inside.any() else 0.0
        if int(labels.argmax()) in MEANING and score > threshold and inside.any():
            rows.append((score, inside.numpy(), np.array(sums) / sum(sums)))
    return sorted(rows, key=lambda row: -row[0])


@pytest.mark.parametrize("kind", ["mask2former", "maskformer", "detr", "rf_detr"])
def test_transformers_decoding_matches_reference(folders, kind):
    if kind == "rf_detr" or kind == "detr":
        camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    else:
        camera = Camera(96, 96, 60.0, 60.0, 47.5, 47.5)
    image = frame(1, camera)
    sides = {} if kind == "rf_detr" else {"short_side": min(camera.shape), "long_side": max(camera.shape)}
    detector = built(folders[kind], score_threshold=0.05, agnostic_nms_iou=1.0, **sides)
    with torch.inference_mode():
        expected = slow_decoding(detector, kind, image, 0.05)
    found = detector.detect(image)
    assert len(expected) > 1
    np.testing.assert_allclose(found.scores, [score for score, _, _ in expected], rtol=1e-4)
    np.testing.assert_allclose(found.class_probabilities, [row for _, _, row in expected], atol=1e-5)
    if kind != "rf_detr":  # the reference decodes at the size of the network, which differs for rf_detr
        assert np.mean(found.masks == np.array([mask for _, mask, _ in expected])) > 0.999


def test_transformers_decoding_agrees_with_mask2former(folders):
    """The masks and scores of the best label of each query are compared."""
    from transformers import Mask2FormerImageProcessorPil

    camera = Camera(384, 384, 300.0, 300.0, 191.5, 191.5)  # the size at which Mask2Former decodes
    image = frame(2, camera)
    folder = folders["mask2former"]
    detector = built(folder, score_threshold=0.05, agnostic_nms_iou=1.0, short_side=384, long_side=384)
    processor = Mask2FormerImageProcessorPil(size={"height": 384, "width": 384})
    with torch.inference_mode():
        inputs = processor(images=image.color, return_tensors="pt")
        output = detector._network(pixel_values=inputs["pixel_values"])
        [own] = processor.post_process_instance_segmentation(
            output, threshold=0.05, target_sizes=[(384, 384)], return_binary_maps=True
        )
    theirs = {
        round(segment["score"], 3): (segment["label_id"], mask.numpy() > 0)
        for segment, mask in zip(own["segments_info"], own["segmentation"], strict=True)
    }
    found = detector.detect(image)
    assert len(found) > 1
    for k, score in enumerate(found.scores):
        near = min(theirs, key=lambda value: abs(value - float(score)))
        label, mask = theirs[near]
        assert near == pytest.approx(float(score), abs=2e-3)
        assert MEANING[label] in found.class_probabilities[k].argsort()[-2:]
        assert np.mean(mask == found.masks[k]) > 0.99


def test_transformers_decoding_matches_eomt_processor(folders):
    from transformers import EomtImageProcessorPil

    image = frame(3, CAMERA)  # 48 rows are padded at the bottom to 64 rows
    detector = built(folders["eomt"], score_threshold=0.03, agnostic_nms_iou=1.0)
    processor = EomtImageProcessorPil(size={"shortest_edge": 64, "longest_edge": 64}, do_pad=True)
    with torch.inference_mode():
        inputs = processor(images=image.color, return_tensors="pt")
        pixels, covered = detector._preprocessing(image.color, torch.device("cpu"))
        np.testing.assert_allclose(pixels.numpy(), inputs["pixel_values"].numpy(), atol=1e-5)
        assert covered == (0.75, 1.0)
        output = detector._network(pixel_values=pixels)
        [own] = processor.post_process_instance_segmentation(output, target_sizes=[CAMERA.shape], threshold=0.03)
    theirs = sorted(s["score"] for s in own["segments_info"] if s["label_id"] in MEANING)
    found = detector.detect(image)
    assert len(theirs) > 1
    np.testing.assert_allclose(found.scores[::-1], theirs, atol=1e-4)


@pytest.mark.parametrize("shape", [(480, 640), (640, 480), (100, 100), (120, 500), (97, 131)])
@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("Mask2FormerImageProcessorPil", {"size": {"shortest_edge": 80, "longest_edge": 133}, "size_divisor": 32}),
        ("MaskFormerImageProcessorPil", {"size": {"shortest_edge": 51, "longest_edge": 200}, "size_divisor": 0}),
        ("DetrImageProcessorPil", {"size": {"shortest_edge": 80, "longest_edge": 133}}),
        ("DetrImageProcessorPil", {"size": {"max_height": 90, "max_width": 90}, "resample": 3}),
        (
            "DetrImageProcessorPil",
            {"size": {"height": 72, "width": 60}, "image_mean": [0.5] * 3, "image_std": [0.2] * 3},
        ),
        ("EomtImageProcessorPil", {"size": {"shortest_edge": 64, "longest_edge": 64}, "do_pad": True}),
    ],
)
def test_transformers_preprocessing_agrees_with_library(name, numbers, shape):
    # bicubic resampling of these values stays within 0 to 255
    color = np.random.default_rng(0).integers(64, 192, (*shape, 3), np.uint8)
    processor = getattr(transformers, name)(**numbers)
    expected = processor(images=color, return_tensors="pt")["pixel_values"][0].numpy()
    content = {"image_processor_type": name, **numbers}
    pixels, _ = Preprocessing.parse(content, "here")(color, torch.device("cpu"))
    assert pixels.shape[1:] == expected.shape
    # the library rounds to 8 bits after resizing
    np.testing.assert_allclose(pixels[0].numpy(), expected, atol=2 / 255 / 0.2)
    assert np.abs(pixels[0].numpy() - expected).mean() < 0.6 / 255 / 0.2


def test_transformers_softmax_head_excludes_no_object_class():
    logits = np.log(np.array([[0.2, 0.1, 0.7], [0.6, 0.3, 0.1]], np.float32))
    rows, best = class_distributions(logits, 2)
    np.testing.assert_allclose(rows, [[2 / 3, 1 / 3], [2 / 3, 1 / 3]], rtol=1e-6)
    np.testing.assert_allclose(best, [0.2, 0.6], rtol=1e-6)


def test_transformers_sigmoid_head_is_conditioned_on_one_class():
    p = np.array([0.9, 0.5, 0.01])
    one = [0.9 * 0.5 * 0.99, 0.1 * 0.5 * 0.99, 0.1 * 0.5 * 0.01]
    rows, best = class_distributions(np.log(p / (1 - p))[None].astype(np.float32), 3)
    np.testing.assert_allclose(rows[0], np.array(one) / sum(one), rtol=1e-5)
    np.testing.assert_allclose(best, [0.9], rtol=1e-6)


def test_transformers_extreme_logits_stay_finite():
    logits = np.array([[1e4, -1e4, 0.0], [-1e4, -1e4, 1e4]], np.float32)
    for labels in (2, 3):
        rows, best = class_distributions(logits, labels)
        np.testing.assert_allclose(rows.sum(axis=1), 1, rtol=1e-6)
        assert ((best >= 0) & (best <= 1)).all()


def test_transformers_logit_count_different_from_labels_raises():
    with pytest.raises(DataError, match=r"expected 5 or 6 class logits .*, got 7"):
        class_distributions(np.zeros((1, 7), np.float32), 5)


@pytest.mark.parametrize("shape", [(24, 40), (7, 5), (6, 10)])
def test_transformers_mask_resampling_is_bilinear(shape):
    grids = torch.randn(3, 6, 10, generator=torch.Generator().manual_seed(0))
    expected = functional.interpolate(grids[None], shape, mode="bilinear", align_corners=False)[0]
    np.testing.assert_allclose(resample_masks(grids, (1.0, 1.0), shape), expected, atol=1e-5)


def test_transformers_mask_resampling_excludes_padding():
    grids = torch.zeros(1, 8, 8)
    grids[:, 4:] = 1  # below the image
    assert resample_masks(grids, (0.5, 1.0), (16, 32))[0, :14].abs().max() < 1e-6
    assert resample_masks(grids, (1.0, 1.0), (16, 32))[0, 10:].min() == 1


def test_transformers_duplicate_and_weak_detections_are_removed(folders):
    image = frame(1)
    everything = built(folders["mask2former"], score_threshold=0.0, agnostic_nms_iou=1.0).detect(image)
    fewer = built(folders["mask2former"], score_threshold=0.0, agnostic_nms_iou=0.2).detect(image)
    assert 0 < len(fewer) < len(everything)
    least = float(np.median(everything.scores))
    strong = built(folders["mask2former"], score_threshold=least, agnostic_nms_iou=1.0).detect(image)
    np.testing.assert_array_equal(strong.scores, everything.scores[everything.scores > np.float32(least)])
    assert len(built(folders["mask2former"], score_threshold=0.0, max_detections=2).detect(image)) <= 2


def test_transformers_non_finite_output_raises(folders):
    detector = built(folders["mask2former"])
    broken = {"class_queries_logits": torch.full((1, 2, 7), math.nan), "masks_queries_logits": torch.zeros(1, 2, 4, 4)}
    detector._network = lambda pixel_values: broken
    with pytest.raises(DataError, match="expected finite outputs"):
        detector.detect(frame())


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"score_threshold": 1.0}, "score_threshold"),
        ({"agnostic_nms_iou": 0.0}, "agnostic_nms_iou"),
        ({"max_detections": 0}, "max_detections"),
        ({"mask_threshold": 1.0}, "mask_threshold"),
        ({"short_side": 31}, "short_side"),
        ({"short_side": 64}, "long_side: expected a value in \\[64"),
        ({"long_side": 64}, "long_side: expected 0"),
        ({"device": "tpu"}, "device"),
    ],
)
def test_transformers_invalid_parameter_raises(parameters, message):
    with pytest.raises(ConfigError, match=message):
        built("nowhere", **parameters)


def one_line(caught):
    return "\n" not in str(caught.value)


@pytest.mark.parametrize("variable", ["HF_HUB_OFFLINE", "INSTANCEMAP_OFFLINE"])
def test_transformers_missing_model_offline_error_has_fix(monkeypatch, variable):
    monkeypatch.delenv("INSTANCEMAP_OFFLINE", raising=False)
    monkeypatch.setenv(variable, "1")
    with pytest.raises(
        DataError,
        match=rf"while {variable} disables downloads, got someone/missing; unset {variable} or set a folder",
    ) as caught:
        built("someone/missing")
    assert one_line(caught)


def coco_rf_detr(folder, names):
    """Return a tiny RF-DETR-Seg with a COCO head. The config contains the class names `names`."""
    write_network(folder, "rf_detr", names)
    return built(folder, score_threshold=0.02, agnostic_nms_iou=1.0)


IN_A_ROW = {**dict(enumerate(COCO)), **dict.fromkeys(range(80, 91), "N/A")}


@pytest.mark.parametrize("names", [dict(enumerate(COCO_BY_ID)), {k: f"LABEL_{k}" for k in range(91)}, IN_A_ROW])
def test_transformers_rf_detr_uses_coco_91_ids(tmp_path, names):
    """For example, class 17 is cat and class 75 is remote."""
    detector = coco_rf_detr(tmp_path, names)
    assert detector.classes == COCO
    labels = Checkpoint(str(tmp_path), "main").labels
    by_id = {1: "person", 11: "fire hydrant", 13: "stop sign", 17: "cat", 44: "bottle", 46: "wine glass", 70: "toilet",
             67: "dining table", 72: "tv", 75: "remote", 82: "refrigerator", 84: "book", 90: "toothbrush"}  # fmt: skip
    assert {k: labels[k] for k in by_id} == by_id
    assert {labels[k] for k in (0, 12, 45, 66, 68, 83)} == {"n/a"}
    image = frame(1)
    pixels, _ = detector._preprocessing(image.color, torch.device("cpu"))
    with torch.inference_mode():
        output = detector._network(pixel_values=pixels)
    probabilities, masks = output.logits.sigmoid()[0], output.pred_masks
    whole = functional.interpolate(masks, image.camera.shape, mode="bilinear", align_corners=False)[0] > 0
    expected = [
        (float(row.max()), labels[int(row.argmax())], mask.numpy())
        for row, mask in zip(probabilities, whole, strict=True)
        if labels[int(row.argmax())] != "n/a" and row.max() > 0.02 and mask.any()
    ]
    expected.sort(key=lambda one: -one[0])
    found = detector.detect(image)
    assert len(found) == len(expected) > 2
    np.testing.assert_allclose(found.scores, [score for score, _, _ in expected], rtol=1e-4)
    assert [COCO[k] for k in found.class_probabilities.argmax(axis=1)] == [name for _, name, _ in expected]
    assert np.mean(found.masks == np.array([mask for _, _, mask in expected])) > 0.999


def test_transformers_rf_detr_with_other_classes_keeps_them(tmp_path):
    names = {k: "chair" if k % 2 else "tv" for k in range(91)}
    assert coco_rf_detr(tmp_path, names).classes == ("chair", "tv")


def test_transformers_resize_of_fixed_size_model_raises(folders):
    with pytest.raises(ConfigError, match=r"0 \(this model has a fixed input size\)"):
        built(folders["eomt"], short_side=64, long_side=64)


def test_transformers_missing_package_error_names_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ConfigError, match=r"pip install 'instancemap\[transformers\]'"):
        built("nowhere")


@pytest.fixture
def copy(folders, tmp_path):
    """Return a copy of the mask2former folder and a function that changes its JSON files."""
    for file in folders["mask2former"].iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())

    def change(name, **values):
        path = tmp_path / name
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return SimpleNamespace(folder=tmp_path, change=change)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        (
            "config.json",
            {"id2label": {str(k): f"LABEL_{k}" for k in range(6)}},
            r"detector\.model: .*: expected class names, got none",
        ),
        ("config.json", {"id2label": {"0": "chair", "1": "bed"}}, "expected the weights in"),
        ("config.json", {"num_queries": 13}, "expected the weights in"),
        ("config.json", {"model_type": "unknown type"}, "unknown type"),
        (
            "preprocessor_config.json",
            {"size": {"height": 3}},
            "size: expected height and width, max_height and max_width, or shortest_edge and longest_edge",
        ),
        (
            "preprocessor_config.json",
            {"size": None},
            "size: expected height and width, max_height and max_width, or shortest_edge and longest_edge",
        ),
        ("preprocessor_config.json", {"pad_size": FIXED}, "pad_size"),
        ("preprocessor_config.json", {"resample": 1}, "resample"),
        ("preprocessor_config.json", {"do_split_image": True}, "semantic"),
    ],
)
def test_transformers_unusable_model_folder_raises_with_reason(copy, name, values, message):
    copy.change(name, **values)
    with pytest.raises((ConfigError, DataError), match=message) as caught:
        built(copy.folder)
    assert one_line(caught)


def test_transformers_own_labels_are_class_names(copy):
    copy.change("config.json", id2label={str(k): f"thing {k}" for k in range(6)})
    assert built(copy.folder).classes == tuple(f"thing {k}" for k in range(6))


def test_transformers_unknown_architecture_raises(tmp_path):
    transformers.SegformerConfig().save_pretrained(tmp_path)
    with pytest.raises(ConfigError, match=r"one of mask2former, .*, got .* \(segformer\)"):
        built(tmp_path)


def test_transformers_incomplete_weights_raise(copy):
    from safetensors.torch import load_file, save_file

    path = copy.folder / "model.safetensors"
    tensors = load_file(path)
    del tensors["class_predictor.weight"]
    save_file(tensors, path, {"format": "pt"})
    with pytest.raises(
        DataError,
        match=r"got no weights for 1 of .* \(.*class_predictor\.weight",
    ):
        built(copy.folder)


@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "model.safetensors"])
def test_transformers_unusable_file_raises_one_line_error(copy, name):
    whole = (copy.folder / name).read_bytes()
    (copy.folder / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"detector\.model") as damaged:
        built(copy.folder)
    (copy.folder / name).unlink()
    with pytest.raises(DataError, match=r"detector\.model") as missing:
        built(copy.folder)
    assert one_line(damaged)
    assert one_line(missing)
