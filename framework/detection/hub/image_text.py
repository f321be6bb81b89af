"""CLIP and SigLIP, versions 1 and 2, from Hugging Face transformers: image and text embeddings in one space."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from framework.data import Bool, Float32, UInt8
from framework.detection.hub.hub_model import (
    CONFIG,
    PREPROCESSING,
    TOKENIZER,
    find_model,
    imported_transformers,
    read_part,
)
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.runtimes.device import torch_device
from framework.errors import ConfigError, DataError
from framework.files.hashing import path_hash
from framework.files.json_file import read_json

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)  # where a file has none
LONGEST_SIDE = 1024  # px of a model's pictures
HASH_DIGITS = 16  # of a local folder's content in the name of its space


class ImageTextFamily(NamedTuple):
    """What a kind of model wants."""

    prompt: str  # the words that published figures have around a class's name
    padding: str  # of texts, as in the training
    lower: bool  # whether texts are in lower case
    mean: tuple[float, ...]  # RGB, where the file leaves it out
    std: tuple[float, ...]


FAMILIES = {
    "clip": ImageTextFamily("a photo of {}.", "longest", False, CLIP_MEAN, CLIP_STD),
    # https://huggingface.co/docs/transformers/model_doc/siglip2: padded to 64 tokens, in lower case
    "siglip": ImageTextFamily("This is a photo of {}.", "max_length", True, (0.5,) * 3, (0.5,) * 3),
}
"""By the `model_type` in config.json. SigLIP 2 of a fixed size (siglip2-base-patch16-224) is `siglip` there."""

MOST_TOKENS = 64  # of a text; CLIP takes 77 and SigLIP 64


class ImageTextModel:
    """A model with an image tower and a text tower (Radford et al. 2021, "CLIP").

    Attributes:
        space: Name and version of the model. Only embeddings of the same space are comparable.
        side: Width and height of the input images, in px.
    """

    def __init__(self, model: str, revision: str, device: str, half_precision: bool) -> None:
        """Load a model by its id on huggingface.co, or from a folder written by `save_pretrained`.

        Raises:
            ConfigError: The model is neither CLIP nor a SigLIP of a fixed size, or the device is missing.
            DataError: The model cannot be downloaded or read.
        """
        transformers = imported_transformers()
        self._folder = find_model(model, revision, TOKENIZER)
        self._device = torch_device(device)
        config = read_part("detector.model", self._folder, "its config.json", transformers.AutoConfig)
        if config.model_type not in FAMILIES:
            raise ConfigError(
                f"detector.model must be a CLIP or a SigLIP of a fixed size, found {model}, a {config.model_type}"
            )
        self._family = FAMILIES[config.model_type]
        self.side = int(config.vision_config.image_size)
        if not 16 <= self.side <= LONGEST_SIDE:
            raise DataError(f"detector.model: {self._folder} takes pictures of {self.side} px; expected 16 to 1024")
        self._mean, self._std, self._factor = _normalization(self._folder / PREPROCESSING, self._family)
        self._tokenizer = read_part("detector.model", self._folder, "its tokenizer", transformers.AutoTokenizer)
        network = read_part("detector.model", self._folder, "its weights", transformers.AutoModel)
        self._dtype = torch.float16 if half_precision and self._device.type == "cuda" else torch.float32
        self._network = network.to(self._device, self._dtype).eval()
        self.space = _space(self._folder, model)

    @torch.inference_mode()
    def embed_crops(self, crops: UInt8) -> Float32:
        """Return unit vectors (N, D) of crops (N, side, side, 4): RGB and a mask, which is ignored."""
        pictures = torch.from_numpy(crops[..., :3]).to(self._device).permute(0, 3, 1, 2).float() * self._factor
        mean, std = (torch.tensor(values, device=self._device)[:, None, None] for values in (self._mean, self._std))
        pixels = ((pictures - mean) / std).to(self._dtype)
        return self._unit(self._network.get_image_features(pixel_values=pixels))

    @torch.inference_mode()
    def embed_text(self, text: str) -> Float32:
        """Return the unit vector (D,) of a phrase such as "a red chair"."""
        prompt = self._family.prompt.format(text.lower() if self._family.lower else text)
        length = min(MOST_TOKENS, int(self._network.config.text_config.max_position_embeddings))
        tokens = self._tokenizer(
            [prompt], padding=self._family.padding, max_length=length, truncation=True, return_tensors="pt"
        )
        given = {"input_ids": tokens["input_ids"].to(self._device)}
        if self._family.padding == "longest":  # SigLIP was trained without
            given["attention_mask"] = tokens["attention_mask"].to(self._device)
        return np.asarray(self._unit(self._network.get_text_features(**given))[0])

    def _unit(self, features: Any) -> Float32:
        """Return the features (N, D) with unit length. Raises DataError for zero or non-finite features."""
        tensor: Tensor = features if isinstance(features, Tensor) else features.pooler_output
        vectors = tensor.float().cpu().numpy()
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        if not np.isfinite(lengths).all() or (lengths == 0).any():
            raise DataError(
                f"{self.space} computed an embedding that is not finite, or 0; set detector.half_precision=false"
            )
        return np.asarray(vectors / lengths, np.float32)


def _normalization(path: Path, family: ImageTextFamily) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Mean, standard deviation and the factor before them, by preprocessor_config.json."""
    content = read_json(path)
    if not isinstance(content, Mapping):
        raise DataError(f"detector.model: {path} must hold an object")
    mean, std = (tuple(content.get(key, value)) for key, value in zip(
        ("image_mean", "image_std"), (family.mean, family.std), strict=True))  # fmt: skip
    factor = content.get("rescale_factor", 1 / 255)
    numbers = (*mean, *std, factor)
    if len(numbers) != 7 or not all(isinstance(x, int | float) and np.isfinite(x) for x in numbers) or 0 in std:
        raise DataError(
            f"detector.model: {path}: image_mean, image_std and rescale_factor must be numbers, not {numbers}"
        )
    return mean, std, float(factor)


def _space(folder: Path, model: str) -> str:
    """Of a model id, with the commit that was downloaded; of a folder, with a hash of what it computes with."""
    if folder.parent.name == "snapshots":
        return f"{model}@{folder.name}"
    weights = sorted(folder.glob("*.safetensors")) + sorted(folder.glob("pytorch_model*.bin"))
    hashes = "".join(path_hash(path) for path in [folder / CONFIG, *weights])
    return f"{folder.name}@{hashlib.sha256(hashes.encode()).hexdigest()[:HASH_DIGITS]}"


GRAY = 128


def square_crops(color: UInt8, masks: Bool, side: int, context: float, surroundings: float = 1.0) -> UInt8:
    """One picture (side, side, 4) for each of the masks (N, H, W) of the image `color` (H, W, 3): RGB, and 255 inside.

    A picture is the square around the mask's middle whose side is `context` times the longer side of the mask's box, so
    that nothing is distorted; what lies beyond the image is black. What is around the object keeps the share
    `surroundings` of its difference from gray. Shrinking averages. An empty mask gives black.
    """
    crops = np.zeros((len(masks), side, side, 4), np.uint8)
    for k, box in enumerate(tight_boxes(masks)):
        if not masks[k].any():
            continue
        with_mask = np.dstack([color, masks[k].view(np.uint8) * np.uint8(255)])
        crops[k] = _square_crop(with_mask, box, side, context, surroundings)
    return crops


def _square_crop(image: UInt8, box: Float32, side: int, context: float, surroundings: float) -> UInt8:
    """The square (side, side, 4) around a box x1 y1 x2 y2 of pixels inside, of an image whose fourth channel is 255
    on the object.
    """
    height, width = image.shape[:2]
    x1, y1, x2, y2 = (int(value) for value in box)
    wide = max(1, round(context * (max(x2 - x1, y2 - y1) + 1)))  # px
    left, top = (x1 + x2 + 1 - wide) // 2, (y1 + y2 + 1 - wide) // 2
    square = np.zeros((wide, wide, image.shape[2]), np.uint8)
    u1, v1, u2, v2 = max(left, 0), max(top, 0), min(left + wide, width), min(top + wide, height)
    square[v1 - top : v2 - top, u1 - left : u2 - left] = image[v1:v2, u1:u2]
    if surroundings < 1:
        around = square[..., 3] == 0
        square[around, :3] = np.round(GRAY + surroundings * (square[around, :3].astype(np.float32) - GRAY))
    shrinks = side < wide
    return np.asarray(cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def network_pixels(image: UInt8, mean: Sequence[float], std: Sequence[float], device: torch.device) -> torch.Tensor:
    """The input (1, 3, H, W) of an image (H, W, 3) RGB: shares of 255, less the mean, by the standard deviation."""
    pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float() / 255
    return (pixels - torch.tensor(mean, device=device)[:, None, None]) / torch.tensor(std, device=device)[:, None, None]
