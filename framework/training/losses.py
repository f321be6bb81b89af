"""Loss functions of Mask R-CNN (He et al. 2017, Ren et al. 2015).

Boxes are x1 y1 x2 y2, px, and have the width x2 - x1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.detection.mask_rcnn.network import DELTA_WEIGHTS, MaskRCNN, propose
from framework.detection.mask_rcnn.roi_align import roi_align

BETA = 1.0 / 9.0  # absolute error at which the smooth L1 loss changes from quadratic to linear
ANCHORS = 256  # number of sampled anchors per image
ANCHORS_POSITIVE = 0.5  # maximum fraction of anchors with an object
PROPOSALS_POSITIVE = 0.25  # maximum fraction of proposals with an object
BACKGROUND, IGNORED = -1, -2


@dataclass(frozen=True)
class Objects:
    """The ground-truth objects in an image."""

    boxes: Tensor  # (N, 4) px
    labels: Tensor  # (N,) class labels, from 1
    masks: Tensor  # (N, H, W) bool

    def to(self, device: torch.device) -> Objects:
        return Objects(self.boxes.to(device), self.labels.to(device), self.masks.to(device))


@dataclass(frozen=True)
class Budget:
    """Limits for the proposals of an image in a training step."""

    before_nms: int = 500  # maximum number of decoded anchors per level
    after_nms: int = 300  # maximum number of proposals after non-maximum suppression
    proposals: int = 96  # maximum number of sampled proposals


def losses(
    network: MaskRCNN, images: Tensor, objects: Sequence[Objects], budget: Budget, generator: torch.Generator
) -> dict[str, Tensor]:
    """Compute the loss terms of a batch.

    The terms are the objectness and box deltas of anchors, and the classes, box deltas and masks of proposals. The loss
    is the sum of the terms.

    Args:
        network: The network.
        images: The images (N, 3, H, W), RGB, 0 to 255.
        objects: The ground-truth objects of each image.
        budget: The limits for the proposals.
        generator: The random number generator.

    Returns:
        The mean of each term over the images, by name.
    """
    shape = (images.shape[2], images.shape[3])
    pyramid = network.extract(network.normalize(images))
    objectness, deltas = (output.float() for output in network.score_anchors(pyramid))
    of_levels = network.anchors(pyramid)
    anchors = torch.from_numpy(np.concatenate(of_levels)).to(images.device)
    of_images: list[dict[str, Tensor]] = []
    for i, true in enumerate(objects):
        of_image = [level[i : i + 1] for level in pyramid]
        terms = _anchor_losses(anchors, objectness[i], deltas[i], true, generator)
        scores, moves = (output[i].detach().cpu().numpy() for output in (objectness, deltas))
        with torch.no_grad():
            proposals = propose(of_levels, scores, moves, shape, budget.before_nms, budget.after_nms)
        boxes = torch.cat([torch.from_numpy(proposals).to(images.device), true.boxes])
        of_images.append(terms | _proposal_losses(network, of_image, boxes, true, budget.proposals, generator))
    names = ("objectness", "anchors", "classes", "boxes", "masks")
    return {name: torch.stack([terms[name] for terms in of_images]).mean() for name in names}


def _anchor_losses(
    anchors: Tensor, objectness: Tensor, deltas: Tensor, true: Objects, generator: torch.Generator
) -> dict[str, Tensor]:
    own = match(box_iou(anchors, true.boxes), 0.7, 0.3, each_object=True)
    positive, negative = sample(own, ANCHORS, ANCHORS_POSITIVE, generator)
    chosen = torch.cat([positive, negative])
    wanted = (own[chosen] >= 0).to(objectness.dtype)
    targets = encode(anchors[positive], true.boxes[own[positive]])
    distance = functional.smooth_l1_loss(deltas[positive], targets, beta=BETA, reduction="sum")
    return {
        "objectness": functional.binary_cross_entropy_with_logits(objectness[chosen], wanted),
        "anchors": distance / max(len(chosen), 1),
    }


def _proposal_losses(
    network: MaskRCNN, pyramid: Sequence[Tensor], boxes: Tensor, true: Objects, count: int, generator: torch.Generator
) -> dict[str, Tensor]:
    own = match(box_iou(boxes, true.boxes), 0.5, 0.5, each_object=False)
    positive, negative = sample(own, count, PROPOSALS_POSITIVE, generator)
    chosen = torch.cat([positive, negative])
    boxes, own = boxes[chosen], own[chosen]
    is_object = own != BACKGROUND
    labels = torch.zeros(len(chosen), dtype=torch.int64, device=boxes.device)
    labels[is_object] = true.labels[own[is_object]]
    logits, deltas = (output.float() for output in network.classify(pyramid, boxes))
    n = len(positive)  # positive boxes come first
    index = torch.arange(n, device=boxes.device)
    targets = encode(boxes[:n], true.boxes[own[:n]]) * torch.tensor(DELTA_WEIGHTS, device=boxes.device)
    distance = functional.smooth_l1_loss(deltas[index, labels[:n]], targets, beta=BETA, reduction="sum")
    terms = {"classes": functional.cross_entropy(logits, labels), "boxes": distance / max(len(chosen), 1)}
    if n:
        mask_logits = network.segment(pyramid, boxes[:n]).float()[index, labels[:n]]
        covered = mask_targets(true.masks, boxes[:n], own[:n], mask_logits.shape[-1])
        terms["masks"] = functional.binary_cross_entropy_with_logits(mask_logits, covered)
    else:
        terms["masks"] = logits.sum() * 0.0  # keeps a gradient path for images without objects
    return terms


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union (N, M) for each pair of boxes `a` (N, 4) and `b` (M, 4)."""
    low = torch.maximum(a[:, None, :2], b[None, :, :2])
    high = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(dim=2)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(dim=1), (b[:, 2:] - b[:, :2]).prod(dim=1)
    return shared / (area_a[:, None] + area_b[None, :] - shared).clamp(min=1e-9)


def match(iou: Tensor, foreground: float, background: float, each_object: bool) -> Tensor:
    """Assign ground-truth objects to boxes.

    A box is assigned to its best object if their IoU is at least `foreground`. It becomes BACKGROUND if the IoU is
    below `background`, otherwise IGNORED.

    Args:
        iou: The IoU (N, M) of N boxes with M objects.
        foreground: The minimum IoU for an assignment.
        background: The IoU below which a box is background.
        each_object: True = also assign the boxes with the highest IoU of each object, even below `foreground`.

    Returns:
        The index of the assigned object, BACKGROUND or IGNORED for each box (N,).
    """
    if iou.shape[1] == 0:
        return torch.full((len(iou),), BACKGROUND, device=iou.device)
    best, matched = iou.max(dim=1)
    own = matched.clone()
    own[best < foreground] = IGNORED
    own[best < background] = BACKGROUND
    if each_object:
        highest = iou.max(dim=0).values
        fits = ((iou == highest[None, :]) & (highest[None, :] > 0)).any(dim=1)
        own[fits] = matched[fits]
    return own


def sample(own: Tensor, count: int, positive_fraction: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw a random sample of boxes with an object and of background boxes.

    Args:
        own: The assigned object (N,) of each box, from `match`.
        count: The maximum number of boxes.
        positive_fraction: The maximum fraction of boxes with an object.
        generator: The random number generator.

    Returns:
        The indices of the boxes with an object, and of the background boxes.
    """
    positive = _draw(torch.nonzero(own >= 0)[:, 0], int(count * positive_fraction), generator)
    negative = _draw(torch.nonzero(own == BACKGROUND)[:, 0], count - len(positive), generator)
    return positive, negative


def _draw(indices: Tensor, count: int, generator: torch.Generator) -> Tensor:
    chosen = torch.randperm(len(indices), generator=generator)[:count]
    return indices[chosen.to(indices.device)]


def encode(boxes: Tensor, objects: Tensor) -> Tensor:
    """Return the deltas (N, 4) dx dy dw dh that move boxes (N, 4) to objects (N, 4).

    This is the inverse of `framework.detection.masks.boxes.decode`.
    """
    sizes, wanted = boxes[:, 2:] - boxes[:, :2], objects[:, 2:] - objects[:, :2]
    centers, targets = boxes[:, :2] + sizes / 2, objects[:, :2] + wanted / 2
    return torch.cat([(targets - centers) / sizes, torch.log(wanted / sizes)], dim=1)


def mask_targets(masks: Tensor, boxes: Tensor, own: Tensor, bins: int) -> Tensor:
    """Return the target masks (N, bins, bins) of boxes.

    The target is 1 in bins that are at least half covered by the object, and 0 in other bins.

    Args:
        masks: The masks (M, H, W) of the objects.
        boxes: The boxes (N, 4), px.
        own: The index of the object (N,) of each box.
        bins: The number of bins per side.
    """
    # pixel centers are at half-integer coordinates
    targets = torch.empty((len(boxes), bins, bins), device=boxes.device)
    for k in torch.unique(own).tolist():
        of_object = own == k
        mask = masks[k].to(boxes.dtype)[None, None]
        targets[of_object] = roi_align(mask, boxes[of_object], bins, 1.0, 2, half_pixel=True)[:, 0]
    return (targets >= 0.5).to(boxes.dtype)
