"""Objects that are named in words: boxes by OWLv2, masks by the SAM family or by depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import MOST_DETECTIONS, check_count, require
from framework.data import Bool, Detections, Float32, Frame
from framework.detection.hub.box_prompted_masks import BoxPromptedMasks
from framework.detection.hub.text_boxes import WordBoxes
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.masks.masks_from_boxes import masks_in_boxes
from framework.detection.masks.nms import suppress_boxes
from framework.detection.runtimes.device import torch_device
from framework.detection.stored.fingerprint import fingerprint
from framework.interfaces import Detector

SOMETHING_ELSE = "something else"
MOST_WORDS = 500
SIGNIFICANCE, MAX_SLANT, MIN_READINGS = 0.4, 85.0, 0.1  # of masks by depth, as in onnx_boxes


@dataclass
class OpenVocabulary(Detector):
    """Finds what words name: OWLv2's boxes and the masks of SAM, SAM 2 or EdgeTAM; needs the extra `transformers`.

    The classes are the words as they are written, and `something else`. OWLv2 says for each word p, how probably it
    names the box, each for itself. The distribution is proportional to the odds p / (1 - p); `something else` has the
    odds of the threshold, so that what is barely accepted is as probably something else. The score is the largest p.
    A word that is one of COCO's names is evaluated as that class; others are in the map and in no evaluation.
    """

    words: list[str] = field(default_factory=lambda: ["chair", "table", "mug"])  # what to look for, each once
    model: str = "google/owlv2-base-patch16-ensemble"  # OWLv2: id on huggingface.co, or a folder
    revision: str = "main"  # branch, tag or commit of a model id
    masks: str = "facebook/sam2.1-hiera-tiny"  # SAM, SAM 2 or EdgeTAM (needs timm) likewise; "" = masks from depth
    masks_revision: str = "main"  # likewise
    score_threshold: float = 0.1  # in (0, 1)
    nms: float = 0.5  # IoU in (0, 1] above which a box falls to a better one, of whatever word
    agnostic_nms: float = 0.6  # IoU in (0, 1] above which a mask falls to a better one; 1 = off
    max_detections: int = 50  # >= 1, an image
    half_precision: bool = True  # half precision on CUDA
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where there is one
    reads = ("color", "depth", "camera")

    def __post_init__(self) -> None:
        require(0 < self.score_threshold < 1, "detector.score_threshold", self.score_threshold, "in (0, 1)")
        require(0 < self.nms <= 1, "detector.nms", self.nms, "in (0, 1]")
        require(0 < self.agnostic_nms <= 1, "detector.agnostic_nms", self.agnostic_nms, "in (0, 1]")
        check_count("detector.max_detections", self.max_detections, MOST_DETECTIONS)
        names = [word.strip() for word in self.words]
        fits = 1 <= len(names) <= MOST_WORDS and all(names) and len({*names, SOMETHING_ELSE}) == len(names) + 1
        require(fits, "detector.words", self.words, f"1 to {MOST_WORDS} different words, not {SOMETHING_ELSE!r}")
        device = torch_device(self.device)
        self.classes = (*names, SOMETHING_ELSE)
        self._boxes = WordBoxes(self.model, self.revision, names, device, self.half_precision)
        self._masks = (
            BoxPromptedMasks(self.masks, self.masks_revision, device, self.half_precision) if self.masks else None
        )
        commits = [model.folder for model in (self._boxes, self._masks) if model is not None]
        self._commits = " ".join(folder.name for folder in commits if folder.parent.name == "snapshots")

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {self._commits}"

    def detect(self, frame: Frame) -> Detections:
        boxes, probabilities = self._boxes(frame.color)
        scores = probabilities.max(axis=1)
        good = np.flatnonzero(scores >= self.score_threshold)
        kept = good[suppress_boxes(boxes[good], scores[good], self.nms, limit=self.max_detections, extent=0.0)]
        masks = self._masks_of(frame, boxes[kept])
        distributions = word_distributions(probabilities[kept], self.score_threshold)
        return without_duplicates(masks, scores[kept], distributions, self.classes, self.agnostic_nms)

    def _masks_of(self, frame: Frame, boxes: Float32) -> Bool:
        if self._masks is not None:
            return self._masks(frame.color, boxes)
        return masks_in_boxes(boxes, frame.depth, frame.camera, SIGNIFICANCE, MAX_SLANT, MIN_READINGS)[0]


def word_distributions(probabilities: Float32, threshold: float) -> Float32:
    """Distributions (N, W + 1) over W words and `something else`, by the odds of independent probabilities (N, W)."""
    p = np.clip(probabilities.astype(np.float64), 1e-6, 1 - 1e-6)
    odds = np.hstack([p / (1 - p), np.full((len(p), 1), threshold / (1 - threshold))])
    return np.asarray(odds / odds.sum(axis=1, keepdims=True), np.float32)
