"""Masks of what is in boxes, by the SAM family of Hugging Face transformers."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch.nn import functional

from framework.data import Bool, Float32, UInt8
from framework.detection.hub.hub_model import find_model, imported_transformers, read_part
from framework.detection.hub.image_text import network_pixels
from framework.errors import ConfigError, DataError

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
STRETCHED = {"sam": False, "sam2": True, "sam2_video": True, "edgetam": True, "edgetam_video": True}
"""By `model_type`: whether the image fills the network's square, or lies in its upper left with black around it."""

CLASSES = {
    "sam": "SamModel",
    "sam2": "Sam2Model",
    "sam2_video": "Sam2Model",
    "edgetam": "EdgeTamModel",
    "edgetam_video": "EdgeTamModel",
}


class BoxPromptedMasks:
    """SAM (Kirillov et al. 2023), SAM 2 or EdgeTAM, by its id on huggingface.co or a folder."""

    def __init__(self, model: str, revision: str, device: torch.device, half_precision: bool) -> None:
        transformers = imported_transformers()
        self.folder = find_model(model, revision)
        config = read_part("detector.masks", self.folder, "its config.json", transformers.AutoConfig)
        if config.model_type not in CLASSES:
            raise ConfigError(
                f"detector.masks must be a SAM, a SAM 2 or an EdgeTAM, found {model}, a {config.model_type}"
            )
        auto_class = getattr(transformers, CLASSES[config.model_type])
        network = read_part("detector.masks", self.folder, "its weights", auto_class)
        self._stretched = STRETCHED[config.model_type]
        prompts = config.prompt_encoder_config
        side = prompts.image_size if self._stretched else config.vision_config.image_size
        self._side = int(side if isinstance(side, int) else side[0])
        self._dtype = torch.float16 if half_precision and device.type == "cuda" else torch.float32
        self._network = network.to(device, self._dtype).eval()
        self._device, self._model = device, model

    @torch.inference_mode()
    def __call__(self, color: UInt8, boxes: Float32) -> Bool:
        """The masks (N, H, W) of the objects in boxes (N, 4) px, borders with pixel centres at integers."""
        height, width = color.shape[:2]
        if not len(boxes):
            return np.zeros((0, height, width), np.bool_)
        scale = self._side / max(height, width)
        resized = (self._side, self._side) if self._stretched else (round(width * scale), round(height * scale))
        shrinks = scale < 1
        small = cv2.resize(color, resized, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        pixels = network_pixels(small, IMAGENET_MEAN, IMAGENET_STD, self._device)
        pixels = functional.pad(pixels, (0, self._side - resized[0], 0, self._side - resized[1]))
        factors = np.array([resized[0] / width, resized[1] / height] * 2, np.float32)
        prompts = torch.from_numpy((boxes + 0.5) * factors).to(self._device, self._dtype)[None]
        output = self._network(pixel_values=pixels.to(self._dtype), input_boxes=prompts, multimask_output=False)
        logits = output.pred_masks[0, :, 0].float()
        if not torch.isfinite(logits).all():
            raise DataError(
                f"detector.masks: the output of {self._model} is not finite; try detector.half_precision=false"
            )
        whole = functional.interpolate(logits[None], (self._side, self._side), mode="bilinear", align_corners=False)
        inside = whole[..., : resized[1], : resized[0]]
        shown = functional.interpolate(inside, (height, width), mode="bilinear", align_corners=False)[0]
        return np.asarray((shown > 0).cpu().numpy(), np.bool_)
