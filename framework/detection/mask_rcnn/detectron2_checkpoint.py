"""Converter for Mask R-CNN with ResNet-FPN from detectron2 (github.com/facebookresearch/detectron2).

The conventions differ from those of torchvision:

- Images are BGR with a standard deviation of 1.
- The first convolution of a bottleneck has the stride, as in MSRA's networks.
- The background is the last class and has no deltas or masks.
- RoIAlign is aligned, with one sample per cell.
- Anchors are not rounded.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.network_file import filled, required
from framework.detection.mask_rcnn.resnet import DEPTHS, WITH_BOTTLENECKS, ResNetShape
from framework.errors import DataError, in_one_line
from framework.files.atomic_write import check_regular
from framework.vocabulary.label_spaces import COCO

PIXEL_MEAN = (123.675, 116.28, 103.53)  # RGB
PIXEL_STD = (1.0, 1.0, 1.0)
NAMES = (  # detectron2 name, name in this project
    (r"backbone\.bottom_up\.stem\.conv1\.weight", r"backbone.body.conv1.weight"),
    (r"backbone\.bottom_up\.stem\.conv1\.norm\.(\w+)", r"backbone.body.bn1.\1"),
    (r"backbone\.bottom_up\.res(\d)\.(\d+)\.conv(\d)\.weight", r"backbone.body.layer\1.\2.conv\3.weight"),
    (r"backbone\.bottom_up\.res(\d)\.(\d+)\.conv(\d)\.norm\.(\w+)", r"backbone.body.layer\1.\2.bn\3.\4"),
    (r"backbone\.bottom_up\.res(\d)\.(\d+)\.shortcut\.weight", r"backbone.body.layer\1.\2.downsample.0.weight"),
    (r"backbone\.bottom_up\.res(\d)\.(\d+)\.shortcut\.norm\.(\w+)", r"backbone.body.layer\1.\2.downsample.1.\3"),
    (r"backbone\.fpn_lateral(\d)\.(\w+)", r"backbone.fpn.inner_blocks.\1.0.\2"),
    (r"backbone\.fpn_output(\d)\.(\w+)", r"backbone.fpn.layer_blocks.\1.0.\2"),
    (r"proposal_generator\.rpn_head\.conv\.(\w+)", r"rpn.head.conv.0.0.\1"),
    (r"proposal_generator\.rpn_head\.objectness_logits\.(\w+)", r"rpn.head.cls_logits.\1"),
    (r"proposal_generator\.rpn_head\.anchor_deltas\.(\w+)", r"rpn.head.bbox_pred.\1"),
    (r"roi_heads\.box_head\.fc1\.(\w+)", r"roi_heads.box_head.fc6.\1"),
    (r"roi_heads\.box_head\.fc2\.(\w+)", r"roi_heads.box_head.fc7.\1"),
    (r"roi_heads\.box_predictor\.(cls_score|bbox_pred)\.(\w+)", r"roi_heads.box_predictor.\1.\2"),
    (r"roi_heads\.mask_head\.mask_fcn(\d)\.(\w+)", r"roi_heads.mask_head.\1.0.\2"),
    (r"roi_heads\.mask_head\.deconv\.(\w+)", r"roi_heads.mask_predictor.conv5_mask.\1"),
    (r"roi_heads\.mask_head\.predictor\.(\w+)", r"roi_heads.mask_predictor.mask_fcn_logits.\1"),
)
COUNTED_FROM = {"layer": 1, "inner_blocks": 2, "layer_blocks": 2, "mask_head": 1}
"""Index in detectron2 minus index here: res2 is layer1, fpn_lateral2 is inner block 0, mask_fcn1 is mask layer 0."""

NOT_WEIGHTS = r"(pixel_mean|pixel_std|.*\.cell_anchors\.\d+|.*\.num_batches_tracked)"


def from_detectron2(state: Mapping[str, Tensor], where: str, classes: tuple[str, ...] | None = None) -> MaskRCNN:
    """Build the network from a state_dict of detectron2.

    Args:
        state: The state_dict.
        where: The source of the state_dict, for messages.
        classes: The class names; None = COCO.

    Raises:
        DataError: The state_dict is not from a Mask R-CNN with ResNet-FPN.
    """
    _check_input(state, where)
    tensors = {_renamed(name, where): tensor for name, tensor in state.items() if not re.fullmatch(NOT_WEIGHTS, name)}
    found = len(required(tensors, "roi_heads.mask_predictor.mask_fcn_logits.bias", where))
    if classes is None and found != len(COCO):
        raise DataError(f"{where}: expected COCO's {len(COCO)} classes, got {found}; set the classes with --classes")
    classes = classes or COCO
    if len(classes) != found:
        raise DataError(f"{where}: expected {found} classes, got {len(classes)}; set them with --classes")
    stem = "backbone.body.conv1.weight"
    tensors[stem] = required(tensors, stem, where).flip(1)  # BGR to RGB
    _put_background_first(tensors, where)
    architecture = Architecture(
        classes=classes,
        backbone=ResNetShape(_depth(tensors, where), len(tensors[stem]), stride_in_1x1=True),
        fpn_channels=len(required(tensors, "backbone.fpn.inner_blocks.0.0.bias", where)),
        head_features=len(required(tensors, "roi_heads.box_head.fc6.bias", where)),
        anchor_sides=_anchor_sides(state, where),
        rounded_anchors=False,
        sampling_ratio=0,
        half_pixel=True,
        pixel_mean=PIXEL_MEAN,
        pixel_std=PIXEL_STD,
    )
    return filled(architecture, tensors, where)


def read_pickle(path: Path) -> dict[str, Tensor]:
    """Read the state_dict from a .pkl file of detectron2 without running code from the file.

    Raises:
        DataError: The file is damaged or contains objects other than arrays.
    """
    check_regular(path)
    try:
        with path.open("rb") as file:
            content = ArraysOnly(file, encoding="latin1").load()
    except Exception as error:  # a damaged pickle can raise almost any exception
        raise DataError(f"{path}: expected a pickle of numpy arrays, got an error ({in_one_line(error)})") from error
    state = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(array, np.ndarray) for array in state.values()):
        raise DataError(f"{path}: expected a dictionary of detectron2's numpy arrays, got {type(content).__name__}")
    numeric = {name: array for name, array in state.items() if array.dtype.kind in "fiu"}
    if len(numeric) < len(state):
        name = min(state.keys() - numeric.keys())
        raise DataError(f"{path}: expected arrays of numbers, got {name} of type {state[name].dtype}")
    return {str(name): torch.from_numpy(np.array(array)) for name, array in numeric.items()}


class ArraysOnly(pickle.Unpickler):
    """Unpickler that accepts only numpy arrays."""

    def find_class(self, module: str, name: str) -> Any:
        if (allowed := ALLOWED.get((module.replace("numpy._core", "numpy.core"), name))) is None:
            raise pickle.UnpicklingError(f"a call of {module}.{name}")
        return allowed


def _encoded(text: str, encoding: str) -> bytes:
    """Return the bytes that pickle protocols before 3 store as `text`."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"the encoding {encoding}")
    return text.encode("latin1")


ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce_ex__(2)[0],
    ("numpy.core.numeric", "_frombuffer"): np.empty(0).__reduce_ex__(5)[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("collections", "OrderedDict"): dict,
    ("_codecs", "encode"): _encoded,
}


def _renamed(name: str, where: str) -> str:
    for theirs, ours in NAMES:
        if re.fullmatch(theirs, name):
            return re.sub(
                r"(layer|inner_blocks\.|layer_blocks\.|mask_head\.)(\d)",
                lambda match: f"{match[1]}{int(match[2]) - COUNTED_FROM[match[1].rstrip('.')]}",
                re.sub(theirs, ours, name),
                count=1,
            )
    raise DataError(f"{where}: expected a Mask R-CNN with ResNet and feature pyramid, got the weights {name}")


def _check_input(state: Mapping[str, Tensor], where: str) -> None:
    """Raise DataError if the checkpoint contains an unsupported image normalization."""
    # only older checkpoints contain the normalization; other values indicate another backbone
    for name, expected in (("pixel_mean", PIXEL_MEAN[::-1]), ("pixel_std", PIXEL_STD)):
        if name in state and not torch.allclose(state[name].float().flatten(), torch.tensor(expected), atol=1e-2):
            found = [round(value, 3) for value in state[name].flatten().tolist()]
            origin = "as in networks initialized with MSRA weights"
            raise DataError(f"{where}: {name}: expected {expected}, {origin}, got {found}")


def _anchor_sides(state: Mapping[str, Tensor], where: str) -> tuple[float, ...]:
    """Return the anchor size of each pyramid level, px."""
    sides = list(Architecture.anchor_sides)  # default of detectron2; only older checkpoints contain anchors
    for level in range(len(sides)):
        if (anchors := state.get(f"proposal_generator.anchor_generator.cell_anchors.{level}")) is None:
            continue
        width, height = (anchors[:, 2:] - anchors[:, :2]).double().unbind(1)
        sides[level] = round(float((width * height).sqrt().mean()), 3)
        ratios = torch.tensor(Architecture.anchor_ratios, dtype=torch.float64)
        if len(anchors) != len(ratios) or not torch.allclose(height / width, ratios, rtol=1e-3):
            found = [round(ratio, 3) for ratio in (height / width).tolist()]
            raise DataError(f"{where}: expected anchors with the ratios 0.5, 1 and 2 in level {level}, got {found}")
    return tuple(sides)


def _put_background_first(tensors: dict[str, Tensor], where: str) -> None:
    """Move the scores of the background to the front, and add zeros as its deltas and masks."""
    for kind in ("weight", "bias"):
        name = f"roi_heads.box_predictor.cls_score.{kind}"
        tensors[name] = required(tensors, name, where).roll(1, dims=0)
        for name, rows in (("box_predictor.bbox_pred", 4), ("mask_predictor.mask_fcn_logits", 1)):
            predictor = required(tensors, f"roi_heads.{name}.{kind}", where)
            background = predictor.new_zeros((rows, *predictor.shape[1:]))
            tensors[f"roi_heads.{name}.{kind}"] = torch.cat([background, predictor])


def _depth(tensors: Mapping[str, Tensor], where: str) -> str:
    """Identify the residual network by the number of blocks in its third level."""
    blocks = len({name.split(".")[3] for name in tensors if name.startswith("backbone.body.layer3.")})
    for name in WITH_BOTTLENECKS:
        if DEPTHS[name][2] == blocks:
            return name
    known = " or ".join(f"{DEPTHS[name][2]} blocks ({name})" for name in WITH_BOTTLENECKS)
    raise DataError(f"{where}: expected {known} in res4, got {blocks} blocks")
