"""Tests for text-prompted detection with fake networks."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from framework.data import Camera, Frame
from framework.detection.hub.prompted_models import BoxPromptedMasks, TextPromptedBoxes
from framework.errors import ConfigError, DataError
from plugins.detectors.open_vocabulary import SOMETHING_ELSE, OpenVocabulary, class_distributions
from tests.support import registered
from tests.support.networks.tiny_image_text import write_image_text
from tests.support.networks.tiny_open_vocabulary import SIDE, write_owlv2, write_sam

pytest.importorskip("transformers")
CPU = torch.device("cpu")
SHAPES = ((60, 80), (80, 60), (64, 64))  # (height, width), px: wide, tall and square


@pytest.fixture(scope="module")
def owlv2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_owlv2(tmp_path_factory.mktemp("owlv2"))


@pytest.fixture(scope="module", params=["sam", "sam2"])
def sam(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sam(tmp_path_factory.mktemp(request.param), request.param)


def picture(shape: tuple[int, int]) -> Frame:
    height, width = shape
    camera = Camera(width, height, 90.0, 90.0, (width - 1) / 2, (height - 1) / 2)
    color = np.random.default_rng(1).integers(0, 255, (*shape, 3)).astype(np.uint8)
    return Frame(0, 0.0, color, np.full(shape, 2, np.float32), camera)


class FixedBoxes:
    """Replacement for OWLv2 that returns given boxes, px, and probabilities of the queries."""

    dtype = torch.float32

    def __init__(self, shape: tuple[int, int], boxes: list[list[float]], probabilities: list[list[float]]) -> None:
        # fractions of the padded square, with the image in the upper left corner
        shares = (torch.tensor(boxes) + 0.5) / max(shape)
        centers = (shares[:, :2] + shares[:, 2:]) / 2
        self.boxes = torch.cat([centers, shares[:, 2:] - shares[:, :2]], dim=1)[None]
        self.logits = torch.logit(torch.tensor(probabilities))[None]

    def __call__(self, **given: Any) -> Any:
        assert given["pixel_values"].shape == (1, 3, SIDE, SIDE)
        return SimpleNamespace(pred_boxes=self.boxes, logits=self.logits)


class BoxFiller:
    """Replacement for SAM whose mask is the prompted box."""

    dtype = torch.float32

    def __call__(self, pixel_values: torch.Tensor, input_boxes: torch.Tensor, multimask_output: bool) -> Any:
        assert pixel_values.shape == (1, 3, SIDE, SIDE)
        assert not multimask_output
        cells = (torch.arange(SIDE) + 0.5)[None]
        x1, y1, x2, y2 = input_boxes[0].T[..., None]
        across, down = (x1 < cells) & (cells < x2), (y1 < cells) & (cells < y2)
        inside = down[:, :, None] & across[:, None, :]
        return SimpleNamespace(pred_masks=torch.where(inside, 9.0, -9.0)[None, :, None])


@pytest.mark.parametrize("shape", SHAPES)
def test_open_vocabulary_boxes_map_from_square_input_to_image(owlv2: Path, shape: tuple[int, int]) -> None:
    boxes = TextPromptedBoxes(str(owlv2), "main", ("red chair", "bed"), CPU, half_precision=False)
    wanted = [[4.5, 9.5, 24.5, 39.5], [30, 2, 55, 58]]
    boxes._network = FixedBoxes(shape, wanted, [[0.8, 0.1], [0.3, 0.6]])
    found, probabilities = boxes(picture(shape).color)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    np.testing.assert_allclose(probabilities, [[0.8, 0.1], [0.3, 0.6]], atol=1e-6)


def test_open_vocabulary_pads_image_with_gray_at_lower_right(owlv2: Path) -> None:
    boxes = TextPromptedBoxes(str(owlv2), "main", ("bed",), CPU, half_precision=False)
    seen: list[torch.Tensor] = []
    saying = FixedBoxes((32, 64), [[0, 0, 9, 9]], [[0.5]])

    def record(**given: Any) -> Any:
        seen.append(given["pixel_values"])
        return saying(**given)

    record.dtype = torch.float32
    boxes._network = record
    boxes(np.full((32, 64, 3), 255, np.uint8))
    assert (seen[0][0, :, :31] > 1.5).all(), "expected a white image"
    np.testing.assert_allclose(seen[0][0, 0, 33:], (128 / 255 - 0.48145466) / 0.26862954, atol=1e-5)


def test_open_vocabulary_boxes_agree_with_transformers(owlv2: Path) -> None:
    from transformers import AutoTokenizer, Owlv2ForObjectDetection

    color = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE, 3)).astype(np.uint8)
    found, probabilities = TextPromptedBoxes(str(owlv2), "main", ("red chair", "bed"), CPU, half_precision=False)(color)
    mean, std = np.array((0.48145466, 0.4578275, 0.40821073)), np.array((0.26862954, 0.26130258, 0.27577711))
    texts = ["a photo of a red chair", "a photo of a bed"]
    tokens = AutoTokenizer.from_pretrained(owlv2)(texts, padding="max_length", max_length=16, return_tensors="pt")
    with torch.inference_mode():
        output = Owlv2ForObjectDetection.from_pretrained(owlv2).eval()(
            pixel_values=torch.tensor((color / 255 - mean) / std).float().permute(2, 0, 1)[None],
            input_ids=tokens["input_ids"],
            attention_mask=tokens["attention_mask"],
        )
    np.testing.assert_allclose(probabilities, torch.sigmoid(output.logits[0]).numpy(), atol=1e-5)
    sizes = found[:, 2:] - found[:, :2]
    np.testing.assert_allclose(sizes, output.pred_boxes[0, :, 2:].numpy() * SIDE, atol=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_open_vocabulary_masks_lie_in_prompt_boxes(sam: Path, shape: tuple[int, int]) -> None:
    masks = BoxPromptedMasks(str(sam), "main", CPU, half_precision=False)
    frame = picture(shape)
    random = masks(frame.color, np.float32([[5, 5, 30, 30]]))
    assert random.shape == (1, *shape)
    masks._network = BoxFiller()
    found = masks(frame.color, np.float32([[9.5, 19.5, 29.5, 49.5], [-0.5, -0.5, 59.5, 9.5]]))
    expected = np.zeros((2, *shape), np.bool_)
    expected[0, 20:50, 10:30] = expected[1, :10, :60] = True
    overlap = (found & expected).sum(axis=(1, 2)) / (found | expected).sum(axis=(1, 2))
    assert (overlap > 0.9).all(), "expected equal masks except for rounding to the grid"
    for mask, wanted in zip(found, expected, strict=True):
        center, middle = (np.argwhere(area).mean(axis=0) for area in (mask, wanted))
        np.testing.assert_allclose(center, middle, atol=0.5)
    assert masks(frame.color, np.zeros((0, 4), np.float32)).shape == (0, *shape)


def test_open_vocabulary_distribution_uses_odds_and_other_class() -> None:
    rows = class_distributions(np.float32([[0.1, 0.1], [0.5, 0.1], [0.9, 0.001]]), 0.1)
    np.testing.assert_allclose(rows.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(rows[0], [1 / 3] * 3, atol=1e-6)
    np.testing.assert_allclose(rows[1], np.array([9, 1, 1]) / 11, atol=1e-6)
    assert rows[2, 0] > 0.98
    assert np.isfinite(class_distributions(np.float32([[0, 1]]), 0.1)).all()


@pytest.mark.parametrize("masks", ["sam", "depth"])
def test_open_vocabulary_detections_combine_boxes_and_masks(owlv2: Path, masks: str, tmp_path: Path) -> None:
    folder = str(write_sam(tmp_path / "sam", "sam2")) if masks == "sam" else ""
    detector = OpenVocabulary(["red chair", "bed"], str(owlv2), mask_model=folder, score_threshold=0.2, device="cpu")
    assert detector.classes == ("red chair", "bed", SOMETHING_ELSE)
    shape = (64, 64)
    boxes = [[4, 4, 28, 28], [5, 4, 28, 28], [35, 35, 60, 60], [0, 0, 63, 63]]
    detector._boxes._network = FixedBoxes(shape, boxes, [[0.8, 0.1], [0.7, 0.3], [0.1, 0.6], [0.1, 0.1]])
    if detector._masks is not None:
        detector._masks._network = BoxFiller()
    found = detector.detect(picture(shape))
    np.testing.assert_allclose(found.scores, [0.8, 0.6], atol=1e-6)
    assert found.class_probabilities.argmax(axis=1).tolist() == [0, 1]
    assert found.masks[0, 16, 16]
    assert found.masks[1, 47, 47]
    assert not found.masks[0, 47, 47]


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        ("[]", r"detector\.text_queries: expected 1 to 500 different text queries"),
        ("[chair,chair]", "1 to .* different text queries, none of them"),
        ("[chair,' ']", "1 to .* different text queries, none of them"),
        ("['something else']", "1 to .* different text queries, none of them"),
        ("3", "text_queries"),
    ],
)
def test_open_vocabulary_empty_or_duplicate_text_queries_raise(words: str, fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        registered.built("detector", "open_vocabulary", f"detector.text_queries={words}")


def test_open_vocabulary_unsupported_model_type_raises(owlv2: Path, tmp_path: Path) -> None:
    siglip = str(write_image_text(tmp_path / "siglip"))
    with pytest.raises(ConfigError, match=r"detector\.model: expected OWLv2, got .* \(siglip\)"):
        OpenVocabulary(model=siglip, mask_model="", device="cpu")
    with pytest.raises(ConfigError, match=r"detector\.mask_model: expected SAM, SAM 2 or EdgeTAM, got .* \(siglip\)"):
        OpenVocabulary(model=str(owlv2), mask_model=siglip, device="cpu")
    (owlv2 / "config.json").rename(owlv2 / "away.json")
    try:
        with pytest.raises(DataError, match=r"expected config\.json in"):
            OpenVocabulary(model=str(owlv2), mask_model="", device="cpu")
    finally:
        (owlv2 / "away.json").rename(owlv2 / "config.json")


def test_open_vocabulary_tokenizer_loads_from_vocab_and_merges(tmp_path: Path) -> None:
    """google/owlv2-base-patch16-ensemble has no tokenizer.json."""
    (write_owlv2(tmp_path) / "tokenizer.json").unlink()
    letters = sorted(set("aphotofcuprbe"))
    words = ["!", *letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    end = words.index("<|endoftext|>")
    (tmp_path / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(words)}))
    (tmp_path / "merges.txt").write_text("#version: 0.2\n")
    special = {"bos_token": "<|startoftext|>", "eos_token": words[end], "unk_token": words[end], "pad_token": "!"}
    (tmp_path / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer", **special}))
    tokens = TextPromptedBoxes(str(tmp_path), "main", ["cup"], CPU, half_precision=False)._tokens["input_ids"][0]
    letters_of = [words[k] for k in tokens if k not in (0, end - 1, end)]
    assert "".join(letters_of).split("</w>") == ["a", "photo", "of", "a", "cup", ""]
