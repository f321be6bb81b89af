"""Image embeddings for the detections of any detector, for text queries."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Detections, Frame
from framework.detection.hub.image_text import ImageTextModel, square_crops
from framework.detection.stored.cache import fields_read, identity_of
from framework.detection.stored.fingerprint import fingerprint
from framework.interfaces import Detector, RGBDSequence


@dataclass
class WithEmbeddings(Detector):
    """Detections of another detector with image embeddings from CLIP or SigLIP; needs the extra `transformers`.

    An embedding is computed from a square crop around the object. It is zero for detections without an embedding.
    """

    detector: Detector  # wrapped detector; replace it with detector@detector.detector=NAME
    model: str = "google/siglip2-base-patch16-224"  # CLIP or SigLIP model: id on huggingface.co or folder
    revision: str = "main"  # branch, tag or commit of the model repository
    frame_interval: int = 1  # interval between frames with embeddings, in frames, >= 1; 1 = every frame
    # minimum score of a detection with an embedding, in [0, 1]; detections with lower scores are often wrong
    min_score: float = 0.3
    min_pixels: int = 200  # minimum number of mask pixels of a detection with an embedding, >= 1
    context: float = 1.2  # ratio of the side of the square crop to the longer side of the object's box, in [1, 4]
    background_contrast: float = 0.4  # contrast of the background in the crop, in [0, 1]; 0 = gray, 1 = unchanged
    batch_size: int = 16  # number of crops per batch, in [1, 4096]
    half_precision: bool = True  # True = half precision on CUDA; the CPU always uses single precision
    device: str = "auto"  # device of the network: auto, cpu or cuda; auto = cuda if available

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
        self.classes, self.domain = self.detector.classes, self.detector.domain
        self.calibration = self.detector.calibration
        self.reads = tuple(
            dict.fromkeys((*fields_read(self.detector), "color", *(["index"] if self.frame_interval > 1 else [])))
        )

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {identity_of(self.detector)} {self._model.space}"

    def check_sequence(self, sequence: RGBDSequence) -> None:
        self.detector.check_sequence(sequence)

    def detect(self, frame: Frame) -> Detections:
        found = self.detector.detect(frame)
        if frame.index % self.frame_interval:
            return found
        areas = np.count_nonzero(found.masks, axis=(1, 2))
        chosen = np.flatnonzero((found.scores >= self.min_score) & (areas >= self.min_pixels))
        if not len(chosen):
            return found
        crops = square_crops(frame.color, found.masks[chosen], self._model.side, self.context, self.background_contrast)
        parts = np.split(crops, range(self.batch_size, len(crops), self.batch_size))
        vectors = np.concatenate([self._model.embed_crops(part) for part in parts])
        embeddings = np.zeros((len(found), vectors.shape[1]), np.float32)
        embeddings[chosen] = vectors
        return replace(found, embeddings=embeddings, embedding_space=self._model.space)
