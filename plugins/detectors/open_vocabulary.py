"""Detection of text queries, with boxes from OWLv2 and masks from the SAM family or from depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import MAX_DETECTIONS, check_count, check_intervals, require
from framework.data import Detections, Float32, Frame
from framework.detection.hub.hub_model import commit_of
from framework.detection.hub.prompted_models import BoxPromptedMasks, TextPromptedBoxes
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.masks.boxes import suppress_boxes
from framework.detection.masks.masks_from_boxes import masks_in_boxes
from framework.detection.runtimes.device import torch_device
from framework.detection.stored.fingerprint import fingerprint
from framework.interfaces import Detector

SOMETHING_ELSE = "something else"
MAX_QUERIES = 500  # maximum number of text queries
SIGNIFICANCE, MAX_SLANT, MIN_READINGS = 0.4, 85.0, 0.1  # parameters of masks from depth, as in onnx_boxes


@dataclass
class OpenVocabulary(Detector):
    """Boxes from OWLv2 for text queries, and masks from SAM, SAM 2 or EdgeTAM; needs the extra `transformers`.

    The classes are the text queries and `something else`. OWLv2 estimates an independent probability p of each query
    for each box. The class distribution is proportional to the odds p / (1 - p), with p = `score_threshold` for
    `something else`. The score is the largest probability of a query. Only queries with COCO names are evaluated.
    """

    text_queries: list[str] = field(default_factory=lambda: ["chair", "table", "mug"])  # distinct text queries
    model: str = "google/owlv2-base-patch16-ensemble"  # OWLv2 model: id on huggingface.co or folder
    revision: str = "main"  # branch, tag or commit of the model repository
    # promptable segmentation model for the masks, SAM, SAM 2 or EdgeTAM (requires timm): huggingface.co id or folder;
    # "" = masks from depth
    mask_model: str = "facebook/sam2.1-hiera-tiny"
    mask_model_revision: str = "main"  # branch, tag or commit of the mask model repository
    score_threshold: float = 0.1  # minimum probability of the most likely query for a box, in (0, 1)
    nms_iou: float = 0.5  # box IoU threshold of non-maximum suppression across queries, in (0, 1]
    agnostic_nms_iou: float = 0.6  # mask IoU threshold of non-maximum suppression across queries, in (0, 1]; 1 = off
    max_detections: int = 50  # maximum number of detections per image, >= 1
    half_precision: bool = True  # True = half precision on CUDA; the CPU always uses single precision
    device: str = "auto"  # device of the networks: auto, cpu or cuda; auto = cuda if available
    reads = ("color", "depth", "camera", "sensor")

    def __post_init__(self) -> None:
        check_intervals("detector", self, score_threshold="(0, 1)", nms_iou="(0, 1]", agnostic_nms_iou="(0, 1]")
        check_count("detector.max_detections", self.max_detections, MAX_DETECTIONS)
        names = [query.strip() for query in self.text_queries]
        fits = 1 <= len(names) <= MAX_QUERIES and all(names) and len({*names, SOMETHING_ELSE}) == len(names) + 1
        allowed = f"1 to {MAX_QUERIES} different text queries, none of them {SOMETHING_ELSE!r}"
        require(fits, "detector.text_queries", self.text_queries, allowed)
        device = torch_device(self.device)
        self.classes = (*names, SOMETHING_ELSE)
        self._boxes = TextPromptedBoxes(self.model, self.revision, names, device, self.half_precision)
        mask_model = self.mask_model, self.mask_model_revision, device, self.half_precision
        self._masks = BoxPromptedMasks(*mask_model) if self.mask_model else None
        commits = [commit_of(model.folder) for model in (self._boxes, self._masks) if model is not None]
        self._commits = " ".join(filter(None, commits))

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {self._commits}"

    def detect(self, frame: Frame) -> Detections:
        boxes, probabilities = self._boxes(frame.color)
        scores = probabilities.max(axis=1)
        good = np.flatnonzero(scores >= self.score_threshold)
        kept = good[suppress_boxes(boxes[good], scores[good], self.nms_iou, limit=self.max_detections, extent=0.0)]
        if self._masks is not None:
            masks = self._masks(frame.color, boxes[kept])
        else:
            masks, _ = masks_in_boxes(
                boxes[kept], frame.depth, frame.camera, SIGNIFICANCE, MAX_SLANT, MIN_READINGS, frame.sensor
            )
        distributions = class_distributions(probabilities[kept], self.score_threshold)
        return without_duplicates(masks, scores[kept], distributions, self.classes, self.agnostic_nms_iou)


def class_distributions(probabilities: Float32, threshold: float) -> Float32:
    """Return the class distributions (N, Q + 1) over the queries and `something else`.

    Args:
        probabilities: The probability (N, Q) of each query.
        threshold: The probability of `something else`.
    """
    p = np.clip(probabilities.astype(np.float64), 1e-6, 1 - 1e-6)
    # proportional to the odds
    odds = np.hstack([p / (1 - p), np.full((len(p), 1), threshold / (1 - threshold))])
    return np.asarray(odds / odds.sum(axis=1, keepdims=True), np.float32)
