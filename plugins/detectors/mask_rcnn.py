"""Mask R-CNN with a ResNet and a feature pyramid: the network that most of the field's systems start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from framework.config.validation import LONGEST_SIDE, MOST_DETECTIONS, MOST_PROPOSALS, check_count, require
from framework.data import Detections, Float32, Frame, Int32
from framework.detection.mask_rcnn.checkpoint import domain_of_network, read_network
from framework.detection.mask_rcnn.network import fuse_batch_norms, select
from framework.detection.mask_rcnn.published_weights import find_network
from framework.detection.masks.binary_masks import paste_masks, without_duplicates
from framework.detection.masks.boxes import to_original_image
from framework.detection.runtimes.device import torch_device
from framework.errors import DataError
from framework.interfaces import Detector


@dataclass
class MaskRCNNDetector(Detector):
    """Mask R-CNN (He et al. 2017) with ResNet-50 or ResNet-101 and a feature pyramid, on the CPU or with CUDA.

    The network is torchvision's or detectron2's, published for COCO and downloaded once, or one that was trained or
    converted here: a file says itself what network it holds. Each detection carries the box head's softmax over all
    object classes, renormalised without the background; its score is the probability of its own class with the
    background counted. Non-maximum suppression within a class is the network's own; `agnostic_nms` then lets a mask
    fall to a better one of whatever class, so that an object that could be a chair or a couch comes back once, with
    both in its distribution. After building, `weights` is the file that was read, and `domain` what pictures it is for.
    """

    weights: Path = Path(
        "resnet50_fpn_coco"
    )  # a published one's name or a file, relative to the working or project folder
    score_threshold: float = 0.1  # in [0, 1): low, for weak detections may still update instances that exist
    nms: float = 0.5  # IoU in (0, 1] above which a box falls to a better one of its class
    agnostic_nms: float = 0.6  # IoU in (0, 1] above which a mask falls to a better one of any class; 1 = off
    proposals_before_nms: int = 1000  # >= 1, best anchors of each pyramid level that are decoded
    proposals: int = (
        300  # >= 1, regions that the box head looks at; 1000 as published, at little gain and twice the time
    )
    max_detections: int = 100  # >= 1, an image
    short_side: int = 0  # px >= 32, to which images are resized; 0 = as in the network's training
    long_side: int = 0  # px >= short_side, bound on the other side; 0 = in the proportion of the network's training
    mask_threshold: float = 0.5  # in (0, 1), probability above which a pixel is inside
    half_precision: bool = True  # half precision on CUDA; the CPU always computes in single
    device: str = "auto"  # auto, cpu or cuda; auto = cuda where there is one

    reads = ("color",)

    def __post_init__(self) -> None:
        require(0 <= self.score_threshold < 1, "detector.score_threshold", self.score_threshold, "in [0, 1)")
        require(0 < self.nms <= 1, "detector.nms", self.nms, "in (0, 1]")
        require(0 < self.agnostic_nms <= 1, "detector.agnostic_nms", self.agnostic_nms, "in (0, 1]")
        most = {"proposals_before_nms": MOST_PROPOSALS, "proposals": MOST_PROPOSALS, "max_detections": MOST_DETECTIONS}
        for name, limit in most.items():
            check_count(f"detector.{name}", getattr(self, name), limit)
        for name in ("short_side", "long_side"):
            side = getattr(self, name)
            allowed = f"at least 32 px, or 0, and at most {LONGEST_SIDE}"
            require(side == 0 or 32 <= side <= LONGEST_SIDE, f"detector.{name}", side, allowed)
        require(0 < self.mask_threshold < 1, "detector.mask_threshold", self.mask_threshold, "in (0, 1)")
        self._device = torch_device(self.device)
        try:
            self.weights = find_network(self.weights)
            network = read_network(self.weights)
            self.domain = domain_of_network(self.weights)
        except DataError as error:
            raise DataError(f"detector.weights: {error}") from error
        architecture = network.architecture
        self.classes = architecture.classes
        self._short_side = self.short_side or architecture.short_side
        proportion = architecture.long_side / architecture.short_side
        self._long_side = self.long_side or round(self._short_side * proportion)
        require(
            self._long_side >= self._short_side, "detector.long_side", self.long_side, f"at least {self._short_side} px"
        )
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
        proposals = network.propose(
            network.anchors(pyramid), objectness, anchor_deltas, shape, self.proposals_before_nms, self.proposals
        )
        logits, deltas = network.classify(pyramid, self._on_device(proposals))
        probabilities = self._finite(torch.softmax(logits.float(), dim=1))
        boxes, proposal, label = select(
            proposals, probabilities, self._finite(deltas), shape, self.score_threshold, self.nms, self.max_detections
        )
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
        return without_duplicates(masks, probabilities[proposal, label], shares, self.classes, self.agnostic_nms)

    def _resize(self, frame: Frame) -> Tensor:
        """The network's input before normalization (1, 3, H, W), RGB, 0..255.

        Both ways to resize take a pixel as a square around its centre, so that nothing shifts; shrinking averages, for
        linear interpolation would skip pixels.
        """
        height, width = frame.camera.shape
        scale = min(self._short_side / min(height, width), self._long_side / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        resized = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        image = torch.from_numpy(resized).to(self._device).permute(2, 0, 1)[None]
        return image.contiguous(memory_format=torch.channels_last)

    def _mask_grids(self, pyramid: list[Tensor], boxes: Float32, label: Int32) -> Float32:
        """Probabilities (N, 28, 28) of being inside the object, over its box."""
        logits = self._network.segment(pyramid, self._on_device(boxes))
        own = logits[torch.arange(len(label), device=self._device), self._on_device(label).long()]
        return self._finite(torch.sigmoid(own.float()))

    def _on_device(self, array: Float32 | Int32) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def _finite(self, tensor: Tensor) -> Float32:
        """The tensor as an array, in single precision. Raises DataError where the network's numbers overflowed."""
        array: Float32 = tensor.float().cpu().numpy()
        if not np.isfinite(array).all():
            advice = (
                "set detector.half_precision=false"
                if self._network.rpn.head.cls_logits.weight.dtype == torch.float16
                else ""
            )
            raise DataError(f"{self.weights.name} computed numbers that are not finite{advice and '; '}{advice}")
        return array
