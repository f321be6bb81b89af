"""Decoding of networks with separate outputs for boxes, classes and masks, as their authors export them.

Networks, and the outputs for K detections or queries and C class columns:

- RF-DETR (github.com/roboflow/rf-detr, `model.export()`): dets (1, K, 4) center x, center y, width, height in 0..1;
  labels (1, K, C) logits; masks (1, K, h, w) logits over the complete input. Other DETR exports call them pred_boxes,
  logits and pred_masks.
- torchvision (`torch.onnx.export` of Faster R-CNN, Mask R-CNN): boxes (K, 4) x1 y1 x2 y2 in px; labels (K,);
  scores (K,); masks (K, 1, h, w), in the boxes or over the complete input.
- Detectron2 (`TracingAdapter`, docs/tutorials/deployment.md): pred_boxes (K, 4) x1 y1 x2 y2 in px; pred_classes (K,);
  pred_masks (K, 1, h, w) in the boxes; scores (K,); image_size (2,). The names depend on the version of the exporter.
- DETR (github.com/facebookresearch/detr), also exported by transformers: softmax over the classes and "no object", the
  last column. RF-DETR and Deformable DETR have independent sigmoids.
- Other conventions are converted by `framework.detection.output_conventions`.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from framework.data import Bool, Float32, Int32
from framework.detection.candidates import (
    CONFIDENT,
    LARGEST_UNIT,
    YOLO_FORMAT,
    Candidates,
    check_scores,
    class_scores_of_labels,
    corners,
    described,
    ends_with_background,
    spread_evenly,
)
from framework.detection.masks.binary_masks import masks_from_grids, paste_masks
from framework.detection.masks.letterbox import (
    ImageFormat,
    ImageFormatChoice,
    Letterbox,
    Placement,
    choose_format,
    warn_of_format,
)
from framework.detection.output_conventions import TENSORFLOW_NAMES, YOLO_NAMES, base_name, standard_outputs
from framework.detection.runtimes.onnx_network import Outputs
from framework.detection.segmentation_output import BoxKind, MaskOutput
from framework.errors import DataError
from framework.vocabulary.category_ids import CategoryIds, column_ids, label_ids

LARGEST_GRID = 56  # cells, maximum side of a mask in a box; published networks have 14 to 56
DOWNSAMPLING = (1, 2, 4, 8)  # px of the input per cell of a mask over the complete input
DETR_BOXES, DETR_LOGITS = ("dets", "pred_boxes"), ("logits", "pred_logits")  # names of outputs

log = logging.getLogger(__name__)


class NetworkAuthor(Enum):
    """Author of a network, which determines its conventions."""

    DETR = "RF-DETR or another DETR"
    TORCHVISION = "torchvision"
    DETECTRON2 = "Detectron2"
    TENSORFLOW = "TensorFlow's object detection API"
    YOLO = "YOLO with suppression"
    MMDEPLOY = "MMDeploy"
    UNKNOWN = "an unknown network"


IMAGENET_BLACK = (-0.485 / 0.229, -0.456 / 0.224, -0.406 / 0.225)  # RGB, (0 - mean) / standard deviation
IMAGENET_WHITE = (0.515 / 0.229, 0.544 / 0.224, 0.594 / 0.225)  # RGB, (1 - mean) / standard deviation
FORMATS: Mapping[NetworkAuthor, ImageFormat] = {
    NetworkAuthor.DETR: ImageFormat(Placement.stretch, bgr=False, black=IMAGENET_BLACK, white=IMAGENET_WHITE),
    NetworkAuthor.TORCHVISION: ImageFormat(Placement.top_left, bgr=False, black=0.0, white=1.0),
    NetworkAuthor.DETECTRON2: ImageFormat(Placement.top_left, bgr=True, black=0.0, white=255.0),
    NetworkAuthor.TENSORFLOW: ImageFormat(Placement.stretch, bgr=False, black=0.0, white=255.0),
    NetworkAuthor.YOLO: YOLO_FORMAT,
}
"""Image formats of published networks. All but DETR and YOLO normalize the image themselves."""
PUBLISHED_IDS: Mapping[NetworkAuthor, CategoryIds] = {
    NetworkAuthor.TORCHVISION: CategoryIds.COCO_91,
    NetworkAuthor.DETECTRON2: CategoryIds.FROM_ZERO,
    NetworkAuthor.TENSORFLOW: CategoryIds.COCO_91,
    NetworkAuthor.YOLO: CategoryIds.FROM_ZERO,
    NetworkAuthor.MMDEPLOY: CategoryIds.FROM_ZERO,
}
"""Numbering of the labels of published networks."""


@dataclass(frozen=True)
class OutputNames:
    """The outputs of a network by meaning."""

    network: NetworkAuthor
    boxes: str  # (K, 4)
    classes: str  # (K,) labels, or (K, C) class columns
    scores: str = ""  # (K,); "" = class columns
    masks: str = ""  # "" = boxes only


@dataclass(frozen=True)
class InstanceOutput(MaskOutput):
    """K candidates, with one mask each."""

    candidates: Candidates
    grids: Float32  # (K, h, w) probabilities or logits
    in_boxes: bool  # True = each grid covers its box, False = each grid covers the input

    def masks(
        self, chosen: Int32, borders: Float32, letterbox: Letterbox, shape: tuple[int, int], threshold: float
    ) -> Bool:
        grids = self.grids[chosen]
        if _are_logits(self.grids):
            grids = _sigmoid(grids)
        if self.in_boxes:
            return paste_masks(grids, borders, shape, threshold)
        complete = np.tile(np.array([-0.5, -0.5, shape[1] - 0.5, shape[0] - 0.5], np.float32), (len(chosen), 1))
        return masks_from_grids(grids, complete, letterbox, shape, threshold)


@dataclass(frozen=True)
class InstanceLayout:
    """Layout of the outputs of a network."""

    names: OutputNames
    shape: tuple[int, int]  # (height, width) px of the network's input
    ids: Sequence[int]  # label or class column of each class
    boxes: BoxKind  # CENTER or CORNER
    unit: bool | None  # True = boxes are in 0..1 of the input's sides, False = in px; None = undetermined
    columns: int  # C, number of class columns; 0 = labels
    no_object: bool = False  # True = the last column is "no object", and the columns are a softmax
    byte_masks: bool = False  # True = masks are integers, 0 to 1 or 0 to 255

    @property
    def suppressed(self) -> bool:
        """True if the network reports one class per detection."""
        return not self.columns

    def require_masks(self, outputs: Outputs) -> None:
        """Raise DataError if the network has no masks."""
        if not self.names.masks:
            raise DataError(
                f"detector.weights: expected masks, got a network with boxes only ({described(outputs)}); set "
                "detector=onnx_boxes"
            )

    def image_format(self, preprocessing: ImageFormatChoice, custom: ImageFormat) -> ImageFormat:
        """Return the image format of the network, and log it if it is not the custom format."""
        network = self.names.network
        if network in (NetworkAuthor.MMDEPLOY, NetworkAuthor.UNKNOWN):
            warn_of_format(network.value, preprocessing)
        return choose_format(network.value, FORMATS.get(network), preprocessing, custom)

    def candidates(self, outputs: Outputs) -> Candidates:
        """Decode the boxes and classes of a network.

        Raises:
            DataError: The outputs do not have this layout.
        """
        arrays = _unbatched(outputs)
        boxes, classes = arrays[self.names.boxes], arrays[self.names.classes]
        if self.columns:
            if classes.shape != (len(boxes), self.columns):
                raise DataError(f"detector.weights: expected {self.columns} class columns, got {described(outputs)}")
            if _are_logits(classes):
                classes = _softmax(classes) if self.no_object else _sigmoid(classes)
            class_scores = classes[:, self.ids]
        else:
            class_scores = class_scores_of_labels(arrays[self.names.scores], classes, self.ids)
        check_scores(class_scores, "detector.weights", fix="")
        if self.boxes is BoxKind.CENTER:
            boxes = corners(boxes)
        elif len(unordered := boxes[self._confident_and_unordered(boxes, class_scores)]):
            raise DataError(
                f"detector.weights: expected corners x1 y1 x2 y2 in confident detections, got {unordered[0].tolist()}; "
                "set detector.box_format=CENTER with detector=onnx_segmentation, or export with corners"
            )
        if _in_unit(boxes) if self.unit is None else self.unit:
            boxes = boxes * np.array([self.shape[1], self.shape[0]] * 2, np.float32)
        return Candidates(boxes, class_scores)

    @staticmethod
    def _confident_and_unordered(boxes: Float32, class_scores: Float32) -> Bool:
        confident = class_scores.max(axis=1, initial=0.0) >= CONFIDENT
        return np.asarray(confident & (boxes[:, 2:] < boxes[:, :2]).any(axis=1), np.bool_)

    def candidates_of_boxes(self, outputs: Outputs) -> Candidates:
        """Decode the boxes of a network, and distribute the remainder of the score of labels over the other classes."""
        found = self.candidates(outputs)
        return found if self.columns else Candidates(found.boxes, spread_evenly(found.class_scores))

    def read(self, outputs: Outputs) -> InstanceOutput:
        """Decode the outputs of a network with masks.

        Raises:
            DataError: The outputs do not have this layout.
        """
        candidates = self.candidates(outputs)
        grids = _unbatched(outputs)[self.names.masks]
        if self.byte_masks and grids.max(initial=0) > 1:
            grids = grids / np.float32(255)
        side, other = grids.shape[1:]
        covers = any((side * k, other * k) == self.shape for k in DOWNSAMPLING) and max(side, other) > LARGEST_GRID
        whole = bool(self.columns) or covers
        if not whole and side != other:
            raise DataError(
                f"detector.weights: expected square masks in boxes, or masks over the input of {self.shape[1]}x"
                f"{self.shape[0]} px, got {described(outputs)}; export for a fixed input size"
            )
        return InstanceOutput(candidates, grids, in_boxes=not whole)


def recognize_instances(
    outputs: Outputs,
    integers: Collection[str],
    shape: tuple[int, int],
    labels: Sequence[str],
    category_ids: CategoryIds,
    boxes: BoxKind = BoxKind.AUTO,
) -> InstanceLayout | None:
    """Recognize a network from its outputs for a black image.

    Args:
        outputs: The outputs by name.
        integers: The names of the integer outputs.
        shape: The size of the input (height, width), px.
        labels: The class names.
        category_ids: The numbering of the labels or class columns.
        boxes: The meaning of the box numbers; AUTO = detected.

    Returns:
        The layout, or None if the outputs are not boxes, classes and optionally masks.

    Raises:
        ConfigError: The numbering of the classes is ambiguous.
        DataError: The network has another number of classes.
    """
    names = _recognize_names(outputs, integers)
    if names is None:
        return None
    found = _unbatched(outputs)[names.boxes]
    in_unit = _in_unit(found)
    if not names.scores:
        if in_unit is False:
            raise DataError(
                f"detector.weights: expected boxes in 0..1 next to class columns, got {found.max():.3g} in "
                f"{names.boxes}; export without postprocessing"
            )
        columns = outputs[names.classes].shape[-1]
        no_object = ends_with_background(_unbatched(outputs)[names.classes])
        ids = column_ids(category_ids, labels, columns - no_object)
        kind = BoxKind.CENTER if boxes is BoxKind.AUTO else boxes
        return InstanceLayout(names, shape, ids, kind, True, columns, no_object)
    if names.network is NetworkAuthor.TORCHVISION and in_unit and not names.masks:
        names = replace(names, network=NetworkAuthor.UNKNOWN)  # another SSD with the same names
    ids = label_ids(category_ids, labels, PUBLISHED_IDS.get(names.network))
    detected = BoxKind.CENTER if in_unit and (found[:, 2:] < found[:, :2]).any() else BoxKind.CORNER
    return InstanceLayout(
        names, shape, ids, detected if boxes is BoxKind.AUTO else boxes, in_unit, 0, byte_masks=names.masks in integers
    )


def _recognize_names(outputs: Outputs, integers: Collection[str]) -> OutputNames | None:
    """Return the outputs by meaning, from their shapes, types and names."""
    arrays = _unbatched(outputs)
    whole_numbers = [name for name, array in arrays.items() if array.ndim == 1 and name in integers]
    pairs = [name for name in whole_numbers if arrays[name].shape == (2,)] if len(whole_numbers) == 2 else []
    sizes = ([name for name in pairs if "size" in name] or pairs)[-1:]
    vectors = [name for name, array in arrays.items() if array.ndim == 1 and name not in sizes]
    tables = [name for name, array in arrays.items() if array.ndim == 2]
    boxes = [name for name in tables if arrays[name].shape[1] == 4 and not _means_classes(name)]
    columns = [name for name in tables if name not in boxes]
    masks = [name for name, array in arrays.items() if array.ndim == 3]
    known = len(boxes) + len(columns) + len(vectors) + len(masks) + len(sizes)
    if len(boxes) != 1 or len(masks) > 1 or len(arrays) != known:
        return None
    if masks and len(arrays[masks[0]]) != len(arrays[boxes[0]]):
        return None
    mask = masks[0] if masks else ""
    if len(columns) == 1 and not vectors:
        logits = arrays[columns[0]]
        is_named = base_name(boxes[0]) in DETR_BOXES or base_name(columns[0]) in DETR_LOGITS
        is_detr = len(logits) == len(arrays[boxes[0]]) and (_are_logits(logits) or is_named)
        return OutputNames(NetworkAuthor.DETR, boxes[0], columns[0], masks=mask) if is_detr else None
    classes = [name for name in vectors if name in integers] or [name for name in vectors if _means_classes(name)]
    if columns or len(vectors) != 2 or len(classes) != 1:
        return None
    (scores,) = set(vectors) - set(classes)
    names = {base_name(name) for name in outputs}
    network = NetworkAuthor.UNKNOWN
    if names >= TENSORFLOW_NAMES:
        # in networks of TensorRT with these names, classes are integers, and boxes may begin with x
        network = NetworkAuthor.UNKNOWN if classes[0] in integers else NetworkAuthor.TENSORFLOW
    elif names >= YOLO_NAMES:
        network = NetworkAuthor.YOLO
    elif any(array.shape[-1] == 5 for name, array in outputs.items() if base_name(name) == "dets"):
        network = NetworkAuthor.MMDEPLOY
    elif sizes or (names >= {"pred_boxes", "pred_classes", "scores"} and outputs[boxes[0]].ndim == 2):
        network = NetworkAuthor.DETECTRON2
    elif names >= {"boxes", "labels", "scores"} and len(outputs) == len(arrays) and outputs[boxes[0]].ndim == 2:
        network = NetworkAuthor.TORCHVISION  # others, such as RT-DETR, have a batch, or a number of detections
    return OutputNames(network, boxes[0], classes[0], scores, mask)


def _unbatched(outputs: Outputs) -> Outputs:
    """Return standard outputs with the detections as the first axis, and masks as (K, h, w)."""
    outputs = standard_outputs(outputs)
    batched = any(array.ndim == 3 and array.shape[::2] == (1, 4) for array in outputs.values())
    arrays = {name: array[0] if batched and array.ndim > 1 else array for name, array in outputs.items()}
    return {name: array[:, 0] if array.ndim == 4 and array.shape[1] == 1 else array for name, array in arrays.items()}


def _means_classes(name: str) -> bool:
    return any(word in name.lower() for word in ("label", "class", "logit"))


def _are_logits(values: Float32) -> bool:
    """Return True if values are logits, False if they are probabilities."""
    return bool(values.size and (values.min() < 0 or values.max() > 1))


def _sigmoid(logits: Float32) -> Float32:
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -80, 80))), np.float32)


def _softmax(logits: Float32) -> Float32:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)


def _in_unit(boxes: Float32) -> bool | None:
    """Return True if boxes (K, 4) are in 0..1, False if they are in px, and None without boxes or with padding only."""
    largest = float(np.abs(boxes).max(initial=0.0))
    return largest <= LARGEST_UNIT if largest > 0 else None
