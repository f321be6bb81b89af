"""Mask R-CNN 2Go with COCO weights, for video on a laptop CPU."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.config.validation import (
    LONGEST_SIDE,
    MAX_DETECTIONS,
    MAX_PROPOSALS,
    check_count,
    check_intervals,
    require,
)
from framework.data import Detections, Float32, Frame, Int32
from framework.detection.calibration_files import calibration_of
from framework.detection.mask_rcnn.network import propose, select
from framework.detection.mask_rcnn.roi_align import roi_align
from framework.detection.masks.binary_masks import paste_masks, without_duplicates
from framework.detection.masks.boxes import anchor_grid, to_original_image
from framework.detection.runtimes.caffe2_network import (
    Operator,
    dequantized_weights,
    has_int8_kernels,
    network_between,
)
from framework.detection.runtimes.device import one_torch_thread, torch_device
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import DataError, errors_of
from framework.files.atomic_write import read_bytes
from framework.files.search_paths import candidates
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import COCO

LARGEST_FILE = 2**26  # maximum file size, bytes; the published files have at most 3 MB
SHA256 = {
    "graph.json": "e2b06acc9c26fdd62292100ea2a5495f9fd1bd3607276916bdb8440562f401ef",
    "maskrcnn2go_coco_int8.npz": "a79197eba054bdf4e4b1136a3dffbfea951f442682464357d91b2a1abd0d21c9",
}
STRIDE = 16  # side of a cell of the feature map, px of the resized image
BINS = 6  # number of bins of RoIAlign per side
PRE_NMS_PROPOSALS = 3000  # number of anchors that are decoded, best first, as in the graph
EXTENT = 1.0  # box convention: x2 is the last pixel inside, so that the width is x2 - x1 + 1 px

log = logging.getLogger(__name__)


@dataclass
class MaskRCNN2Go(Detector):
    """Mask R-CNN 2Go (Facebook, Apache-2.0), for the classes of COCO, on the CPU or with CUDA.

    The published mask AP on COCO 2014 minival is 20.9. On x86 CPUs with VNNI (since about 2020), the network computes
    with 8-bit integers, in one thread per frame. On other devices, it computes in floating point with the same weights.

    The class distribution of a detection is the softmax over the class scores of 80 classes, renormalized without the
    background. The score of a detection is the probability of its class before this normalization. Non-maximum
    suppression across classes removes duplicates of ambiguous objects.
    """

    # folder of the network, absolute or relative to the working directory or the project folder
    weights: Path = Path("plugins/detectors/maskrcnn2go_int8")
    # minimum score of a detection, in [0, 1); low, because low-score detections can update existing instances
    score_threshold: float = 0.1
    nms_iou: float = 0.3  # box IoU threshold of non-maximum suppression within a class, in (0, 1]
    agnostic_nms_iou: float = 0.6  # mask IoU threshold of non-maximum suppression across classes, in (0, 1]; 1 = off
    # maximum number of region proposals for the box head, >= 1; the network was trained with 100 to 120
    proposals: int = 120
    max_detections: int = 100  # maximum number of detections per image, >= 1
    short_side: int = 320  # short side of the resized image, px, >= 32; the network was trained with 320
    long_side: int = 640  # maximum long side of the resized image, px, >= short_side
    mask_threshold: float = 0.5  # minimum mask probability of a pixel in the mask, in (0, 1)
    # True = 8-bit integer arithmetic on CPUs with VNNI, three times as fast per core; False = floating-point arithmetic
    int8: bool = True
    device: str = "auto"  # device of the network: auto, cpu or cuda; auto = cuda if available

    reads = ("color",)

    def __post_init__(self) -> None:
        check_intervals("detector", self, score_threshold="[0, 1)", mask_threshold="(0, 1)")
        check_intervals("detector", self, nms_iou="(0, 1]", agnostic_nms_iou="(0, 1]")
        check_count("detector.proposals", self.proposals, MAX_PROPOSALS)
        check_count("detector.max_detections", self.max_detections, MAX_DETECTIONS)
        require(self.short_side >= 32, "detector.short_side", self.short_side, "at least 32 px")
        allowed = f"a value in [{self.short_side}, {LONGEST_SIDE}] px"
        require(self.short_side <= self.long_side <= LONGEST_SIDE, "detector.long_side", self.long_side, allowed)
        self._device = torch_device(self.device)
        self.classes = COCO
        self.calibration = calibration_of(self.weights)
        graph, tensors, spacings = _read_network(_find_weights(self.weights))
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        self._anchors: Float32 = tensors.pop("anchor").cpu().numpy()
        stem = next(operator for operator in graph if operator["type"] == "Int8ConvRelu")["inputs"][1]
        tensors[stem] = tensors[stem].flip(1)  # trained on BGR; frames are RGB
        wants_integers = self.int8 and self._device.type == "cpu"
        self._integers = self.concurrent = wants_integers and has_int8_kernels()
        if wants_integers and not self._integers:
            log.info(
                "detector.int8: expected a CPU with VNNI for exact 8-bit convolutions, got none; running the "
                "network in float32"
            )
        steps = spacings if self._integers else None
        outputs = ("xif3_6_int8", "rpn_cls_logits_int8", "rpn_bbox_pred_int8")
        boxes = ("cls_score_int8", "bbox_pred_int8")
        self._backbone = network_between(graph, tensors, ("data_NHWC",), outputs, steps)
        self._box_head = network_between(graph, tensors, ("roi_features",), boxes, steps)
        # always in float: integers save 5 ms, but rounding moves mask borders and costs 0.03 of AP50
        self._mask_head = network_between(graph, tensors, ("_[mask]_pool5",), ("conv5_mask_v1_int8",))
        self._mask_logits = tensors["mask_fcn_logits_w_int8"][:, :, 0, 0], tensors["mask_fcn_logits_b_int8"]
        self._mask_upsampling = tensors["mask_fcn_logits_up_w_int8"], tensors["mask_fcn_logits_up_b_int8"]

    def fingerprint(self) -> str:
        """Return a hash that includes the arithmetic."""
        # integer and floating-point results differ slightly
        return f"{fingerprint(self)} {'int8' if self._integers else 'float32'}"

    @torch.inference_mode()
    def detect(self, frame: Frame) -> Detections:
        # other threads build the map or process other frames
        with one_torch_thread() if self._integers else nullcontext():
            return self._detect(frame)

    def _detect(self, frame: Frame) -> Detections:
        image = self._resize(frame)
        shape = (image.shape[2], image.shape[3])
        features, objectness, deltas = self._backbone(image)
        anchors = anchor_grid(self._anchors, objectness.shape[2], objectness.shape[3], STRIDE)
        scores = objectness.permute(0, 2, 3, 1).reshape(-1).cpu().numpy()  # logits: a sigmoid would keep the order
        anchor_deltas = deltas.permute(0, 2, 3, 1).reshape(-1, 4).cpu().numpy()
        proposals = propose([anchors], scores, anchor_deltas, shape, PRE_NMS_PROPOSALS, self.proposals, EXTENT)
        logits, deltas = self._box_head(self._pool(features, proposals))
        probabilities = torch.softmax(logits, dim=1).cpu().numpy()
        own_deltas = deltas.cpu().numpy().reshape(*probabilities.shape, 4)
        limits = self.score_threshold, self.nms_iou, self.max_detections
        boxes, proposal, label = select(proposals, probabilities, own_deltas, shape, *limits, EXTENT)
        if len(boxes) == 0:
            return Detections.none(frame.camera.shape, self.classes)

        grids = self._mask_grids(self._pool(features, boxes), label)
        masks = paste_masks(
            grids, to_original_image(boxes, shape, frame.camera.shape), frame.camera.shape, self.mask_threshold
        )
        objects = probabilities[proposal, 1:]
        shares = objects / objects.sum(axis=1, keepdims=True)
        return without_duplicates(masks, probabilities[proposal, label], shares, self.classes, self.agnostic_nms_iou)

    def _resize(self, frame: Frame) -> Tensor:
        """Return the resized image (1, 3, H, W), RGB, in [0, 255]."""
        height, width = frame.camera.shape
        scale = min(self.short_side / min(height, width), self.long_side / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        resized = cv2.resize(frame.color, size, interpolation=cv2.INTER_LINEAR)
        return torch.from_numpy(resized).to(self._device).permute(2, 0, 1)[None].float()

    def _pool(self, features: Tensor, boxes: Float32) -> Tensor:
        return roi_align(features, torch.from_numpy(boxes).to(self._device), BINS, 1 / STRIDE)

    def _mask_grids(self, pooled: Tensor, label: Int32) -> Float32:
        """Return the mask probabilities (N, 24, 24) on a grid over each box.

        `label` (N,) is the class of each box, from 1.
        """
        (features,) = self._mask_head(pooled)
        own = torch.from_numpy(label).long().to(self._device)
        weight, bias = self._mask_logits
        logits = torch.einsum("nchw,nc->nhw", features, weight[own]) + bias[own, None, None]
        kernel, bias = self._mask_upsampling
        kernel = kernel[own, own][:, None]
        logits = functional.conv_transpose2d(logits[None], kernel, bias[own], stride=2, padding=1, groups=len(own))
        return np.asarray(torch.sigmoid(logits[0]).cpu().numpy(), np.float32)


def _find_weights(folder: Path) -> Path:
    """Return the existing folder of the network.

    A relative path is searched in the working directory, then in the project folder.
    """
    for candidate in candidates(folder):
        if candidate.is_dir():
            return candidate
    searched = " or ".join(str(candidate.resolve()) for candidate in candidates(folder))
    raise DataError(f"detector.weights: expected the folder {searched}, got none; put {' and '.join(SHA256)} there")


def _read_network(folder: Path) -> tuple[list[Operator], dict[str, Tensor], dict[str, float]]:
    """Return the operators, the float32 tensors by name, and the quantization steps of quantized tensors."""
    content = {name: _read_checked(folder / name, sha256) for name, sha256 in SHA256.items()}
    description = json.loads(content["graph.json"])
    quantization: Mapping[str, tuple[float, int]] = description["quant"]
    arrays = np.load(io.BytesIO(content["maskrcnn2go_coco_int8.npz"]), allow_pickle=False)
    tensors = {name: dequantized_weights(arrays[name], quantization.get(name)) for name in arrays.files}
    return description["ops"], tensors, {name: scale for name, (scale, _) in quantization.items()}


def _read_checked(path: Path, sha256: str) -> bytes:
    with errors_of("detector.weights"):
        content = read_bytes(path, LARGEST_FILE)
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise DataError(
            f"detector.weights: {path}: expected sha256 {sha256[:12]}..., got {found[:12]}...; restore the file from "
            "the repository"
        )
    return content
