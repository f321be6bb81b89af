"""Any detector, with embeddings of what it finds: vectors that words can be compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Detections, Float32, Frame, UInt8
from framework.detection.domain import domain_of
from framework.detection.hub.image_text import ImageTextModel, square_crops
from framework.detection.stored.cache import FRAME_FIELDS, ReadsFields, identity_of
from framework.detection.stored.fingerprint import fingerprint
from framework.interfaces import Detector


@dataclass
class WithEmbeddings(Detector):
    """Adds to each detection of another detector the embedding of its picture by a model that knows words, too.

    The model is CLIP or SigLIP of Hugging Face transformers (extra `transformers`).
    """

    detector: Detector  # what finds the objects; detector@detector.detector=NAME chooses another one
    model: str = "google/siglip2-base-patch16-224"  # id on huggingface.co, or a folder
    revision: str = "main"  # branch, tag or commit of a model id
    frame_interval: int = 1  # frames, >= 1: only those whose number is a multiple are embedded, to save time
    min_score: float = 0.3  # in [0, 1]: only detections this good are embedded; weaker ones are wrong too often
    min_pixels: int = 200  # px >= 1, of a mask: less of an object tells little
    context: float = 1.2  # >= 1, side of the square picture over the longer side of the object's box
    background_contrast: float = 0.4  # in [0, 1]: contrast that the background keeps: 0 = gray, 1 = all
    batch_size: int = 16  # pictures at once, >= 1
    half_precision: bool = True  # half precision on CUDA
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where there is one

    def __post_init__(self) -> None:
        check_bounds(
            self,
            frame_interval=(1, 10**6),
            min_score=(0.0, 1.0),
            min_pixels=(1, 2**31),
            context=(1.0, 4.0),
            background_contrast=(0.0, 1.0),
            batch_size=(1, 4096),
        )
        self._model = ImageTextModel(self.model, self.revision, self.device, self.half_precision)
        self.classes = self.detector.classes
        self.domain = domain_of(self.detector)
        reads = self.detector.reads if isinstance(self.detector, ReadsFields) else FRAME_FIELDS
        self.reads = tuple(dict.fromkeys((*reads, "color", *(["index"] if self.frame_interval > 1 else []))))

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {identity_of(self.detector)} {self._model.space}"

    def detect(self, frame: Frame) -> Detections:
        found = self.detector.detect(frame)
        if frame.index % self.frame_interval:
            return found
        areas = np.count_nonzero(found.masks, axis=(1, 2))
        chosen = np.flatnonzero((found.scores >= self.min_score) & (areas >= self.min_pixels))
        if not len(chosen):
            return found
        crops = square_crops(frame.color, found.masks[chosen], self._model.side, self.context, self.background_contrast)
        vectors = self._embedded(crops)
        embeddings = np.zeros((len(found), vectors.shape[1]), np.float32)
        embeddings[chosen] = vectors
        return replace(found, embeddings=embeddings, embedding_space=self._model.space)

    def _embedded(self, crops: UInt8) -> Float32:
        parts = np.split(crops, range(self.batch_size, len(crops), self.batch_size))
        return np.concatenate([self._model.embed_crops(part) for part in parts])
