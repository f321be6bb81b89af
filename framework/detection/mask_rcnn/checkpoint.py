"""A Mask R-CNN from whichever file it is in: this project's, torchvision's or detectron2's."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path

import torch
from torch import Tensor

from framework.detection.mask_rcnn.detectron2_checkpoint import from_detectron2, is_detectron2, read_pickle
from framework.detection.mask_rcnn.network import MaskRCNN
from framework.detection.mask_rcnn.network_file import describe_network, load_network
from framework.detection.mask_rcnn.torchvision_checkpoint import from_torchvision, is_torchvision
from framework.errors import DataError
from framework.files.atomic_write import check_regular


class CheckpointKind(Enum):
    """Who wrote it."""

    TORCHVISION = "torchvision"
    DETECTRON2 = "detectron2"


def read_network(
    path: Path, kind: CheckpointKind | None = None, classes: tuple[str, ...] | None = None, norm_eps: float = 0.0
) -> MaskRCNN:
    """The network in `path`, in float32 and ready to run.

    .safetensors is this project's own format and says all of itself. Of a .pkl or .pth, the names of the weights say
    whose it is, unless `kind` does; see `from_torchvision` for `classes` and `norm_eps`, and `from_detectron2`. No code
    that a file may contain is run. Raises DataError when there is no such network in it.
    """
    if path.suffix == ".safetensors":
        return load_network(path)
    state = read_pickle(path) if path.suffix == ".pkl" else _read_torch(path)
    if kind is None:
        kind = _kind(state, path)
    if kind is CheckpointKind.DETECTRON2:
        return from_detectron2(state, str(path), classes)
    return from_torchvision(state, str(path), classes, norm_eps)


def domain_of_network(path: Path) -> str:
    """The only pictures that the network in `path` is for, as its card says; "" where it says nothing."""
    return str(describe_network(path).card.get("domain", "")) if path.suffix == ".safetensors" else ""


def _read_torch(path: Path) -> dict[str, Tensor]:
    """The state_dict in a file of torch.save."""
    check_regular(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can raise almost anything
        reason = str(error).splitlines() or [type(error).__name__]
        raise DataError(f"{path} is damaged, or no file of weights alone: {reason[0]}") from error
    state = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        raise DataError(f"{path} must hold a state_dict, names and tensors, by itself or as `model`")
    return state


def _kind(state: Mapping[str, Tensor], path: Path) -> CheckpointKind:
    if is_detectron2(state):
        return CheckpointKind.DETECTRON2
    if is_torchvision(state):
        return CheckpointKind.TORCHVISION
    raise DataError(f"{path} has the weights of no Mask R-CNN of torchvision or detectron2 with a feature pyramid")
