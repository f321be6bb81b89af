"""Tests for detections with embeddings. The models are random CLIP and SigLIP models."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from framework.data import Camera, Detections, Frame
from framework.detection.hub.image_text import GRAY, ImageTextModel, square_crops
from framework.detection.stored.cache import identity_of
from framework.errors import ConfigError, DataError
from framework.interfaces import Detector
from plugins.detectors.with_embeddings import WithEmbeddings
from tests.support import registered
from tests.support.networks.tiny_image_text import SIDE, write_image_text
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

transformers = pytest.importorskip("transformers")
KINDS = ("siglip", "clip")


@pytest.fixture(scope="module", params=KINDS)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_image_text(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope="module")
def siglip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_image_text(tmp_path_factory.mktemp("siglip"))


class Blocks(Detector):
    """Detector of three squares with sides of 40, 30 and 10 px."""

    classes = ("chair", "bed")

    def detect(self, frame: Frame) -> Detections:
        masks = np.zeros((3, *frame.camera.shape), np.bool_)
        masks[0, 10:50, 0:40], masks[1, 20:50, 60:90], masks[2, 0:10, 0:10] = True, True, True
        return Detections(
            masks, np.float32([[0, 10, 40, 50], [60, 20, 90, 50], [0, 0, 10, 10]]), np.float32([0.9, 0.2, 0.9]),
            np.full((3, 2), 0.5, np.float32), self.classes,
        )  # fmt: skip


def picture(index: int = 0) -> Frame:
    camera = Camera(96, 64, 90.0, 90.0, 47.5, 31.5)
    color = np.random.default_rng(1).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    return Frame(index, 0.0, color, np.ones((64, 96), np.float32), camera)


def test_with_embeddings_vectors_agree_with_transformers(folder: Path) -> None:
    from transformers import AutoModel, AutoTokenizer

    model = ImageTextModel(str(folder), "main", "cpu", half_precision=False)
    crops = np.random.default_rng(0).integers(0, 255, (3, SIDE, SIDE, 3)).astype(np.uint8)
    network = AutoModel.from_pretrained(folder).eval()
    is_clip = network.config.model_type == "clip"
    mean, std = ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)) if is_clip else (0.5, 0.5)
    pixels = torch.tensor((crops / 255 - np.array(mean)) / np.array(std)).float().permute(0, 3, 1, 2)
    prompt = "a photo of red chair." if is_clip else "This is a photo of red chair."
    tokens = AutoTokenizer.from_pretrained(folder)([prompt], padding="max_length", max_length=16, return_tensors="pt")
    more = {"attention_mask": tokens["attention_mask"]} if is_clip else {}
    with torch.inference_mode():
        pictures = network.get_image_features(pixel_values=pixels).pooler_output
        words = network.get_text_features(input_ids=tokens["input_ids"], **more).pooler_output
    for found, raw in ((model.embed_crops(crops), pictures), (model.embed_text("red chair")[None], words)):
        expected = (raw / raw.norm(dim=1, keepdim=True)).numpy()
        np.testing.assert_allclose(found, expected, atol=2e-5)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.abs(model.embed_text("red chair") - model.embed_text("blue bed")).max() > 0.01
    assert model.space.startswith(f"{folder.name}@")


def test_with_embeddings_skips_weak_or_small_detections(siglip: Path) -> None:
    detector = WithEmbeddings(Blocks(), str(siglip), min_pixels=101, device="cpu")
    frame = picture()
    found = detector.detect(frame)
    assert found.embeddings is not None
    assert np.linalg.norm(found.embeddings, axis=1) == pytest.approx([1, 0, 0])
    plain = Blocks().detect(frame)
    np.testing.assert_array_equal(found.masks, plain.masks)
    everything = WithEmbeddings(Blocks(), str(siglip), min_pixels=1, min_score=0.0, batch_size=2, device="cpu")
    lengths = np.linalg.norm(everything.detect(frame).embeddings, axis=1)
    assert lengths == pytest.approx([1, 1, 1])
    np.testing.assert_allclose(everything.detect(frame).embeddings[0], found.embeddings[0], atol=1e-5)
    nothing = replace(detector, min_score=1.0).detect(frame)
    assert (nothing.embeddings, nothing.embedding_space) == (None, "")


def test_with_embeddings_frame_interval_sets_embedded_frames(siglip: Path) -> None:
    detector = WithEmbeddings(Blocks(), str(siglip), frame_interval=3, device="cpu")
    assert [detector.detect(picture(k)).embeddings is not None for k in range(7)] == [True, False, False] * 2 + [True]
    assert "index" in detector.reads


def test_with_embeddings_contrast_controls_background(siglip: Path) -> None:
    """With contrast 1, the background affects the embedding. With contrast 0, only the object does."""
    plain, other = picture(), picture()
    inside = Blocks().detect(plain).masks[0]
    other.color[~inside] = 255 - other.color[~inside]
    for surroundings, same in ((0.0, True), (1.0, False)):
        detector = WithEmbeddings(Blocks(), str(siglip), background_contrast=surroundings, device="cpu")
        a, b = (detector.detect(frame).embeddings[0] for frame in (plain, other))
        assert np.allclose(a, b, atol=1e-5) == same
    other.color[inside] = 255 - other.color[inside]
    assert not np.allclose(detector.detect(other).embeddings[0], a, atol=1e-5)


def test_with_embeddings_crop_is_padded_square_around_box() -> None:
    color = np.zeros((40, 60, 3), np.uint8)
    color[..., 0], color[..., 1] = np.arange(60), np.arange(40)[:, None]
    mask = np.zeros((1, 40, 60), np.bool_)
    mask[0, 10:18, 20:36] = True
    [crop] = square_crops(color, mask, 16, 1.0, 1.0)
    np.testing.assert_array_equal(crop[0, :, 0], np.arange(20, 36))
    np.testing.assert_array_equal(crop[:, 0, 1], np.arange(6, 22))
    [gray] = square_crops(color, mask, 16, 1.0, 0.0)
    np.testing.assert_array_equal(np.flatnonzero((gray != GRAY).any(axis=(1, 2))), np.arange(4, 12))
    [wide] = square_crops(color, mask, 32, 2.0, 1.0)
    np.testing.assert_array_equal(wide[16, :, 0], np.arange(12, 44))
    mask[:] = False
    mask[0, :4, :4] = True
    [corner] = square_crops(color, mask, 8, 2.0, 1.0)
    assert (corner[:2] == 0).all(), "expected 0 outside the image"
    np.testing.assert_array_equal(corner[2:6, 2:6], color[:4, :4])
    assert not square_crops(color, np.zeros((1, 40, 60), np.bool_), 8, 1.5, 1.0).any()


def test_with_embeddings_fingerprint_covers_detector_and_model(siglip: Path, tmp_path: Path) -> None:
    own = identity_of(WithEmbeddings(SphereDetector(), str(siglip), device="cpu"))
    assert own == identity_of(WithEmbeddings(SphereDetector(), str(siglip), device="cpu"))
    clip = write_image_text(tmp_path / "clip", "clip")
    others = [
        WithEmbeddings(SphereDetector(), str(clip), device="cpu"),
        WithEmbeddings(SphereDetector(), str(siglip), context=1.3, device="cpu"),
        WithEmbeddings(registered.built("detector", "mask_rcnn_rooms"), str(siglip), device="cpu"),
    ]
    assert len({own, *map(identity_of, others)}) == 4


def test_with_embeddings_nested_detector_error_names_path(siglip: Path) -> None:
    chosen = "detector@detector.detector=ground_truth"
    detector = registered.built("detector", "with_embeddings", chosen, f"detector.model={siglip}", "device=cpu")
    found = detector.detect(CornerRoom()[0])
    assert found.exact
    assert found.embeddings is not None
    assert found.embeddings.any(axis=1).sum() >= 1
    with pytest.raises(ConfigError, match=r"^detector\.detector\.min_pixels: expected at least 1 px, got 0"):
        registered.built("detector", "with_embeddings", chosen, "detector.detector.min_pixels=0")
    with pytest.raises(ConfigError, match="expected a value for detector"):
        registered.built("detector", "with_embeddings", "~detector.detector")


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("config.json", "expected config.json in"),
        ("tokenizer.json", "expected the tokenizer in"),
        ("model.safetensors", "expected the weights in"),
        ("preprocessor_config.json", "preprocessor_config.json"),
    ],
)
def test_with_embeddings_damaged_model_raises_one_line_error(change: str, fault: str, tmp_path: Path) -> None:
    folder = write_image_text(tmp_path / "model")
    (folder / change).write_bytes(b"{]")
    with pytest.raises(DataError, match=fault) as refused:
        WithEmbeddings(Blocks(), str(folder), device="cpu")
    assert "\n" not in str(refused.value)


def test_with_embeddings_unsupported_model_raises(tmp_path: Path) -> None:
    from tests.support.networks.tiny_transformers import write_network

    with pytest.raises(
        ConfigError, match=r"detector\.model: expected CLIP or SigLIP with a fixed image size, got .* \(mask2former\)"
    ):
        WithEmbeddings(Blocks(), str(write_network(tmp_path, "mask2former")), device="cpu")


def test_with_embeddings_model_id_offline_raises_one_line_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(DataError, match="while HF_HUB_OFFLINE disables downloads, got google/siglip2-base-patch16-224"):
        registered.built("detector", "with_embeddings")
