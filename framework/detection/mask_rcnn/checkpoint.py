"""Reading of a Mask R-CNN from this project's, torchvision's or detectron2's files."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

import torch
from torch import Tensor

from framework.detection.mask_rcnn.detectron2_checkpoint import from_detectron2, read_pickle
from framework.detection.mask_rcnn.network import MaskRCNN
from framework.detection.mask_rcnn.network_file import describe_network, load_network
from framework.detection.mask_rcnn.torchvision_checkpoint import from_torchvision
from framework.errors import DataError
from framework.files.atomic_write import check_regular


class CheckpointKind(Enum):
    """The library that wrote a checkpoint."""

    TORCHVISION = "torchvision"
    DETECTRON2 = "detectron2"


def read_network(
    path: Path, kind: CheckpointKind | None = None, classes: tuple[str, ...] | None = None, norm_eps: float = 0.0
) -> MaskRCNN:
    """Return the network in `path`, in float32 and inference mode.

    .safetensors is this project's format and describes itself. For .pkl and .pth, `kind` None = by the names of the
    weights; see `from_torchvision` and `from_detectron2` for the other arguments. Code in the file is never run.
    Raises DataError if the file has no such network.
    """
    if path.suffix == ".safetensors":
        return load_network(path)
    state = read_pickle(path) if path.suffix == ".pkl" else _read_torch(path)
    if kind is CheckpointKind.DETECTRON2 or (kind is None and any(n.startswith("backbone.bottom_up.") for n in state)):
        return from_detectron2(state, str(path), classes)
    if kind is CheckpointKind.TORCHVISION or "backbone.body.conv1.weight" in state:
        return from_torchvision(state, str(path), classes, norm_eps)
    raise DataError(f"{path} has the weights of no Mask R-CNN of torchvision or detectron2 with a feature pyramid")


def domain_of_network(path: Path) -> str:
    """Return the only domain that the network in `path` is for, from its card; "" = any."""
    return str(describe_network(path).card.get("domain", "")) if path.suffix == ".safetensors" else ""


def _read_torch(path: Path) -> dict[str, Tensor]:
    """Return the state_dict in a file of torch.save."""
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
