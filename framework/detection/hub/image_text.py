"""Models that embed images and texts in a common space: CLIP, SigLIP and SigLIP 2."""

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
    commit_of,
    find_model,
    imported_transformers,
    read_part,
)
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.runtimes.device import ready, torch_device
from framework.errors import ConfigError, DataError
from framework.files.hashing import path_hash
from framework.files.json_file import read_json

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
LONGEST_SIDE = 1024  # maximum side of a model's input, px
HASH_DIGITS = 16  # number of digits of a local folder's content hash in the name of the embedding space
MAX_TOKENS = 64  # maximum length of a text, tokens; the limit is 77 for CLIP and 64 for SigLIP
GRAY = 128  # gray value of suppressed surroundings


class ImageTextFamily(NamedTuple):
    """Conventions of a family of image-text models."""

    prompt: str  # template around a class name, as in the published evaluation
    padding: str  # padding of texts, as in training
    lower: bool  # True = texts are converted to lower case
    mean: tuple[float, ...]  # RGB; default if the preprocessing file has no value
    std: tuple[float, ...]


FAMILIES = {
    "clip": ImageTextFamily("a photo of {}.", "longest", False, CLIP_MEAN, CLIP_STD),
    # https://huggingface.co/docs/transformers/model_doc/siglip2: padded to 64 tokens, in lower case
    "siglip": ImageTextFamily("This is a photo of {}.", "max_length", True, (0.5,) * 3, (0.5,) * 3),
}
"""Families by `model_type` of config.json. SigLIP 2 with a fixed image size also has the `model_type` `siglip`."""


class ImageTextModel:
    """A model with an image encoder and a text encoder (Radford et al. 2021, "CLIP").

    Attributes:
        space: The name and version of the model. Only embeddings with the same value can be compared.
        side: The width and height of the input images, px.
    """

    def __init__(self, model: str, revision: str, device: str, half_precision: bool) -> None:
        """Load a model by its huggingface.co id, or from a folder written by `save_pretrained`.

        Raises:
            ConfigError: The model is neither CLIP nor SigLIP with a fixed image size, or the device is missing.
            DataError: The model cannot be downloaded or read.
        """
        transformers = imported_transformers()
        self._folder = find_model(model, revision, TOKENIZER)
        self._device = torch_device(device)
        config = read_part("detector.model", self._folder, "config.json", transformers.AutoConfig)
        if config.model_type not in FAMILIES:
            raise ConfigError(
                f"detector.model: expected CLIP or SigLIP with a fixed image size, got {model} ({config.model_type})"
            )
        self._family = FAMILIES[config.model_type]
        self.side = int(config.vision_config.image_size)
        if not 16 <= self.side <= LONGEST_SIDE:
            raise DataError(
                f"detector.model: expected an image size of 16 to 1024 px, got {self.side} px in {self._folder}"
            )
        self._mean, self._std, self._factor = _normalization(self._folder / PREPROCESSING, self._family)
        self._tokenizer = read_part("detector.model", self._folder, "the tokenizer", transformers.AutoTokenizer)
        network = read_part("detector.model", self._folder, "the weights", transformers.AutoModel)
        self._network = ready(network, self._device, half_precision)
        self.space = _space(self._folder, model)

    @torch.inference_mode()
    def embed_crops(self, crops: UInt8) -> Float32:
        """Return the normalized embeddings (N, D) of image crops.

        Args:
            crops: The crops (N, side, side, 3), RGB.
        """
        images = torch.from_numpy(crops).to(self._device).permute(0, 3, 1, 2).float() * self._factor
        mean, std = (torch.tensor(values, device=self._device)[:, None, None] for values in (self._mean, self._std))
        pixels = ((images - mean) / std).to(self._network.dtype)
        return self._unit(self._network.get_image_features(pixel_values=pixels))

    @torch.inference_mode()
    def embed_text(self, text: str) -> Float32:
        """Return the normalized embedding (D,) of a phrase, such as "a red chair"."""
        prompt = self._family.prompt.format(text.lower() if self._family.lower else text)
        length = min(MAX_TOKENS, int(self._network.config.text_config.max_position_embeddings))
        tokens = self._tokenizer(
            [prompt], padding=self._family.padding, max_length=length, truncation=True, return_tensors="pt"
        )
        given = {"input_ids": tokens["input_ids"].to(self._device)}
        if self._family.padding == "longest":  # SigLIP was trained without an attention mask
            given["attention_mask"] = tokens["attention_mask"].to(self._device)
        return np.asarray(self._unit(self._network.get_text_features(**given))[0])

    def _unit(self, features: Any) -> Float32:
        """Normalize feature vectors (N, D) to unit length."""
        tensor: Tensor = features if isinstance(features, Tensor) else features.pooler_output
        vectors = tensor.float().cpu().numpy()
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        if not np.isfinite(lengths).all() or (lengths == 0).any():
            fix = "; set detector.half_precision=false" if self._network.dtype == torch.float16 else ""
            raise DataError(
                f"detector.model: expected finite, nonzero embeddings from {self.space}, got NaN, infinity or 0{fix}"
            )
        return np.asarray(vectors / lengths, np.float32)


def _normalization(path: Path, family: ImageTextFamily) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Read the mean, the standard deviation and the rescale factor from preprocessor_config.json."""
    content = read_json(path)
    if not isinstance(content, Mapping):
        raise DataError(f"detector.model: {path}: expected a JSON object, got {content!r:.100}")
    mean, std = tuple(content.get("image_mean", family.mean)), tuple(content.get("image_std", family.std))
    factor = content.get("rescale_factor", 1 / 255)
    numbers = (*mean, *std, factor)
    if len(numbers) != 7 or not all(isinstance(x, int | float) and np.isfinite(x) for x in numbers) or 0 in std:
        raise DataError(
            f"detector.model: {path}: expected 3 numbers in image_mean, 3 nonzero numbers in image_std and 1 in "
            f"rescale_factor, all finite, got {mean}, {std} and {factor}"
        )
    return mean, std, float(factor)


def _space(folder: Path, model: str) -> str:
    """Return a name that identifies the model and its version."""
    if commit := commit_of(folder):
        return f"{model}@{commit}"
    weights = sorted(folder.glob("*.safetensors")) + sorted(folder.glob("pytorch_model*.bin"))
    hashes = "".join(path_hash(path) for path in [folder / CONFIG, *weights])
    return f"{folder.name}@{hashlib.sha256(hashes.encode()).hexdigest()[:HASH_DIGITS]}"


def square_crops(color: UInt8, masks: Bool, side: int, context: float, contrast: float) -> UInt8:
    """Return square crops (N, side, side, 3) of an image around masks.

    The crop of an empty mask is black. Pixels of a crop outside the image are treated as black surroundings.

    Args:
        color: The image (H, W, 3), RGB.
        masks: The masks (N, H, W).
        side: The side of the resized crops, px.
        context: The side of a crop before resizing, as a multiple of the longer side of the mask's bounding box.
        contrast: The contrast of pixels outside the mask. With 1 they are unchanged, with 0 they are gray.
    """
    crops = np.zeros((len(masks), side, side, 3), np.uint8)
    for k, box in enumerate(tight_boxes(masks)):
        if masks[k].any():
            crops[k] = _square_crop(color, masks[k], box, side, context, contrast)
    return crops


def _square_crop(color: UInt8, mask: Bool, box: Float32, side: int, context: float, contrast: float) -> UInt8:
    """Return the crop (side, side, 3) of an image (H, W, 3) with a mask (H, W) around a box."""
    height, width = mask.shape
    x1, y1, x2, y2 = (int(value) for value in box)
    wide = max(1, round(context * (max(x2 - x1, y2 - y1) + 1)))  # px
    left, top = (x1 + x2 + 1 - wide) // 2, (y1 + y2 + 1 - wide) // 2
    square, around = np.zeros((wide, wide, 3), np.uint8), np.ones((wide, wide), np.bool_)
    u1, v1, u2, v2 = max(left, 0), max(top, 0), min(left + wide, width), min(top + wide, height)
    inside = slice(v1 - top, v2 - top), slice(u1 - left, u2 - left)
    square[inside], around[inside] = color[v1:v2, u1:u2], ~mask[v1:v2, u1:u2]
    if contrast < 1:
        square[around] = np.round(GRAY + contrast * (square[around].astype(np.float32) - GRAY))
    interpolation = cv2.INTER_AREA if side < wide else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(square, (side, side), interpolation=interpolation))


def network_pixels(image: UInt8, mean: Sequence[float], std: Sequence[float], device: torch.device) -> Tensor:
    """Normalize an RGB image (H, W, 3) and convert it to a network input (1, 3, H, W).

    The mean and the standard deviation refer to values in [0, 1].
    """
    pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float() / 255
    return (pixels - torch.tensor(mean, device=device)[:, None, None]) / torch.tensor(std, device=device)[:, None, None]
