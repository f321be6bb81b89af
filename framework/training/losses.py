"""The loss of a Mask R-CNN: objectness and boxes of anchors; classes, boxes and masks of proposals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.detection.mask_rcnn.network import DELTA_WEIGHTS, MaskRCNN
from framework.training.targets import BACKGROUND, box_iou, encode, mask_targets, match, sample

BETA = 1.0 / 9.0  # where the smooth L1 loss becomes linear
ANCHORS = 256  # an image, that a step learns from
ANCHORS_POSITIVE = 0.5
PROPOSALS_POSITIVE = 0.25


@dataclass(frozen=True)
class Objects:
    """The N objects of one picture, as the network should find them."""

    boxes: Tensor  # (N, 4) px, extent 0
    labels: Tensor  # (N,) from 1
    masks: Tensor  # (N, H, W) bool

    def to(self, device: torch.device) -> Objects:
        return Objects(self.boxes.to(device), self.labels.to(device), self.masks.to(device))


@dataclass(frozen=True)
class Budget:
    """How much of each image a step looks at."""

    before_nms: int = 500  # anchors a level that become proposals
    after_nms: int = 300  # proposals
    proposals: int = 96  # of these, that are learned from


def losses(
    network: MaskRCNN, images: Tensor, objects: Sequence[Objects], budget: Budget, generator: torch.Generator
) -> dict[str, Tensor]:
    """The five terms, each a mean over the images (N, 3, H, W) RGB 0..255; their sum is what training minimizes."""
    shape = (images.shape[2], images.shape[3])
    pyramid = network.extract(network.normalize(images))
    objectness, deltas = (found.float() for found in network.score_anchors(pyramid))
    of_levels = network.anchors(pyramid)
    anchors = torch.from_numpy(np.concatenate(of_levels)).to(images.device)
    terms: dict[str, list[Tensor]] = {name: [] for name in ("objectness", "anchors", "classes", "boxes", "masks")}
    for i, true in enumerate(objects):
        of_image = [level[i : i + 1] for level in pyramid]
        for name, value in _anchor_losses(anchors, objectness[i], deltas[i], true, generator).items():
            terms[name].append(value)
        with torch.no_grad():
            proposals = network.propose(
                of_levels,
                objectness[i].detach().cpu().numpy(),
                deltas[i].detach().cpu().numpy(),
                shape,
                budget.before_nms,
                budget.after_nms,
            )
        boxes = torch.cat([torch.from_numpy(proposals).to(images.device), true.boxes])
        for name, value in _proposal_losses(network, of_image, boxes, true, budget.proposals, generator).items():
            terms[name].append(value)
    return {name: torch.stack(values).mean() for name, values in terms.items()}


def _anchor_losses(
    anchors: Tensor, objectness: Tensor, deltas: Tensor, true: Objects, generator: torch.Generator
) -> dict[str, Tensor]:
    own = match(box_iou(anchors, true.boxes), 0.7, 0.3, each_object=True)
    positive, negative = sample(own, ANCHORS, ANCHORS_POSITIVE, generator)
    chosen = torch.cat([positive, negative])
    wanted = (own[chosen] >= 0).to(objectness.dtype)
    aims = encode(anchors[positive], true.boxes[own[positive]])
    missed = functional.smooth_l1_loss(deltas[positive], aims, beta=BETA, reduction="sum")
    return {
        "objectness": functional.binary_cross_entropy_with_logits(objectness[chosen], wanted),
        "anchors": missed / max(len(chosen), 1),
    }


def _proposal_losses(
    network: MaskRCNN, pyramid: Sequence[Tensor], boxes: Tensor, true: Objects, number: int, generator: torch.Generator
) -> dict[str, Tensor]:
    own = match(box_iou(boxes, true.boxes), 0.5, 0.5, each_object=False)
    positive, negative = sample(own, number, PROPOSALS_POSITIVE, generator)
    chosen = torch.cat([positive, negative])
    boxes, own = boxes[chosen], own[chosen]
    is_object = own != BACKGROUND
    labels = torch.zeros(len(chosen), dtype=torch.int64, device=boxes.device)
    labels[is_object] = true.labels[own[is_object]]
    logits, deltas = (found.float() for found in network.classify(pyramid, boxes))
    n = len(positive)  # the first ones
    weights = torch.tensor(DELTA_WEIGHTS, device=boxes.device)
    aims = encode(boxes[:n], true.boxes[own[:n]]) * weights
    moved = deltas[torch.arange(n, device=boxes.device), labels[:n]]
    missed = functional.smooth_l1_loss(moved, aims, beta=BETA, reduction="sum")
    terms = {"classes": functional.cross_entropy(logits, labels), "boxes": missed / max(len(chosen), 1)}
    if n:
        of_labels = network.segment(pyramid, boxes[:n]).float()
        own_logits = of_labels[torch.arange(n, device=boxes.device), labels[:n]]
        covered = mask_targets(true.masks, boxes[:n], own[:n], own_logits.shape[-1])
        terms["masks"] = functional.binary_cross_entropy_with_logits(own_logits, covered)
    else:
        terms["masks"] = logits.sum() * 0.0  # no object: nothing to learn, but a gradient for every image
    return terms
