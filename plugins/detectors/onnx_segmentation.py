"""An instance segmentation network of the YOLO family from an ONNX file that the user brings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from framework.data import Detections, Float32, Frame
from framework.detection.candidates import Candidates, decode_yolo, described, rows_of
from framework.detection.image_network import ImageNetwork
from framework.detection.letterbox import Placement
from framework.detection.masks import without_duplicates
from framework.detection.onnx_network import Outputs
from framework.detection.prototype_masks import masks_from_prototypes
from framework.errors import DataError
from framework.interfaces import Detector
from framework.label_spaces import read_labels, to_coco
from framework.parameters import require


@dataclass
class OnnxSegmentation(Detector):
    """YOLO-style instance segmentation from the user's ONNX file: boxes, class scores, mask coefficients, prototypes.

    The network has the outputs (1, 4 + C + M, K), or its transpose, and (1, M, h, w): K candidates, each a box (centre
    x, y, width, height, px), C class scores and M coefficients of the prototypes; its own suppression must not be part
    of it. The class distribution of a detection is its class scores divided by their sum; its score is the largest of
    them before the division. The defaults are those of exports by Ultralytics; neither their code nor their weights
    (AGPL) are part of this project.
    """

    weights: Path  # ONNX file; a relative path is tried from the working, then the project folder
    sha256: str = ""  # what the file must have; "" = whatever it is
    labels: str = "coco"  # the network's classes: a label space, or a text file with one name a line
    objectness: bool = False  # an objectness stands before the class scores, as in YOLOv5
    score_threshold: float = 0.1  # in (0, 1): low, for weak detections may still update instances that exist
    nms: float = 0.45  # IoU in (0, 1] above which a box falls to a better one of its class
    agnostic_nms: float = 0.6  # IoU in (0, 1] above which a mask falls to a better one of any class; 1 = off
    max_detections: int = 100  # >= 1, an image
    mask_threshold: float = 0.5  # in (0, 1), probability above which a pixel is inside
    input_size: int = 0  # px, side of the input of a network that takes any; 0 = the network's own
    placement: Placement = Placement.center  # of the image in the input
    padding: int = 114  # in [0, 255], grey around the image
    bgr: bool = False  # channel order: True = BGR, False = RGB
    black: float = 0.0  # what the network gets for a channel of 0
    white: float = 1.0  # what it gets for 255
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where onnxruntime has it
    reads = ("color",)

    def __post_init__(self) -> None:
        require(0 < self.score_threshold < 1, "detector.score_threshold", self.score_threshold, "in (0, 1)")
        require(0 < self.nms <= 1, "detector.nms", self.nms, "in (0, 1]")
        require(0 < self.agnostic_nms <= 1, "detector.agnostic_nms", self.agnostic_nms, "in (0, 1]")
        require(self.max_detections >= 1, "detector.max_detections", self.max_detections, "at least 1")
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
            black=self.black,
            white=self.white,
        )
        self._decode(self._network.try_out())

    def detect(self, frame: Frame) -> Detections:
        outputs, letterbox = self._network(frame.color)
        candidates, coefficients, prototypes = self._decode(outputs)
        best = candidates.best(self.score_threshold, self.nms, self.max_detections)
        class_probabilities, known = self._meaning.apply(candidates.class_scores[best])
        best, class_probabilities = best[known], class_probabilities[known]
        masks = masks_from_prototypes(
            coefficients[best],
            prototypes,
            letterbox.to_image(candidates.boxes[best]),
            letterbox,
            frame.camera.shape,
            self.mask_threshold,
        )
        scores = candidates.class_scores[best].max(axis=1).clip(0, 1)
        return without_duplicates(masks, scores, class_probabilities, self.classes, self.agnostic_nms)

    def _decode(self, outputs: Outputs) -> tuple[Candidates, Float32, Float32]:
        """The K candidates, their coefficients (K, M), and the prototypes (M, h, w)."""
        tables = [output for output in outputs.values() if output.ndim == 3]
        maps = [output for output in outputs.values() if output.ndim == 4]
        if len(outputs) != 2 or len(tables) != 1 or len(maps) != 1 or maps[0].shape[0] != 1:
            raise DataError(
                "a segmentation network must have the outputs (1, 4 + classes + M, K) and (1, M, h, w),"
                f" found {described(outputs)}"
            )
        prototypes = maps[0][0]
        first = (5 if self.objectness else 4) + len(self._labels)  # of the coefficients
        rows = rows_of(tables[0], first + len(prototypes))
        return decode_yolo(rows[:, :first], self.objectness), rows[:, first:], prototypes
