"""Box detectors (YOLO, SSD, RF-DETR, Faster R-CNN) in ONNX files, with masks from depth."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from framework.config.validation import MAX_DETECTIONS, check_count, check_intervals
from framework.data import Bool, Detections, Frame
from framework.detection.candidates import (
    ROW_COLUMNS,
    Candidates,
    OutputLayout,
    decode,
    label_numbers,
)
from framework.detection.instance_output import recognize_instances
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.masks.letterbox import ImageFormatChoice, Placement, choose_format, warn_of_format
from framework.detection.masks.masks_from_boxes import masks_in_boxes
from framework.detection.runtimes.onnx_network import ImageNetwork, Outputs
from framework.detection.table_output import recognize_table
from framework.interfaces import Detector
from framework.vocabulary.category_ids import CategoryIds
from framework.vocabulary.label_spaces import ClassNames, read_labels, to_class_names

log = logging.getLogger(__name__)

SOURCE = "yolox_nano.onnx (3.7 MB, COCO, Apache-2.0) is at https://github.com/Megvii-BaseDetection/YOLOX/releases"


@dataclass
class OnnxBoxes(Detector):
    """Box detector in an ONNX file, with masks from depth; needs the extra `onnx`.

    Each class score of a detection is multiplied by its objectness. The class distribution consists of the normalized
    products, and the score of the detection is the largest product. The mask is the connected foreground in the box;
    see `framework.detection.masks.masks_from_boxes`. Boxes with too few depth readings are dropped and counted in
    `boxes_without_depth`. The defaults are for YOLOX, and for networks that are recognized from their outputs.
    """

    weights: Path = field(metadata={"source": SOURCE})  # ONNX file, relative to the working or project folder
    sha256: str = ""  # expected SHA-256 of the file; "" = not checked
    # class names: a label space such as coco, or a text file with one name per line (n/a = unused index)
    label_space: str = "coco"
    # class names: COCO, OWN (those of the label space) or AUTO (COCO for names of known label spaces, otherwise OWN)
    class_names: ClassNames = ClassNames.AUTO
    # numbering of the classes in label outputs: AUTO (that of published networks), COCO_91 (1 to 90, with gaps),
    # FROM_ONE or FROM_ZERO
    category_ids: CategoryIds = CategoryIds.AUTO
    layout: OutputLayout = OutputLayout.auto  # layout of the outputs
    # minimum score of a detection, in (0, 1); low, because low-score detections can update existing instances
    score_threshold: float = 0.1
    nms_iou: float = 0.45  # box IoU threshold of non-maximum suppression within a class, in (0, 1]
    agnostic_nms_iou: float = 0.6  # mask IoU threshold of non-maximum suppression across classes, in (0, 1]; 1 = off
    max_detections: int = 100  # maximum number of detections per image, >= 1
    # image format: AUTO (that of the network if recognized with layout=auto, otherwise CUSTOM) or CUSTOM (placement,
    # padding, bgr, black_level and white_level)
    preprocessing: ImageFormatChoice = ImageFormatChoice.AUTO
    input_size: int = 0  # side of the square input, px, for networks with variable input size; 0 = size in the file
    placement: Placement = Placement.top_left  # position of the image in the input
    padding: int = 114  # gray value of the padding, in [0, 255]
    bgr: bool = True  # channel order: True = BGR, False = RGB
    black_level: float = 0.0  # network input for a channel value of 0
    white_level: float = 255.0  # network input for a channel value of 255; 1 for networks with inputs in [0, 1]
    # minimum fraction of a box's depth readings in the foreground, weighted toward the box center, in [0, 1]
    min_foreground_fraction: float = 0.4
    # maximum angle between surface and image plane, degrees, in (0, 90); a steeper depth step is an object boundary
    max_slant: float = 85.0
    # minimum fraction of a box's pixels with depth, in [0, 1]; boxes below it are dropped and counted
    min_readings: float = 0.1
    device: str = "auto"  # device of the network: auto, cpu or cuda; auto = cuda if onnxruntime supports it
    reads = ("color", "depth", "camera", "sensor")

    def __post_init__(self) -> None:
        check_intervals("detector", self, score_threshold="(0, 1)", nms_iou="(0, 1]", agnostic_nms_iou="(0, 1]")
        check_intervals("detector", self, min_foreground_fraction="[0, 1]", max_slant="(0, 90)", min_readings="[0, 1]")
        check_count("detector.max_detections", self.max_detections, MAX_DETECTIONS)
        self._labels = read_labels(self.label_space)
        self._meaning = to_class_names(self._labels, self.class_names)
        self.classes = self._meaning.classes
        self.boxes_without_depth = 0  # number of boxes dropped since construction
        self._network = ImageNetwork(self)
        self._decode = self._decoder()

    def detect(self, frame: Frame) -> Detections:
        outputs, letterbox = self._network(frame.color)
        candidates = self._decode(outputs)
        best = candidates.best(self.score_threshold, self.nms_iou, self.max_detections)
        class_probabilities, known = self._meaning.apply(candidates.class_scores[best])
        best, class_probabilities = best[known], class_probabilities[known]
        masks, found = masks_in_boxes(
            letterbox.to_image(candidates.boxes[best]),
            frame.depth,
            frame.camera,
            self.min_foreground_fraction,
            self.max_slant,
            self.min_readings,
            frame.sensor,
        )
        if not found.all():
            self._report_dropped(frame, found)
        scores = candidates.class_scores[best].max(axis=1).clip(0, 1)
        return without_duplicates(masks, scores, class_probabilities, self.classes, self.agnostic_nms_iou)

    def _decoder(self) -> Callable[[Outputs], Candidates]:
        """Return the decoder of the outputs, and set the image format of a recognized network.

        Raises:
            DataError: The outputs do not have the layout.
            ConfigError: The numbering of the classes is ambiguous.
        """
        network = self._network
        outputs = network.outputs_for_black()
        layout = self.layout
        if layout is OutputLayout.auto:
            instances = recognize_instances(outputs, network.integers, network.shape, self._labels, self.category_ids)
            if instances is not None:
                network.format = instances.image_format(self.preprocessing, network.format)
                return instances.candidates_of_boxes
            layout, known = recognize_table(outputs, network.shape, len(self._labels))
            if known is None and layout in ROW_COLUMNS:
                warn_of_format(layout.value, self.preprocessing)
            network.format = choose_format(layout.value, known, self.preprocessing, network.format)
        network.check_names(self._labels, self.label_space)
        ids = label_numbers(layout, outputs, self._labels, self.category_ids)
        decoder = partial(decode, layout, shape=network.shape, classes=len(self._labels), ids=ids)
        decoder(outputs)
        return decoder

    def _report_dropped(self, frame: Frame, found: Bool) -> None:
        """Count and log dropped boxes."""
        missing = int((~found).sum())
        # only the first frame with dropped boxes is a warning
        level = logging.DEBUG if self.boxes_without_depth else logging.WARNING
        self.boxes_without_depth += missing
        log.log(
            level,
            "frame %d: %d of %d boxes dropped because of too few depth readings for a mask; %d dropped so far",
            frame.index,
            missing,
            len(found),
            self.boxes_without_depth,
        )
