"""Models that know pictures and words in one space: what a picture shows is near to the words for it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np

from framework.data import Float32, UInt8
from framework.detection.hub.weights_file import find_file
from framework.detection.runtimes.device import torch_device
from framework.errors import DataError

ROOM_WORDS_SUFFIX = ".safetensors"  # of a file of train-words; other models are folders or ids


class ImageTextModel(ABC):
    """Two towers of one model (Radford et al. 2021, "CLIP")."""

    space: str  # the name of its space: only embeddings of one space compare
    side: int  # px of its square pictures
    sees_mask: bool  # whether it is told which pixels are of the object; else these alone are to be shown

    @abstractmethod
    def embed_crops(self, crops: UInt8) -> Float32:
        """Unit vectors (N, D) of pictures (N, side, side, 4): RGB, and 255 on the object."""

    @abstractmethod
    def embed_text(self, text: str) -> Float32:
        """The unit vector (D,) of what somebody may call an object: "a red chair".

        Raises DataError, saying what it knows, for words that it cannot understand at all.
        """


def unit_rows(vectors: Float32, who: str) -> Float32:
    """The rows (N, D) divided by their lengths. Raises DataError for what is not finite, or has no direction."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0).any():
        raise DataError(f"{who} computed an embedding that is not finite, or 0; set detector.half=false")
    return np.asarray(vectors / lengths, np.float32)


def open_image_text(model: str, revision: str, device: str, half: bool) -> ImageTextModel:
    """The model that `model` names: a file of `train-words`, a folder, or an id on huggingface.co.

    Raises ConfigError or DataError, in one line, where there is none.
    """
    where = torch_device(device)
    if model.endswith(ROOM_WORDS_SUFFIX):
        from framework.detection.room_words import RoomWords

        return RoomWords(find_file(Path(model), "detector.model"), where)
    from framework.detection.embeddings.hub_image_text import HubImageText

    return HubImageText(model, revision, where, half)
