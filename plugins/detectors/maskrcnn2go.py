"""Mask R-CNN 2Go: a real Mask R-CNN with COCO weights, small enough for a video on a laptop's CPU."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.config.validation import LONGEST_SIDE, MOST_DETECTIONS, MOST_PROPOSALS, check_count, require
from framework.data import Detections, Float32, Frame, Int32
from framework.detection.mask_rcnn.roi_align import roi_align
from framework.detection.masks.binary_masks import paste_masks, without_duplicates
from framework.detection.masks.boxes import anchor_grid, clip, decode, to_original_image
from framework.detection.masks.nms import suppress_boxes
from framework.detection.runtimes.caffe2_network import (
    Operator,
    dequantised,
    float_network,
    has_int8_kernels,
    int8_network,
)
from framework.detection.runtimes.device import one_torch_thread, torch_device
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import DataError
from framework.files.atomic_write import read_bytes
from framework.files.search_paths import candidates
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import COCO

LARGEST_FILE = 2**26  # bytes; the published ones have 3 MB
SHA256 = {
    "graph.json": "e2b06acc9c26fdd62292100ea2a5495f9fd1bd3607276916bdb8440562f401ef",
    "maskrcnn2go_coco_int8.npz": "a79197eba054bdf4e4b1136a3dffbfea951f442682464357d91b2a1abd0d21c9",
}
STRIDE = 16  # px of the resized image per cell of the feature map
BINS = 6  # of RoIAlign, a side
PRE_NMS_PROPOSALS = 3000  # best anchors that are decoded; this and the next are the graph's own
PROPOSAL_NMS = 0.7  # IoU
DELTA_WEIGHTS = np.array([10, 10, 5, 5], np.float32)  # the box head's deltas are scaled by these

log = logging.getLogger(__name__)


@dataclass
class MaskRCNN2Go(Detector):
    """Mask R-CNN 2Go (Facebook, Apache-2.0; COCO 2014 minival mask AP 20.9 as published), on the CPU or with CUDA.

    The published network computes in 8-bit integers, and does so here on x86 CPUs with VNNI (those since about 2020), a
    frame in one thread; elsewhere in float, with the same weights. Each detection carries the box head's softmax over
    its 80 object classes, renormalised without the background; its score is the probability of its own class with the
    background counted. Non-maximum suppression within a class is the network's own; `agnostic_nms` then lets a mask
    fall to a better one of whatever class, so that an object that could be a chair or a couch comes back once, with
    both in its distribution, and does not start two map instances.
    """

    weights: Path = Path("plugins/detectors/maskrcnn2go_int8")  # folder; relative: to the working, then project folder
    score_threshold: float = 0.1  # in [0, 1): low, for weak detections may still update instances that exist
    nms: float = 0.3  # IoU in (0, 1] above which a box falls to a better one of its class
    agnostic_nms: float = 0.6  # IoU in (0, 1] above which a mask falls to a better one of any class; 1 = off
    proposals: int = 120  # >= 1, regions that the box head looks at; the network was trained with 100 to 120
    max_detections: int = 100  # >= 1, an image
    short_side: int = 320  # px >= 32, to which images are resized; the network was trained at 320
    long_side: int = 640  # px >= short_side, bound on the other side
    mask_threshold: float = 0.5  # in (0, 1), probability above which a pixel is inside
    int8: bool = True  # in the network's own integers where the CPU has VNNI, three times as fast on a core
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where there is one

    reads = ("color",)

    def __post_init__(self) -> None:
        require(0 <= self.score_threshold < 1, "detector.score_threshold", self.score_threshold, "in [0, 1)")
        require(0 < self.nms <= 1, "detector.nms", self.nms, "in (0, 1]")
        require(0 < self.agnostic_nms <= 1, "detector.agnostic_nms", self.agnostic_nms, "in (0, 1]")
        check_count("detector.proposals", self.proposals, MOST_PROPOSALS)
        check_count("detector.max_detections", self.max_detections, MOST_DETECTIONS)
        require(self.short_side >= 32, "detector.short_side", self.short_side, "at least 32 px")
        require(
            self.short_side <= self.long_side <= LONGEST_SIDE,
            "detector.long_side",
            self.long_side,
            f"at least {self.short_side} px and at most {LONGEST_SIDE}",
        )
        require(0 < self.mask_threshold < 1, "detector.mask_threshold", self.mask_threshold, "in (0, 1)")
        self._device = torch_device(self.device)
        self.classes = COCO
        graph, tensors, spacings = _read_network(_find_weights(self.weights))
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        self._anchors: Float32 = tensors.pop("anchor").cpu().numpy()
        first = next(operator for operator in graph if operator["type"] == "Int8ConvRelu")["inputs"][1]
        tensors[first] = tensors[first].flip(1)  # trained on BGR; frames are RGB
        self._integers = self.concurrent = self._computes_in_integers()
        network = partial(int8_network, spacings=spacings) if self._integers else float_network
        outputs = ("xif3_6_int8", "rpn_cls_logits_int8", "rpn_bbox_pred_int8")
        boxes = ("cls_score_int8", "bbox_pred_int8")
        self._backbone = network(graph, tensors, inputs=("data_NHWC",), outputs=outputs)
        self._box_head = network(graph, tensors, inputs=("roi_features",), outputs=boxes)
        # in float everywhere: its roundings move borders, which cost 0.03 of AP50 (two places), and save 5 ms
        self._mask_head = float_network(graph, tensors, ("_[mask]_pool5",), ("conv5_mask_v1_int8",))
        self._mask_logits = tensors["mask_fcn_logits_w_int8"][:, :, 0, 0], tensors["mask_fcn_logits_b_int8"]
        self._mask_upsampling = tensors["mask_fcn_logits_up_w_int8"], tensors["mask_fcn_logits_up_b_int8"]

    def fingerprint(self) -> str:
        """Integers and float do not give the same digits."""
        return f"{fingerprint(self)} {'int8' if self._integers else 'float32'}"

    def _computes_in_integers(self) -> bool:
        if not self.int8 or self._device.type != "cpu":
            return False
        if not has_int8_kernels():
            log.info(
                "detector.int8: this processor has no VNNI for exact 8-bit convolutions, so the network runs in float"
            )
            return False
        return True

    @torch.inference_mode()
    def detect(self, frame: Frame) -> Detections:
        with one_torch_thread() if self._integers else nullcontext():  # the others are the map's, and other frames'
            return self._detect(frame)

    def _detect(self, frame: Frame) -> Detections:
        image = self._resize(frame)
        shape = (image.shape[2], image.shape[3])
        features, objectness, deltas = self._backbone(image)
        proposals = self._propose(objectness, deltas, shape)
        logits, deltas = self._box_head(self._pool(features, proposals))
        probabilities = torch.softmax(logits, dim=1).cpu().numpy()
        boxes, proposal, label = self._select(proposals, probabilities, deltas.cpu().numpy(), shape)
        if len(boxes) == 0:
            return Detections.none(frame.camera.shape, self.classes)

        grids = self._mask_grids(self._pool(features, boxes), label)
        masks = paste_masks(
            grids, to_original_image(boxes, shape, frame.camera.shape), frame.camera.shape, self.mask_threshold
        )
        objects = probabilities[proposal, 1:]
        shares = objects / objects.sum(axis=1, keepdims=True)
        return without_duplicates(masks, probabilities[proposal, label], shares, self.classes, self.agnostic_nms)

    def _resize(self, frame: Frame) -> Tensor:
        """The network's input (1, 3, H, W), RGB, 0..255."""
        height, width = frame.camera.shape
        scale = min(self.short_side / min(height, width), self.long_side / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        resized = cv2.resize(frame.color, size, interpolation=cv2.INTER_LINEAR)
        return torch.from_numpy(resized).to(self._device).permute(2, 0, 1)[None].float()

    def _propose(self, objectness: Tensor, deltas: Tensor, shape: tuple[int, int]) -> Float32:
        """The boxes (P, 4), px of the resized image, in which the network expects objects."""
        rows, columns = objectness.shape[2:]
        # No sigmoid: it would keep the order.
        scores = objectness.permute(0, 2, 3, 1).reshape(-1).cpu().numpy()
        best = np.argsort(-scores, kind="stable")[:PRE_NMS_PROPOSALS]
        anchors = anchor_grid(self._anchors, rows, columns, STRIDE)[best]
        boxes = decode(anchors, deltas.permute(0, 2, 3, 1).reshape(-1, 4).cpu().numpy()[best])
        boxes = clip(boxes, shape)
        return boxes[suppress_boxes(boxes, scores[best], PROPOSAL_NMS, limit=self.proposals)]

    def _pool(self, features: Tensor, boxes: Float32) -> Tensor:
        return roi_align(features, torch.from_numpy(boxes).to(self._device), BINS, 1 / STRIDE)

    def _select(
        self, proposals: Float32, probabilities: Float32, deltas: Float32, shape: tuple[int, int]
    ) -> tuple[Float32, Int32, Int32]:
        """The surviving boxes (N, 4) in the resized image, best first, their proposals (N,) and labels (N,) 1 to 80."""
        proposal, label = np.nonzero(probabilities[:, 1:] > self.score_threshold)
        label += 1
        own_deltas = deltas.reshape(len(deltas), -1, 4)[proposal, label] / DELTA_WEIGHTS
        boxes = clip(decode(proposals[proposal], own_deltas), shape)
        scores = probabilities[proposal, label]
        kept = suppress_boxes(boxes, scores, self.nms, label.astype(np.int32), limit=self.max_detections)
        return boxes[kept], np.asarray(proposal[kept], np.int32), np.asarray(label[kept], np.int32)

    def _mask_grids(self, pooled: Tensor, label: Int32) -> Float32:
        """Probabilities (N, 24, 24) of being inside the object, over its box.

        The graph has the logits of all 81 classes, channel by channel; only each detection's own are needed.
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
    """The folder of the network. A relative path is tried from the working folder, then from the project's."""
    for place in candidates(folder):
        if place.is_dir():
            return place
    looked = " and ".join(str(place.resolve()) for place in candidates(folder))
    raise DataError(f"detector.weights: there is no folder {looked}; put {' and '.join(SHA256)} there")


def _read_network(folder: Path) -> tuple[list[Operator], dict[str, Tensor], dict[str, float]]:
    """The operators in order, every tensor dequantised, and the distance of neighboring numbers in those that were."""
    content = {name: _read_checked(folder / name, sha256) for name, sha256 in SHA256.items()}
    description = json.loads(content["graph.json"])
    quantisation: Mapping[str, tuple[float, int]] = description["quant"]
    arrays = np.load(io.BytesIO(content["maskrcnn2go_coco_int8.npz"]), allow_pickle=False)
    tensors = {name: dequantised(arrays[name], quantisation.get(name)) for name in arrays.files}
    return description["ops"], tensors, {name: scale for name, (scale, _) in quantisation.items()}


def _read_checked(path: Path, sha256: str) -> bytes:
    try:
        content = read_bytes(path, LARGEST_FILE)
    except DataError as error:
        raise DataError(f"detector.weights: {error}") from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise DataError(f"detector.weights: {path} is damaged: sha256 {found[:12]}..., expected {sha256[:12]}...")
    return content
