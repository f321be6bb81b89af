"""Prompted models from Hugging Face transformers.

OWLv2 detects boxes for texts. The models of the SAM family segment the objects in boxes.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch.nn import functional

from framework.data import Bool, Float32, UInt8
from framework.detection.candidates import corners
from framework.detection.hub.hub_model import TOKENIZER, find_model, imported_transformers, read_part
from framework.detection.hub.image_text import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, network_pixels
from framework.detection.runtimes.device import ready
from framework.errors import ConfigError, DataError

PROMPT = "a photo of a {}"  # Minderer et al. 2023
MAX_TOKENS = 16  # maximum length of a text, tokens, as in the training of OWLv2
PADDING = 128  # gray value of the padding to the right of or below the image in OWLv2's square input
SAM_FAMILY = {
    "sam": ("SamModel", False),
    "sam2": ("Sam2Model", True),
    "sam2_video": ("Sam2Model", True),
    "edgetam": ("EdgeTamModel", True),
    "edgetam_video": ("EdgeTamModel", True),
}
"""Class by `model_type`, and True if the image is stretched to the square input; otherwise, the normalized image is
padded with zeros."""


class TextPromptedBoxes:
    """Box detector OWLv2 (Minderer et al. 2023) for a fixed list of texts."""

    def __init__(
        self, model: str, revision: str, texts: Sequence[str], device: torch.device, half_precision: bool
    ) -> None:
        transformers = imported_transformers()
        self.folder = find_model(model, revision, TOKENIZER)
        config = read_part("detector.model", self.folder, "config.json", transformers.AutoConfig)
        if config.model_type != "owlv2":
            raise ConfigError(f"detector.model: expected OWLv2, got {model} ({config.model_type})")
        tokenizer = read_part("detector.model", self.folder, "the tokenizer", transformers.AutoTokenizer)
        network = read_part("detector.model", self.folder, "the weights", transformers.Owlv2ForObjectDetection)
        tokens = tokenizer(
            [PROMPT.format(text) for text in texts],
            padding="max_length", max_length=MAX_TOKENS, truncation=True, return_tensors="pt",
        )  # fmt: skip
        self._network = ready(network, device, half_precision)
        self._tokens = {name: tokens[name].to(device) for name in ("input_ids", "attention_mask")}
        self._side = int(config.vision_config.image_size)
        self._device = device

    @torch.inference_mode()
    def __call__(self, color: UInt8) -> tuple[Float32, Float32]:
        """Detect boxes in an image.

        Args:
            color: The image (H, W, 3), RGB.

        Returns:
            The candidate boxes (P, 4) x1 y1 x2 y2, px, and the probability (P, T) of each text. Pixel centers are at
            integers.
        """
        long = max(color.shape[:2])
        square = np.full((long, long, 3), PADDING, np.uint8)
        square[: color.shape[0], : color.shape[1]] = color
        interpolation = cv2.INTER_AREA if self._side < long else cv2.INTER_LINEAR
        resized = cv2.resize(square, (self._side, self._side), interpolation=interpolation)
        pixels = network_pixels(resized, CLIP_MEAN, CLIP_STD, self._device).to(self._network.dtype)
        output = self._network(pixel_values=pixels, **self._tokens)
        boxes = corners(output.pred_boxes[0].float().cpu().numpy()) * np.float32(long) - 0.5  # from 0..1 of the square
        probabilities = torch.sigmoid(output.logits[0].float()).cpu().numpy()
        if not (np.isfinite(boxes).all() and np.isfinite(probabilities).all()):
            fix = "; set detector.half_precision=false" if self._network.dtype == torch.float16 else ""
            raise DataError(f"detector.model: expected finite outputs from {self.folder}, got NaN or infinity{fix}")
        return boxes.astype(np.float32), probabilities


class BoxPromptedMasks:
    """Segmentation model SAM (Kirillov et al. 2023), SAM 2 or EdgeTAM with boxes as prompts."""

    def __init__(self, model: str, revision: str, device: torch.device, half_precision: bool) -> None:
        transformers = imported_transformers()
        self.folder = find_model(model, revision)
        config = read_part("detector.mask_model", self.folder, "config.json", transformers.AutoConfig)
        if config.model_type not in SAM_FAMILY:
            raise ConfigError(f"detector.mask_model: expected SAM, SAM 2 or EdgeTAM, got {model} ({config.model_type})")
        class_name, self._stretched = SAM_FAMILY[config.model_type]
        network = read_part("detector.mask_model", self.folder, "the weights", getattr(transformers, class_name))
        self._network = ready(network, device, half_precision)
        prompts = config.prompt_encoder_config
        side = prompts.image_size if self._stretched else config.vision_config.image_size
        self._side = int(side if isinstance(side, int) else side[0])
        self._device, self._model = device, model

    @torch.inference_mode()
    def __call__(self, color: UInt8, boxes: Float32) -> Bool:
        """Segment the objects in boxes and return their masks (N, H, W).

        Args:
            color: The image (H, W, 3), RGB.
            boxes: The boxes (N, 4) x1 y1 x2 y2, px, with pixel centers at integers.
        """
        height, width = color.shape[:2]
        if not len(boxes):
            return np.zeros((0, height, width), np.bool_)
        scale = self._side / max(height, width)
        resized = (self._side, self._side) if self._stretched else (round(width * scale), round(height * scale))
        small = cv2.resize(color, resized, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        pixels = network_pixels(small, IMAGENET_MEAN, IMAGENET_STD, self._device)
        pixels = functional.pad(pixels, (0, self._side - resized[0], 0, self._side - resized[1]))
        factors = np.array([resized[0] / width, resized[1] / height] * 2, np.float32)
        dtype = self._network.dtype
        prompts = torch.from_numpy((boxes + 0.5) * factors).to(self._device, dtype)[None]
        output = self._network(pixel_values=pixels.to(dtype), input_boxes=prompts, multimask_output=False)
        logits = output.pred_masks[0, :, 0].float()
        if not torch.isfinite(logits).all():
            fix = "; set detector.half_precision=false" if dtype == torch.float16 else ""
            raise DataError(
                f"detector.mask_model: expected finite outputs from {self._model}, got NaN or infinity{fix}"
            )
        whole = functional.interpolate(logits[None], (self._side, self._side), mode="bilinear", align_corners=False)
        inside = whole[..., : resized[1], : resized[0]]
        full_size = functional.interpolate(inside, (height, width), mode="bilinear", align_corners=False)[0]
        return np.asarray((full_size > 0).cpu().numpy(), np.bool_)
