"""Mask R-CNN with a ResNet and a feature pyramid, a common baseline detector."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

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
from framework.detection.mask_rcnn.checkpoint import domain_of_network, read_network
from framework.detection.mask_rcnn.network import fuse_batch_norms, propose, select
from framework.detection.mask_rcnn.published_weights import find_network
from framework.detection.masks.binary_masks import paste_masks, without_duplicates
from framework.detection.masks.boxes import to_original_image
from framework.detection.runtimes.device import torch_device
from framework.errors import DataError, errors_of
from framework.interfaces import Detector


@dataclass
class MaskRCNNDetector(Detector):
    """Mask R-CNN (He et al., 2017) with a ResNet and a feature pyramid, on the CPU or with CUDA.

    The network is a published COCO network of torchvision or detectron2, which is downloaded once, or a network trained
    or converted with this project.

    The class distribution of a detection is the softmax over the class scores, renormalized without the background. The
    score of a detection is the probability of its class before this normalization. Non-maximum suppression across
    classes removes duplicates of ambiguous objects. After construction, `weights` is the path of the file, and `domain`
    is the domain of its training images.
    """

    weights: Path = Path("resnet50_fpn_coco")  # published name, or file relative to the working or project folder
    # minimum score of a detection, in [0, 1); low, because low-score detections can update existing instances
    score_threshold: float = 0.1
    nms_iou: float = 0.5  # box IoU threshold of non-maximum suppression within a class, in (0, 1]
    agnostic_nms_iou: float = 0.6  # mask IoU threshold of non-maximum suppression across classes, in (0, 1]; 1 = off
    # maximum number of region proposals per pyramid level before non-maximum suppression, >= 1
    proposals_before_nms: int = 1000
    proposals: int = 300  # maximum number of region proposals for the box head, >= 1; published networks use 1000
    max_detections: int = 100  # maximum number of detections per image, >= 1
    short_side: int = 0  # short side of the resized image, px, 0 or >= 32; 0 = as in training
    # maximum long side of the resized image, px, 0 or >= short_side; 0 = same ratio to the short side as in training
    long_side: int = 0
    mask_threshold: float = 0.5  # minimum mask probability of a pixel in the mask, in (0, 1)
    half_precision: bool = True  # True = half precision on CUDA; the CPU always uses single precision
    device: str = "auto"  # device of the network: auto, cpu or cuda; auto = cuda if available

    reads = ("color",)

    def __post_init__(self) -> None:
        check_intervals("detector", self, score_threshold="[0, 1)", mask_threshold="(0, 1)")
        check_intervals("detector", self, nms_iou="(0, 1]", agnostic_nms_iou="(0, 1]")
        most = {"proposals_before_nms": MAX_PROPOSALS, "proposals": MAX_PROPOSALS, "max_detections": MAX_DETECTIONS}
        for name, limit in most.items():
            check_count(f"detector.{name}", getattr(self, name), limit)
        for name in ("short_side", "long_side"):
            side = getattr(self, name)
            allowed = f"0 or a value in [32, {LONGEST_SIDE}] px"
            require(side == 0 or 32 <= side <= LONGEST_SIDE, f"detector.{name}", side, allowed)
        self._device = torch_device(self.device)
        with errors_of("detector.weights"):
            self.weights = find_network(self.weights)
            network = read_network(self.weights)
            self.domain = domain_of_network(self.weights)
            self.calibration = calibration_of(self.weights)
        architecture = network.architecture
        self.classes = architecture.classes
        self._short_side = self.short_side or architecture.short_side
        proportion = architecture.long_side / architecture.short_side
        self._long_side = self.long_side or round(self._short_side * proportion)
        allowed = f"at least {self._short_side} px"
        require(self._long_side >= self._short_side, "detector.long_side", self.long_side, allowed)
        fuse_batch_norms(network)  # before halving: variances may be too large for float16
        network = network.requires_grad_(False).to(self._device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._network = network.half() if self.half_precision and self._device.type == "cuda" else network

    @torch.inference_mode()
    def detect(self, frame: Frame) -> Detections:
        network = self._network
        image = self._resize(frame)
        shape = (image.shape[2], image.shape[3])
        pyramid = network.extract(network.normalize(image))
        objectness, anchor_deltas = (self._finite(tensor[0]) for tensor in network.score_anchors(pyramid))
        proposals = propose(
            network.anchors(pyramid), objectness, anchor_deltas, shape, self.proposals_before_nms, self.proposals
        )
        logits, deltas = network.classify(pyramid, self._on_device(proposals))
        probabilities = self._finite(torch.softmax(logits.float(), dim=1))
        limits = self.score_threshold, self.nms_iou, self.max_detections
        boxes, proposal, label = select(proposals, probabilities, self._finite(deltas), shape, *limits)
        if len(boxes) == 0:
            return Detections.none(frame.camera.shape, self.classes)

        masks = paste_masks(
            self._mask_grids(pyramid, boxes, label),
            to_original_image(boxes, shape, frame.camera.shape, extent=0.0),
            frame.camera.shape,
            self.mask_threshold,
        )
        objects = probabilities[proposal, 1:]
        shares = objects / objects.sum(axis=1, keepdims=True)
        return without_duplicates(masks, probabilities[proposal, label], shares, self.classes, self.agnostic_nms_iou)

    def _resize(self, frame: Frame) -> Tensor:
        """Return the resized image (1, 3, H, W), RGB, in [0, 255]."""
        height, width = frame.camera.shape
        scale = min(self._short_side / min(height, width), self._long_side / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        # area averaging for downscaling, because linear interpolation would skip pixels; neither shifts pixel centers
        resized = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        image = torch.from_numpy(resized).to(self._device).permute(2, 0, 1)[None]
        return image.contiguous(memory_format=torch.channels_last)

    def _mask_grids(self, pyramid: list[Tensor], boxes: Float32, label: Int32) -> Float32:
        """Return the mask probabilities (N, 28, 28) on a grid over each box (N, 4), px.

        `label` (N,) is the class of each box, from 1.
        """
        logits = self._network.segment(pyramid, self._on_device(boxes))
        own = logits[torch.arange(len(label), device=self._device), self._on_device(label).long()]
        return self._finite(torch.sigmoid(own.float()))

    def _on_device(self, array: Float32 | Int32) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def _finite(self, tensor: Tensor) -> Float32:
        """Return the tensor as an array in single precision, after checking that it is finite."""
        array: Float32 = tensor.float().cpu().numpy()
        if not np.isfinite(array).all():
            fix = "; set detector.half_precision=false" if self._network.dtype == torch.float16 else ""
            raise DataError(
                f"detector.weights: expected finite outputs of {self.weights.name}, got NaN or infinity{fix}"
            )
        return array
