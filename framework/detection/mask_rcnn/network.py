"""Mask R-CNN with a feature pyramid (He et al. 2017, Lin et al. 2017), in plain torch.

    image ─► ResNet ─► feature pyramid ─► region proposals ─► boxes and class distributions ─► masks

The parameters have the names of torchvision. Unless stated otherwise, boxes are x1 y1 x2 y2 in px of the network's
input, and x2 is the right border. Class 0 is the background.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from framework.data import Float32, Int32, Int64
from framework.detection.mask_rcnn.resnet import ResNet, ResNetShape
from framework.detection.mask_rcnn.roi_align import roi_align
from framework.detection.masks.boxes import anchor_grid, clip, decode, suppress_boxes

STRIDES = (4, 8, 16, 32, 64)  # px of the input per cell of a level, P2 to P6
POOLED_LEVELS = 4  # P2 to P5; only proposals use P6
BOX_BINS, MASK_BINS = 7, 14  # number of bins of RoIAlign per side
# a box with this side, px, is pooled from the level with this index, P4 (Lin et al. 2017, eq. 1)
CANONICAL_SIDE, CANONICAL_LEVEL = 224.0, 2
DELTA_WEIGHTS = (10.0, 10.0, 5.0, 5.0)  # the box head predicts deltas dx, dy, dw, dh multiplied by these factors
PROPOSAL_NMS = 0.7  # IoU threshold of non-maximum suppression among the proposals of a level


@dataclass(frozen=True)
class Architecture:
    """Hyperparameters of a network, stored together with its weights."""

    classes: tuple[str, ...]  # without the background, in the order of the network's columns
    backbone: ResNetShape = field(default_factory=ResNetShape)
    fpn_channels: int = 256  # number of channels of the feature pyramid
    head_features: int = 1024  # number of features of the box head
    anchor_sides: tuple[float, ...] = (32.0, 64.0, 128.0, 256.0, 512.0)  # px, one per level
    anchor_ratios: tuple[float, ...] = (0.5, 1.0, 2.0)  # height / width
    rounded_anchors: bool = True  # True = anchors are rounded to whole pixels, as in torchvision
    # True = the stride of P6 is the input size divided by the size of P6, rounded down: 61 at 800 px (torchvision)
    truncated_strides: bool = False
    sampling_ratio: int = 2  # number of samples per side of a bin in RoIAlign; 0 = one sample per cell
    half_pixel: bool = False  # convention of RoIAlign; True = "aligned"
    pixel_mean: tuple[float, float, float] = (123.675, 116.28, 103.53)  # RGB, 0..255
    pixel_std: tuple[float, float, float] = (58.395, 57.12, 57.375)
    short_side: int = 800  # px, short side of the resized images in training
    long_side: int = 1333  # px, maximum long side of the resized images in training


class MaskRCNN(nn.Module):
    """Mask R-CNN network."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        self.backbone = nn.Sequential(
            OrderedDict(
                body=ResNet(architecture.backbone),
                fpn=FeaturePyramid(architecture.backbone.channels, architecture.fpn_channels),
            )
        )
        head = ProposalHead(architecture.fpn_channels, len(architecture.anchor_ratios))  # shared by all levels
        self.rpn = nn.ModuleDict({"head": head})
        self.roi_heads = RoiHeads(architecture)
        self._anchors = [_anchors(side, architecture) for side in architecture.anchor_sides]
        self._grids: tuple[list[tuple[int, int]], list[Float32]] = [], []  # shapes and anchors of the latest levels

    @property
    def dtype(self) -> torch.dtype:
        return self.roi_heads.box_predictor.cls_score.weight.dtype

    def normalize(self, images: Tensor) -> Tensor:
        """Normalize RGB images (N, 3, H, W) with values 0 to 255, and pad them to multiples of 32 px."""
        mean, std = (
            torch.tensor(values, device=images.device)[:, None, None]
            for values in (self.architecture.pixel_mean, self.architecture.pixel_std)
        )
        height, width = images.shape[2:]
        padded = functional.pad((images.float() - mean) / std, (0, -width % 32, 0, -height % 32))
        return padded.to(self.dtype)

    def extract(self, images: Tensor) -> list[Tensor]:
        """Return the feature pyramid of normalized images (N, 3, H, W).

        Each of the levels P2 to P6 has the shape (N, fpn_channels, H / stride, W / stride). The strides are STRIDES.
        """
        levels: list[Tensor] = self.backbone(images)
        return levels

    def score_anchors(self, pyramid: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the objectness logits (N, A) and box deltas (N, A, 4) of the anchors of all levels."""
        objectness, deltas = zip(*(self.rpn["head"](level) for level in pyramid), strict=True)
        n = len(pyramid[0])
        return (
            torch.cat([level.permute(0, 2, 3, 1).reshape(n, -1) for level in objectness], dim=1),
            torch.cat([level.permute(0, 2, 3, 1).reshape(n, -1, 4) for level in deltas], dim=1),
        )

    def anchors(self, pyramid: Sequence[Tensor]) -> list[Float32]:
        """Return the anchor boxes (A, 4), px, of each level."""
        shapes = [(level.shape[2], level.shape[3]) for level in pyramid]
        known, grids = self._grids
        if shapes != known:
            height, width = (STRIDES[0] * cells for cells in shapes[0])
            truncated = self.architecture.truncated_strides
            grids = [
                anchor_grid(anchors, rows, columns, (height // rows, width // columns) if truncated else stride)
                for anchors, (rows, columns), stride in zip(self._anchors, shapes, STRIDES, strict=True)
            ]
            self._grids = shapes, grids
        return grids

    def classify(self, pyramid: Sequence[Tensor], boxes: Tensor) -> tuple[Tensor, Tensor]:
        """Classify boxes in one image and refine their coordinates.

        Args:
            pyramid: The feature pyramid of the image.
            boxes: The boxes (P, 4), px.

        Returns:
            The class logits (P, 1 + C) and box deltas (P, 1 + C, 4). The background is first.
        """
        x = self.roi_heads.box_head(self.pool(pyramid, boxes, BOX_BINS))
        logits, deltas = self.roi_heads.box_predictor(x)
        return logits, deltas.view(*logits.shape, 4)  # -1 would be ambiguous without boxes

    def segment(self, pyramid: Sequence[Tensor], boxes: Tensor) -> Tensor:
        """Return the mask logits (P, 1 + C, 28, 28) of each class in boxes (P, 4), px."""
        logits: Tensor = self.roi_heads.mask_predictor(self.roi_heads.mask_head(self.pool(pyramid, boxes, MASK_BINS)))
        return logits

    def pool(self, pyramid: Sequence[Tensor], boxes: Tensor, bins: int) -> Tensor:
        """Return the features (P, fpn_channels, bins, bins) pooled from boxes (P, 4), px."""
        sides = (boxes[:, 2:] - boxes[:, :2]).clamp(min=0).prod(dim=1).sqrt()
        # the size of a box determines its level (Lin et al. 2017, eq. 1)
        level = torch.floor(CANONICAL_LEVEL + torch.log2(sides / CANONICAL_SIDE) + 1e-6)
        level = level.clamp(0, POOLED_LEVELS - 1)
        pooled = pyramid[0].new_zeros((len(boxes), pyramid[0].shape[1], bins, bins))
        ratio, half_pixel = self.architecture.sampling_ratio, self.architecture.half_pixel
        for k in range(POOLED_LEVELS):
            own = torch.nonzero(level == k)[:, 0]
            if len(own):
                features = roi_align(pyramid[k], boxes[own], bins, 1 / STRIDES[k], ratio, half_pixel)
                pooled[own] = features.to(pooled.dtype)
        return pooled


class FeaturePyramid(nn.Module):
    """Feature pyramid with the levels P2 to P6 (Lin et al., "Feature Pyramid Networks", 2017)."""

    def __init__(self, channels: Sequence[int], out: int) -> None:
        super().__init__()
        self.inner_blocks = nn.ModuleList(nn.Sequential(nn.Conv2d(c, out, 1)) for c in channels)
        self.layer_blocks = nn.ModuleList(nn.Sequential(nn.Conv2d(out, out, 3, 1, 1)) for _ in channels)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        inner = self.inner_blocks[-1](levels[-1])
        out = [self.layer_blocks[-1](inner)]
        for k in range(len(levels) - 2, -1, -1):
            lateral = self.inner_blocks[k](levels[k])
            inner = lateral + functional.interpolate(inner, size=lateral.shape[-2:], mode="nearest")
            out.insert(0, self.layer_blocks[k](inner))
        return [*out, functional.max_pool2d(out[-1], 1, 2)]


class ProposalHead(nn.Module):
    """Head that predicts the objectness and box deltas of anchors (Ren et al., "Faster R-CNN", 2015)."""

    def __init__(self, channels: int, anchors: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(_convolution(channels, channels))
        self.cls_logits = nn.Conv2d(channels, anchors, 1)
        self.bbox_pred = nn.Conv2d(channels, 4 * anchors, 1)

    def forward(self, level: Tensor) -> tuple[Tensor, Tensor]:
        x = self.conv(level)
        return self.cls_logits(x), self.bbox_pred(x)


class RoiHeads(nn.Module):
    """The box head and the mask head."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        labels, channels, features = (
            1 + len(architecture.classes),
            architecture.fpn_channels,
            architecture.head_features,
        )
        self.box_head = nn.Sequential(
            OrderedDict(
                flatten=nn.Flatten(),
                fc6=nn.Linear(channels * BOX_BINS**2, features),
                relu6=nn.ReLU(),
                fc7=nn.Linear(features, features),
                relu7=nn.ReLU(),
            )
        )
        self.box_predictor = BoxPredictor(features, labels)
        self.mask_head = nn.Sequential(*(_convolution(channels, channels) for _ in range(4)))
        self.mask_predictor = nn.Sequential(
            OrderedDict(
                conv5_mask=nn.ConvTranspose2d(channels, channels, 2, 2),
                relu=nn.ReLU(),
                mask_fcn_logits=nn.Conv2d(channels, labels, 1),
            )
        )


class BoxPredictor(nn.Module):
    """Linear layers that predict the logit and the box deltas of each class."""

    def __init__(self, features: int, labels: int) -> None:
        super().__init__()
        self.cls_score = nn.Linear(features, labels)
        self.bbox_pred = nn.Linear(features, 4 * labels)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.cls_score(x), self.bbox_pred(x)


def _convolution(channels: int, out: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels, out, 3, 1, 1), nn.ReLU(inplace=True))


def _anchors(side: float, architecture: Architecture) -> Float32:
    """Return the anchor boxes (R, 4), px, of a cell with its center at (0, 0)."""
    ratios = np.array(architecture.anchor_ratios)
    widths, heights = side / np.sqrt(ratios), side * np.sqrt(ratios)
    anchors = np.stack([-widths, -heights, widths, heights], axis=1).astype(np.float64) / 2
    return np.asarray(np.round(anchors) if architecture.rounded_anchors else anchors, np.float32)


def propose(
    anchors: Sequence[Float32],
    objectness: Float32,
    deltas: Float32,
    shape: tuple[int, int],
    before_nms: int,
    after_nms: int,
    extent: float = 0.0,
) -> Float32:
    """Select the box proposals (P, 4), px, of one image, best first.

    Args:
        anchors: The anchors (A_k, 4) of each level k, px.
        objectness: The objectness (A,) of the anchors of all levels.
        deltas: The box deltas (A, 4) of the anchors of all levels.
        shape: The image size (height, width), px.
        before_nms: The maximum number of anchors per level before non-maximum suppression.
        after_nms: The maximum number of proposals.
        extent: The box convention, see `framework.detection.masks.boxes`.
    """
    boxes, scores, levels = [], [], []
    start = 0
    for level, of_level in enumerate(anchors):
        own = slice(start, start + len(of_level))
        start += len(of_level)
        best = best_first(objectness[own], before_nms)
        decoded = clip(decode(of_level[best], deltas[own][best], extent), shape, extent)
        wide = (decoded[:, 2:] - decoded[:, :2] + extent >= 1e-3).all(axis=1)
        boxes.append(decoded[wide])
        scores.append(objectness[own][best][wide])
        levels.append(np.full(int(wide.sum()), level, np.int32))
    all_boxes, all_levels = np.concatenate(boxes), np.concatenate(levels)
    kept = suppress_boxes(all_boxes, np.concatenate(scores), PROPOSAL_NMS, all_levels, limit=after_nms, extent=extent)
    return all_boxes[kept]


def best_first(scores: Float32, count: int) -> Int64:
    """Return the indices of the `count` highest scores, best first.

    Equal scores keep their order.
    """
    if count >= len(scores):
        return np.asarray(np.argsort(-scores, kind="stable"), np.int64)
    lowest = np.partition(scores, len(scores) - count)[len(scores) - count]
    candidates = np.flatnonzero(scores >= lowest)
    return np.asarray(candidates[np.argsort(-scores[candidates], kind="stable")[:count]], np.int64)


def select(
    proposals: Float32,
    probabilities: Float32,
    deltas: Float32,
    shape: tuple[int, int],
    score_threshold: float,
    nms: float,
    limit: int,
    extent: float = 0.0,
) -> tuple[Float32, Int32, Int32]:
    """Select the detected boxes of one image by probability and non-maximum suppression.

    Each class of a proposal with a sufficient probability is a separate candidate.

    Args:
        proposals: The proposals (P, 4), px.
        probabilities: The class probabilities (P, 1 + C). The background is first.
        deltas: The box deltas (P, 1 + C, 4) of each class.
        shape: The image size (height, width), px.
        score_threshold: The minimum probability of a class.
        nms: The IoU above which the worse of two boxes of a class is removed.
        limit: The maximum number of boxes.
        extent: The box convention, see `framework.detection.masks.boxes`.

    Returns:
        The boxes (N, 4), px, the index of the proposal of each box (N,), and its label (N,), best first.
    """
    proposal, label = np.nonzero(probabilities[:, 1:] > score_threshold)
    label += 1
    own = np.asarray(deltas[proposal, label] / np.array(DELTA_WEIGHTS), np.float32)
    boxes = clip(decode(proposals[proposal], own, extent), shape, extent)
    wide = (boxes[:, 2:] - boxes[:, :2] + extent >= 1e-2).all(axis=1)
    boxes, proposal, label = boxes[wide], proposal[wide], label[wide]
    scores = probabilities[proposal, label]
    kept = suppress_boxes(boxes, scores, nms, label.astype(np.int32), limit=limit, extent=extent)
    return boxes[kept], np.asarray(proposal[kept], np.int32), np.asarray(label[kept], np.int32)


def fuse_batch_norms(network: nn.Module) -> None:
    """Fold each batch normalization into the preceding convolution, in place.

    The network must be in inference mode.
    """
    for module in network.modules():
        for (name, layer), (next_name, next_layer) in pairwise(list(module.named_children())):
            if isinstance(layer, nn.Conv2d) and isinstance(next_layer, nn.BatchNorm2d):
                setattr(module, name, fuse_conv_bn_eval(layer, next_layer))
                setattr(module, next_name, nn.Identity())
