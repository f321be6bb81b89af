"""Instance segmentation networks in ONNX files, such as the YOLO family, RF-DETR, torchvision and Detectron2."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from framework.config.validation import MAX_DETECTIONS, check_count, check_intervals, require
from framework.data import Detections, Frame
from framework.detection.calibration_files import calibration_of
from framework.detection.candidates import spread_rest
from framework.detection.instance_output import InstanceLayout, recognize_instances
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.masks.letterbox import ImageFormatChoice, Placement
from framework.detection.runtimes.onnx_network import ImageNetwork
from framework.detection.segmentation_output import BoxKind, SegmentationLayout, detect_layout
from framework.interfaces import Detector
from framework.vocabulary.category_ids import CategoryIds
from framework.vocabulary.label_spaces import ClassNames, read_labels, to_class_names

log = logging.getLogger(__name__)


@dataclass
class OnnxSegmentation(Detector):
    """Instance segmentation networks as their authors export them; needs the extra `onnx`.

    A YOLO network has K candidates with a box, C class scores and M mask coefficients each. Its outputs have the shapes
    (1, 4 + C + M, K), or transposed, and (1, M, h, w) or (1, h, w, M). If the network includes non-maximum suppression,
    the first output is (1, K, 6 + M) with x1, y1, x2, y2, score and label. Boxes are in px of the input or in [0, 1].
    Other networks, such as those of RF-DETR, torchvision and MMDeploy, have separate outputs for boxes, classes and
    masks. The layout is detected automatically; see `framework.detection.segmentation_output` and
    `framework.detection.instance_output`. The detector raises an error if the layout is ambiguous.

    The class distribution of a detection is its normalized class scores, and its score is the largest class score. If
    the network reports only one class, the other classes share `class_spread` * (1 - score) equally. Uncertain
    detections then contribute less to the map. The defaults are for exports of Ultralytics. The code and weights of
    Ultralytics (AGPL) are not part of this project.
    """

    weights: Path  # ONNX file, relative to the working or project folder
    sha256: str = ""  # expected SHA-256 of the file; "" = not checked
    # class names: a label space such as coco, or a text file with one name per line (n/a = unused index)
    label_space: str = "coco"
    # class names: COCO, OWN (those of the label space) or AUTO (COCO for names of known label spaces, otherwise OWN)
    class_names: ClassNames = ClassNames.AUTO
    # numbering of the classes in the outputs: AUTO (that of published networks), COCO_91 (1 to 90, with gaps), FROM_ONE
    # or FROM_ZERO
    category_ids: CategoryIds = CategoryIds.AUTO
    objectness: bool = False  # True = an objectness score precedes the class scores in the outputs, as in YOLOv5
    box_format: BoxKind = BoxKind.AUTO  # box format: CENTER, CORNER or AUTO (detected)
    # fraction of (1 - score) distributed over the other classes, for networks that report one class, in [0, 1]; 0 =
    # certain label
    class_spread: float = 1.0
    # minimum score of a detection, in (0, 1); low, because low-score detections can update existing instances
    score_threshold: float = 0.1
    nms_iou: float = 0.45  # box IoU threshold of non-maximum suppression within a class, in (0, 1]
    agnostic_nms_iou: float = 0.6  # mask IoU threshold of non-maximum suppression across classes, in (0, 1]; 1 = off
    max_detections: int = 100  # maximum number of detections per image, >= 1
    mask_threshold: float = 0.5  # minimum mask probability of a pixel in the mask, in (0, 1)
    # image format: AUTO (that of a recognized network, otherwise CUSTOM) or CUSTOM
    # (placement, padding, bgr, black_level and white_level)
    preprocessing: ImageFormatChoice = ImageFormatChoice.AUTO
    input_size: int = 0  # side of the square input, px, for networks with variable input size; 0 = size in the file
    placement: Placement = Placement.center  # position of the image in the input
    padding: int = 114  # gray value of the padding, in [0, 255]
    bgr: bool = False  # channel order: True = BGR, False = RGB
    black_level: float = 0.0  # network input for a channel value of 0
    white_level: float = 1.0  # network input for a channel value of 255; 255 for networks with inputs in [0, 255]
    device: str = "auto"  # device of the network: auto, cpu or cuda; auto = cuda if onnxruntime supports it
    reads = ("color",)

    def __post_init__(self) -> None:
        check_intervals("detector", self, score_threshold="(0, 1)", nms_iou="(0, 1]", agnostic_nms_iou="(0, 1]")
        check_intervals("detector", self, class_spread="[0, 1]", mask_threshold="(0, 1)")
        check_count("detector.max_detections", self.max_detections, MAX_DETECTIONS)
        self._labels = read_labels(self.label_space)
        self._meaning = to_class_names(self._labels, self.class_names)
        self.classes = self._meaning.classes
        self.calibration = calibration_of(self.weights)
        self._network = ImageNetwork(self)
        self._layout = self._detect_layout()
        self._log_classes()

    def detect(self, frame: Frame) -> Detections:
        outputs, letterbox = self._network(frame.color)
        output = self._layout.read(outputs)
        candidates = output.candidates
        best = candidates.best(self.score_threshold, self.nms_iou, self.max_detections)
        class_probabilities, known = self._meaning.apply(candidates.class_scores[best])
        best, class_probabilities = best[known], class_probabilities[known]
        scores = candidates.class_scores[best].max(axis=1).clip(0, 1)
        if self._layout.suppressed:
            class_probabilities = spread_rest(class_probabilities, scores, self.class_spread)
        borders = letterbox.to_image(candidates.boxes[best])
        masks = output.masks(best, borders, letterbox, frame.camera.shape, self.mask_threshold)
        return without_duplicates(masks, scores, class_probabilities, self.classes, self.agnostic_nms_iou)

    def _detect_layout(self) -> SegmentationLayout | InstanceLayout:
        """Detect the layout of the network, and set the image format of a recognized network."""
        network = self._network
        outputs = network.outputs_for_black()
        instances = recognize_instances(
            outputs, network.integers, network.shape, self._labels, self.category_ids, self.box_format
        )
        if instances is not None:
            instances.require_masks(outputs)
            network.format = instances.image_format(self.preprocessing, network.format)
            instances.read(outputs)  # raises DataError for another layout
            return instances
        network.check_names(self._labels, self.label_space)
        require(
            self.category_ids in (CategoryIds.AUTO, CategoryIds.FROM_ZERO),
            "detector.category_ids", self.category_ids.name, "AUTO or FROM_ZERO for a network of the YOLO family",
        )  # fmt: skip
        return detect_layout(
            outputs,
            classes=len(self._labels),
            objectness=self.objectness,
            boxes=self.box_format,
            shape=network.shape,
            input_channels_last=network.channels_last,
            metadata=network.metadata,
        )

    def _log_classes(self) -> None:
        """Log if the network reports one class per detection."""
        if self._layout.suppressed:
            log.info(
                "detector.class_spread: %s reports one class per detection; the other classes share %g * (1 - score)",
                self.weights.name,
                self.class_spread,
            )
