"""Reader of Mask R-CNN weights from torchvision, detectron2 and this project."""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import Enum
from pathlib import Path

import torch
from torch import Tensor

from framework.detection.mask_rcnn.detectron2_checkpoint import from_detectron2, read_pickle
from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.network_file import describe_network, filled, load_network, required
from framework.detection.mask_rcnn.resnet import DEPTHS, WITH_BOTTLENECKS, ResNetShape
from framework.errors import DataError
from framework.files.atomic_write import check_regular
from framework.vocabulary.label_spaces import COCO, COCO_BY_ID, NO_CLASS

COCO_ROWS = [0, *(k for k, name in enumerate(COCO_BY_ID) if name != NO_CLASS)]
"""Rows of the background and the 80 annotated classes among the 91 labels of torchvision."""

NEWER_NAMES = (  # torchvision 0.13 introduced wrapped convolutions; older checkpoints have names without the wrapper
    (r"(fpn\.(?:inner|layer)_blocks\.\d)\.(weight|bias)", r"\1.0.\2"),
    (r"rpn\.head\.conv\.(weight|bias)", r"rpn.head.conv.0.0.\1"),
    (r"roi_heads\.mask_head\.mask_fcn(\d)\.(weight|bias)", lambda m: f"roi_heads.mask_head.{int(m[1]) - 1}.0.{m[2]}"),
)


class CheckpointKind(Enum):
    """The library that wrote a checkpoint."""

    TORCHVISION = "torchvision"
    DETECTRON2 = "detectron2"


def read_network(
    path: Path, kind: CheckpointKind | None = None, classes: tuple[str, ...] | None = None, norm_eps: float = 0.0
) -> MaskRCNN:
    """Load a network in float32 and inference mode.

    Code in the file is never run.

    Args:
        path: A .safetensors file of this project, or a .pkl or .pth file of detectron2 or torchvision.
        kind: The library that wrote a .pkl or .pth file; None = detected from the names of the weights.
        classes: The class names; None = COCO.
        norm_eps: The epsilon of the batch normalization, see `from_torchvision`.

    Raises:
        DataError: The file does not contain a Mask R-CNN with a feature pyramid.
    """
    if path.suffix == ".safetensors":
        return load_network(path)
    state = read_pickle(path) if path.suffix == ".pkl" else _read_torch(path)
    if kind is CheckpointKind.DETECTRON2 or (kind is None and any(n.startswith("backbone.bottom_up.") for n in state)):
        return from_detectron2(state, str(path), classes)
    if kind is CheckpointKind.TORCHVISION or "backbone.body.conv1.weight" in state:
        return from_torchvision(state, str(path), classes, norm_eps)
    raise DataError(
        f"{path}: expected a Mask R-CNN of torchvision or detectron2 with a feature pyramid, got the weights "
        f"{', '.join(sorted(map(str, state))[:3]) or 'none'}"
    )


def domain_of_network(path: Path) -> str:
    """Return the image domain in the model card of a network, or "" if any images are suitable."""
    return str(describe_network(path).card.get("domain", "")) if path.suffix == ".safetensors" else ""


def _read_torch(path: Path) -> dict[str, Tensor]:
    """Read the state_dict from a file that was written by torch.save."""
    check_regular(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can raise almost any exception
        reason = str(error).splitlines() or [type(error).__name__]
        raise DataError(
            f"{path}: expected a file with weights only, got a damaged or unsupported file: {reason[0]}"
        ) from error
    state = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        raise DataError(
            f"{path}: expected a state_dict of tensors, alone or under the key `model`, got {type(content).__name__}"
        )
    return state


def from_torchvision(
    state: Mapping[str, Tensor], where: str, classes: tuple[str, ...] | None = None, norm_eps: float = 0.0
) -> MaskRCNN:
    """Build the network from a state_dict of torchvision.

    Args:
        state: The state_dict.
        where: The source of the state_dict, for messages.
        classes: The class names without the background; None = COCO.
        norm_eps: The epsilon of the batch normalization. It is 0 for the published checkpoint, and 1e-5 for networks
            trained with default parameters.

    Raises:
        DataError: The state_dict is not from a Mask R-CNN with a feature pyramid.
    """
    tensors = {_newer_name(name): tensor for name, tensor in state.items()}
    labels = len(required(tensors, "roi_heads.box_predictor.cls_score.bias", where))
    if classes is None:
        if labels != len(COCO_BY_ID):
            raise DataError(
                f"{where}: expected COCO's {len(COCO_BY_ID)} labels, got {labels}; set the classes with --classes"
            )
        tensors, classes = _without_gaps(tensors), COCO
    elif len(classes) != labels - 1:
        raise DataError(f"{where}: expected {labels - 1} classes, got {len(classes)}; set them with --classes")
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
    """Remove the rows of unused COCO ids from the predictors."""
    rows = torch.tensor(COCO_ROWS)
    sliced = dict(tensors)
    for kind in ("weight", "bias"):
        for layer in ("roi_heads.box_predictor.cls_score", "roi_heads.mask_predictor.mask_fcn_logits"):
            sliced[f"{layer}.{kind}"] = tensors[f"{layer}.{kind}"][rows]
        deltas = tensors[f"roi_heads.box_predictor.bbox_pred.{kind}"]
        kept = deltas.unflatten(0, (len(COCO_BY_ID), 4))[rows]  # type: ignore[no-untyped-call]
        sliced[f"roi_heads.box_predictor.bbox_pred.{kind}"] = kept.flatten(0, 1)
    return sliced


def _backbone(tensors: Mapping[str, Tensor], norm_eps: float, where: str) -> ResNetShape:
    """Identify the residual network by the number of blocks in each level."""
    depths = tuple(
        len({match[1] for name in tensors if (match := re.match(rf"backbone\.body\.layer{level}\.(\d+)\.", name))})
        for level in (1, 2, 3, 4)
    )
    bottlenecks = "backbone.body.layer1.0.conv3.weight" in tensors
    for name, expected in DEPTHS.items():
        if expected == depths and (name in WITH_BOTTLENECKS) == bottlenecks:
            width = len(required(tensors, "backbone.body.conv1.weight", where))
            return ResNetShape(name, width, norm_eps=norm_eps)
    known = ", ".join(f"{name} {blocks}" for name, blocks in DEPTHS.items())
    found = f"{depths} blocks {'with' if bottlenecks else 'without'} bottlenecks"
    raise DataError(f"{where}: expected the numbers of blocks of {known}, got {found}")
