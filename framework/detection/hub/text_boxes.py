"""Boxes for words, by OWLv2 of Hugging Face transformers: the classes are whatever words it is given."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from framework.data import Float32, UInt8
from framework.detection.hub.hub_model import TOKENIZER, find_model, imported_transformers, read_part
from framework.detection.hub.image_text import CLIP_MEAN, CLIP_STD, network_pixels
from framework.errors import ConfigError, DataError

PROMPT = "a photo of a {}"  # Minderer et al. 2023
MOST_TOKENS = 16  # of a text, as in its training
PADDING = 128  # gray, on the right or below: the input is a square


class WordBoxes:
    """OWLv2 (Minderer et al. 2023), by its id on huggingface.co or a folder, for these words."""

    def __init__(
        self, model: str, revision: str, words: Sequence[str], device: torch.device, half_precision: bool
    ) -> None:
        transformers = imported_transformers()
        self.folder = find_model(model, revision, TOKENIZER)
        config = read_part("detector.model", self.folder, "its config.json", transformers.AutoConfig)
        if config.model_type != "owlv2":
            raise ConfigError(f"detector.model must be an OWLv2, found {model}, a {config.model_type}")
        tokenizer = read_part("detector.model", self.folder, "its tokenizer", transformers.AutoTokenizer)
        network = read_part("detector.model", self.folder, "its weights", transformers.Owlv2ForObjectDetection)
        tokens = tokenizer(
            [PROMPT.format(word) for word in words],
            padding="max_length", max_length=MOST_TOKENS, truncation=True, return_tensors="pt",
        )  # fmt: skip
        self._dtype = torch.float16 if half_precision and device.type == "cuda" else torch.float32
        self._network = network.to(device, self._dtype).eval()
        self._tokens = {name: tokens[name].to(device) for name in ("input_ids", "attention_mask")}
        self._side = int(config.vision_config.image_size)
        self._device = device

    @torch.inference_mode()
    def __call__(self, color: UInt8) -> tuple[Float32, Float32]:
        """Boxes (P, 4) x1 y1 x2 y2 px, borders with pixel centres at integers, and for each and each word the
        probability (P, W) that it is what the word says, in [0, 1], each for itself.
        """
        long = max(color.shape[:2])
        square = np.full((long, long, 3), PADDING, np.uint8)
        square[: color.shape[0], : color.shape[1]] = color
        shrinks = self._side < long
        resized = cv2.resize(
            square, (self._side, self._side), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        )
        pixels = network_pixels(resized, CLIP_MEAN, CLIP_STD, self._device).to(self._dtype)
        output = self._network(pixel_values=pixels, **self._tokens)
        centers = output.pred_boxes[0].float().cpu().numpy()  # in shares of the square
        half = centers[:, 2:] / 2
        boxes = np.concatenate([centers[:, :2] - half, centers[:, :2] + half], axis=1) * np.float32(long) - 0.5
        probabilities = torch.sigmoid(output.logits[0].float()).cpu().numpy()
        if not (np.isfinite(boxes).all() and np.isfinite(probabilities).all()):
            raise DataError(
                f"detector.model: the output of {self.folder} is not finite; try detector.half_precision=false"
            )
        return boxes.astype(np.float32), probabilities
