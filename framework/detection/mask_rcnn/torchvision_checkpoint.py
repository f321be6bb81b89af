"""torchvision's Mask R-CNN with ResNet-FPN (github.com/pytorch/vision, models/detection), as a MaskRCNN."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.network_file import filled, required
from framework.detection.mask_rcnn.resnet import DEPTHS, WITH_BOTTLENECKS, ResNetShape
from framework.errors import DataError
from framework.vocabulary.label_spaces import COCO

COCO_GAPS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""Category ids of COCO, up to 90, that were never annotated."""

COCO_LABELS = 1 + len(COCO) + len(COCO_GAPS)
NEWER_NAMES = (  # since 0.13, torchvision wraps its convolutions; older checkpoints have the bare names
    (r"(fpn\.(?:inner|layer)_blocks\.\d)\.(weight|bias)", r"\1.0.\2"),
    (r"rpn\.head\.conv\.(weight|bias)", r"rpn.head.conv.0.0.\1"),
    (r"roi_heads\.mask_head\.mask_fcn(\d)\.(weight|bias)", lambda m: f"roi_heads.mask_head.{int(m[1]) - 1}.0.{m[2]}"),
)


def from_torchvision(
    state: Mapping[str, Tensor], where: str, classes: tuple[str, ...] | None = None, norm_eps: float = 0.0
) -> MaskRCNN:
    """Return the network of a state_dict with torchvision's conventions.

    `classes`: the labels after the background; None = COCO's 91 labels, without the rows of the gaps in COCO's ids,
    which were trained only as negatives. `norm_eps`: 0 for torchvision's published checkpoint, 1e-5 for networks
    trained with its defaults. Raises DataError, starting with the source `where`, for other networks.
    """
    tensors = {_newer_name(name): tensor for name, tensor in state.items()}
    labels = len(required(tensors, "roi_heads.box_predictor.cls_score.bias", where))
    if classes is None:
        if labels != COCO_LABELS:
            raise DataError(f"{where}: {labels} labels are not COCO's {COCO_LABELS}: the classes must be given")
        tensors, classes = _without_gaps(tensors), COCO
    elif len(classes) != labels - 1:
        raise DataError(f"{where}: the network has {labels - 1} classes, {len(classes)} were given")
    architecture = Architecture(
        classes=classes,
        backbone=_backbone(tensors, norm_eps, where),
        fpn_channels=len(required(tensors, "backbone.fpn.inner_blocks.0.0.bias", where)),
        head_features=len(required(tensors, "roi_heads.box_head.fc6.bias", where)),
        truncated_strides=True,
    )
    return filled(architecture, tensors, where)


def _newer_name(name: str) -> str:
    for old, new in NEWER_NAMES:
        name = re.sub(f"{old}$", new, name)
    return name


def _without_gaps(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors with the predictors' rows of the background and the 80 classes only."""
    rows = torch.tensor([label for label in range(COCO_LABELS) if label not in COCO_GAPS])
    sliced = dict(tensors)
    for kind in ("weight", "bias"):
        for layer in ("roi_heads.box_predictor.cls_score", "roi_heads.mask_predictor.mask_fcn_logits"):
            sliced[f"{layer}.{kind}"] = tensors[f"{layer}.{kind}"][rows]
        deltas = tensors[f"roi_heads.box_predictor.bbox_pred.{kind}"]
        kept = deltas.unflatten(0, (COCO_LABELS, 4))[rows]  # type: ignore[no-untyped-call]
        sliced[f"roi_heads.box_predictor.bbox_pred.{kind}"] = kept.flatten(0, 1)
    return sliced


def _backbone(tensors: Mapping[str, Tensor], norm_eps: float, where: str) -> ResNetShape:
    """Return the residual network, by the number of blocks of each level."""
    depths = tuple(
        len({match[1] for name in tensors if (match := re.match(rf"backbone\.body\.layer{level}\.(\d+)\.", name))})
        for level in (1, 2, 3, 4)
    )
    bottlenecks = "backbone.body.layer1.0.conv3.weight" in tensors
    for name, expected in DEPTHS.items():
        if expected == depths and (name in WITH_BOTTLENECKS) == bottlenecks:
            width = len(required(tensors, "backbone.body.conv1.weight", where))
            return ResNetShape(name, width, norm_eps=norm_eps)
    raise DataError(f"{where}: there is no residual network here with {depths} blocks")
