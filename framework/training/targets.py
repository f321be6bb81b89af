"""What a Mask R-CNN should have said: which anchors and proposals belong to which objects, and what they lack.

After Ren et al., "Faster R-CNN" (2015), and He et al., "Mask R-CNN" (2017). Boxes are x1 y1 x2 y2 px, of extent 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from framework.detection.mask_rcnn.roi_align import roi_align

BACKGROUND, IGNORED = -1, -2  # in place of an object's index


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """The (N, M) intersections over unions of boxes (N, 4) and (M, 4)."""
    low = torch.maximum(a[:, None, :2], b[None, :, :2])
    high = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(dim=2)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(dim=1), (b[:, 2:] - b[:, :2]).prod(dim=1)
    return shared / (area_a[:, None] + area_b[None, :] - shared).clamp(min=1e-9)


def match(iou: Tensor, foreground: float, background: float, each_object: bool) -> Tensor:
    """The (N,) object of each box, from iou (N, M): its best one if at least `foreground`, BACKGROUND below
    `background`, IGNORED between.

    With `each_object`, every object also gets the boxes that fit it best, however badly.
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


def sample(own: Tensor, number: int, positive_share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Indices of at most `number` boxes, drawn at random: (those with an object, at most a share, the background)."""
    positive = _draw(torch.nonzero(own >= 0)[:, 0], int(number * positive_share), generator)
    negative = _draw(torch.nonzero(own == BACKGROUND)[:, 0], number - len(positive), generator)
    return positive, negative


def _draw(indices: Tensor, number: int, generator: torch.Generator) -> Tensor:
    chosen = torch.randperm(len(indices), generator=generator)[:number]
    return indices[chosen.to(indices.device)]


def encode(boxes: Tensor, objects: Tensor) -> Tensor:
    """The deltas dx dy dw dh (N, 4) that move `boxes` (N, 4) onto `objects` (N, 4): the inverse of boxes.decode."""
    sizes, wanted = boxes[:, 2:] - boxes[:, :2], objects[:, 2:] - objects[:, :2]
    centers, aims = boxes[:, :2] + sizes / 2, objects[:, :2] + wanted / 2
    return torch.cat([(aims - centers) / sizes, torch.log(wanted / sizes)], dim=1)


def mask_targets(masks: Tensor, boxes: Tensor, own: Tensor, bins: int) -> Tensor:
    """The (N, bins, bins) share of each bin of boxes (N, 4) that the mask of its object, own (N,), covers, 0 or 1.

    masks (M, H, W) bool, with pixel centres half a pixel inside the borders, as boxes of extent 0 have it.
    """
    targets = torch.empty((len(boxes), bins, bins), device=boxes.device)
    for k in torch.unique(own).tolist():
        of_object = own == k
        mask = masks[k].to(boxes.dtype)[None, None]
        targets[of_object] = roi_align(mask, boxes[of_object], bins, 1.0, 2, half_pixel=True)[:, 0]
    return (targets >= 0.5).to(boxes.dtype)
