"""A box detector (YOLO, SSD) from an ONNX file; depth makes masks of its boxes."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from framework.config.validation import MOST_DETECTIONS, check_count, require
from framework.data import Bool, Detections, Frame
from framework.detection.candidates import OutputLayout, decode
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.masks.letterbox import Placement
from framework.detection.masks.masks_from_boxes import masks_in_boxes
from framework.detection.runtimes.image_network import ImageNetwork
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import read_labels, to_coco

log = logging.getLogger(__name__)

WHERE = "yolox_nano.onnx (3.7 MB, COCO, Apache-2.0) is at https://github.com/Megvii-BaseDetection/YOLOX/releases"


@dataclass
class OnnxBoxes(Detector):
    """Any box detector in an ONNX file: YOLO or SSD, by onnxruntime; its masks come from depth.

    The class distribution of a detection is its class scores, times the objectness, divided by their sum; its score is
    the largest of them before the division. A mask is what stands in front in the box and holds together there, see
    `framework.detection.masks.masks_from_boxes`; a box with too little depth for that is dropped, and counted in
    `boxes_without_depth`. The network is the user's; the defaults are those of Megvii's YOLOX.
    """

    weights: Path = field(metadata={"where": WHERE})  # ONNX file; relative: to the working, then project folder
    sha256: str = ""  # what the file must have; "" = whatever it is
    labels: str = "coco"  # the network's classes: a label space, or a text file with one name a line
    layout: OutputLayout = OutputLayout.yolox  # what the outputs are
    score_threshold: float = 0.1  # in (0, 1): low, for weak detections may still update instances that exist
    nms: float = 0.45  # IoU in (0, 1] above which a box falls to a better one of its class
    agnostic_nms: float = 0.6  # IoU in (0, 1] above which a mask falls to a better one of any class; 1 = off
    max_detections: int = 100  # >= 1, an image
    input_size: int = 0  # px, side of the input of a network that takes any; 0 = the network's own
    placement: Placement = Placement.top_left  # of the image in the input
    padding: int = 114  # in [0, 255], grey around the image
    bgr: bool = True  # channel order: True = BGR, False = RGB
    black_level: float = 0.0  # what the network gets for a channel of 0
    white_level: float = 255.0  # what it gets for 255: 1 where it takes 0..1
    min_foreground_fraction: float = (
        0.4  # share in [0, 1] of the box's readings, the centre's count most, for a foreground
    )
    max_slant: float = 85.0  # degrees in (0, 90) to the image plane: a steeper surface is a gap between two objects
    min_readings: float = 0.1  # share in [0, 1] of the box's pixels with depth; with fewer it is dropped
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where onnxruntime has it
    reads = ("color", "depth", "camera")

    def __post_init__(self) -> None:
        require(0 < self.score_threshold < 1, "detector.score_threshold", self.score_threshold, "in (0, 1)")
        require(0 < self.nms <= 1, "detector.nms", self.nms, "in (0, 1]")
        require(0 < self.agnostic_nms <= 1, "detector.agnostic_nms", self.agnostic_nms, "in (0, 1]")
        check_count("detector.max_detections", self.max_detections, MOST_DETECTIONS)
        require(
            0 <= self.min_foreground_fraction <= 1,
            "detector.min_foreground_fraction",
            self.min_foreground_fraction,
            "in [0, 1]",
        )
        require(0 < self.max_slant < 90, "detector.max_slant", self.max_slant, "in (0, 90) degrees")
        require(0 <= self.min_readings <= 1, "detector.min_readings", self.min_readings, "in [0, 1]")
        self._labels = read_labels(self.labels)
        self._meaning = to_coco(self._labels)
        self.classes = self._meaning.classes
        self.boxes_without_depth = 0  # since the detector was built
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
        decode(self.layout, self._network.try_out(), self._network.shape, len(self._labels))

    def detect(self, frame: Frame) -> Detections:
        outputs, letterbox = self._network(frame.color)
        candidates = decode(self.layout, outputs, self._network.shape, len(self._labels))
        best = candidates.best(self.score_threshold, self.nms, self.max_detections)
        class_probabilities, known = self._meaning.apply(candidates.class_scores[best])
        best, class_probabilities = best[known], class_probabilities[known]
        masks, found = masks_in_boxes(
            letterbox.to_image(candidates.boxes[best]),
            frame.depth,
            frame.camera,
            self.min_foreground_fraction,
            self.max_slant,
            self.min_readings,
        )
        self._count(frame, found)
        scores = candidates.class_scores[best].max(axis=1).clip(0, 1)
        return without_duplicates(masks, scores, class_probabilities, self.classes, self.agnostic_nms)

    def _count(self, frame: Frame, found: Bool) -> None:
        """Says aloud what is dropped: the first time as a warning, then in the debug log."""
        missing = int((~found).sum())
        if not missing:
            return
        level = logging.DEBUG if self.boxes_without_depth else logging.WARNING
        self.boxes_without_depth += missing
        log.log(
            level,
            "frame %d: %d of %d boxes have too little depth for a mask and are dropped, %d so far",
            frame.index,
            missing,
            len(found),
            self.boxes_without_depth,
        )
