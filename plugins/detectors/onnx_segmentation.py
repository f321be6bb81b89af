"""An instance segmentation network of the YOLO family from an ONNX file that the user brings."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from framework.config.validation import MOST_DETECTIONS, check_count, require
from framework.data import Detections, Frame
from framework.detection.candidates import spread_rest
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.masks.letterbox import Placement
from framework.detection.masks.prototype_masks import masks_from_prototypes
from framework.detection.runtimes.image_network import ImageNetwork
from framework.detection.segmentation_output import BoxKind, recognise
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import read_labels, to_coco

log = logging.getLogger(__name__)


@dataclass
class OnnxSegmentation(Detector):
    """YOLO-style instance segmentation from the user's file: boxes, class scores, mask coefficients, prototypes.

    The network has the outputs (1, 4 + C + M, K), or its transpose, and (1, M, h, w), or (1, h, w, M): K candidates,
    each a box, C class scores and M coefficients of the prototypes. Or suppression is part of it, as in exports with
    `nms=True` and of networks without duplicates: then the first is (1, K, 6 + M), with x1 y1 x2 y2, score and label.
    Boxes are in px of the input or in 0..1. Which of these a file is, its shapes and its answer to a black image show,
    see `framework.detection.segmentation_output`; what they do not show is refused. It runs in
    onnxruntime (the extra `onnx`).

    The class distribution of a detection is its class scores divided by their sum; its score is the largest of them
    before the division. With suppression inside, the scores of the other classes are lost: what the score lacks to 1
    is shared evenly among them, as `class_spread` says, and a map learns less from such a network about objects that
    could be this or that. The other defaults are those of exports by Ultralytics; neither their code nor their weights
    (AGPL) are part of this project.
    """

    weights: Path  # ONNX file; a relative path is tried from the working, then the project folder
    sha256: str = ""  # what the file must have; "" = whatever it is
    labels: str = "coco"  # the network's classes: a label space, or a text file with one name a line
    objectness: bool = False  # an objectness stands before the class scores, as in YOLOv5
    boxes: BoxKind = BoxKind.AUTO  # what the four numbers of a box are
    class_spread: float = 1.0  # in [0, 1]: with suppression inside, share of 1 - score that goes to the other classes
    score_threshold: float = 0.1  # in (0, 1): low, for weak detections may still update instances that exist
    nms: float = 0.45  # IoU in (0, 1] above which a box falls to a better one of its class
    agnostic_nms: float = 0.6  # IoU in (0, 1] above which a mask falls to a better one of any class; 1 = off
    max_detections: int = 100  # >= 1, an image
    mask_threshold: float = 0.5  # in (0, 1), probability above which a pixel is inside
    input_size: int = 0  # px, side of the input of a network that takes any; 0 = the network's own
    placement: Placement = Placement.center  # of the image in the input
    padding: int = 114  # in [0, 255], grey around the image
    bgr: bool = False  # channel order: True = BGR, False = RGB
    black_level: float = 0.0  # what the network gets for a channel of 0
    white_level: float = 1.0  # what it gets for 255
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where onnxruntime has it
    reads = ("color",)

    def __post_init__(self) -> None:
        require(0 <= self.class_spread <= 1, "detector.class_spread", self.class_spread, "in [0, 1]")
        require(0 < self.score_threshold < 1, "detector.score_threshold", self.score_threshold, "in (0, 1)")
        require(0 < self.nms <= 1, "detector.nms", self.nms, "in (0, 1]")
        require(0 < self.agnostic_nms <= 1, "detector.agnostic_nms", self.agnostic_nms, "in (0, 1]")
        check_count("detector.max_detections", self.max_detections, MOST_DETECTIONS)
        require(0 < self.mask_threshold < 1, "detector.mask_threshold", self.mask_threshold, "in (0, 1)")
        self._labels = read_labels(self.labels)
        self._meaning = to_coco(self._labels)
        self.classes = self._meaning.classes
        self._network = ImageNetwork(
            path=self.weights,
            sha256=self.sha256,
            device=self.device,
            input_size=self.input_size,
            placement=self.placement,
            padding=self.padding,
            bgr=self.bgr,
            black=self.black_level,
            white=self.white_level,
        )
        self._layout = recognise(
            self._network.try_out(),
            classes=len(self._labels),
            objectness=self.objectness,
            boxes=self.boxes,
            shape=self._network.shape,
            input_channels_last=self._network.channels_last,
            metadata=self._network.metadata,
        )
        self._tell_of_labels()

    def detect(self, frame: Frame) -> Detections:
        outputs, letterbox = self._network(frame.color)
        output = self._layout.read(outputs)
        candidates = output.candidates
        best = candidates.best(self.score_threshold, self.nms, self.max_detections)
        class_probabilities, known = self._meaning.apply(candidates.class_scores[best])
        best, class_probabilities = best[known], class_probabilities[known]
        scores = candidates.class_scores[best].max(axis=1).clip(0, 1)
        if self._layout.suppressed:
            class_probabilities = spread_rest(class_probabilities, scores, self.class_spread)
        masks = masks_from_prototypes(
            output.coefficients[best],
            output.prototypes,
            letterbox.to_image(candidates.boxes[best]),
            letterbox,
            frame.camera.shape,
            self.mask_threshold,
        )
        return without_duplicates(masks, scores, class_probabilities, self.classes, self.agnostic_nms)

    def _tell_of_labels(self) -> None:
        """What to know of a network's classes before its map is looked at."""
        if self._layout.suppressed:
            log.info(
                "%s reports one class per detection; the other classes get detector.class_spread=%g of the rest",
                self.weights.name,
                self.class_spread,
            )
        names = self._network.metadata.names
        different = [(k, a, b) for k, (a, b) in enumerate(zip(names, self._labels, strict=False)) if a != b]
        if different:
            number, theirs, ours = different[0]
            log.warning("%s names %d of its %d classes otherwise than detector.labels=%s: %d is %r there, %r here",
                        self.weights.name, len(different), len(names), self.labels, number, theirs, ours)  # fmt: skip
