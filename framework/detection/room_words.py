"""A tiny network that knows rendered rooms in words: twelve colours and nine classes.

Image tower: four convolutions on a picture of 64x64 px with the object's mask as its fourth channel; what it says is
the mean over the object of fine and coarse features. Text tower: a vector a word, added up (a bag of words).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import safetensors
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from framework.data import Float32, UInt8
from framework.detection.embeddings.image_text import ImageTextModel, unit_rows
from framework.errors import DataError, in_one_line
from framework.files.atomic_write import check_regular, written_whole
from framework.files.hashing import path_hash
from framework.files.json_file import parse_json
from framework.vocabulary.color_names import COLOR_NAMES
from framework.vocabulary.text_queries import object_words

SIDE = 64  # px
CHANNELS = (24, 48, 64, 96)
DIMENSION = 64
LARGEST_FILE = 2**24  # bytes
MOST_WORDS = 1000
HASH_DIGITS = 16  # of a file's SHA-256 in the name of its space

Fact = str | int | float | bool | None


class RoomWordsNetwork(nn.Module):
    """Both towers. `words` are the colours and classes that it knows."""

    def __init__(self, words: Sequence[str]) -> None:
        super().__init__()
        self.words = tuple(words)
        layers: list[nn.Module] = []
        before = 4
        for channels in CHANNELS:
            layers.append(
                nn.Sequential(
                    nn.Conv2d(before, channels, 5 if before == 4 else 3, 2, 2 if before == 4 else 1, bias=False),
                    nn.BatchNorm2d(channels),
                    nn.ReLU(inplace=True),
                )
            )
            before = channels
        self.layers = nn.ModuleList(layers)
        pooled = CHANNELS[0] + CHANNELS[1] + 2 * CHANNELS[3] + 3
        self.head = nn.Sequential(nn.Linear(pooled, 128), nn.ReLU(inplace=True), nn.Linear(128, DIMENSION))
        self.text = nn.Embedding(len(self.words), DIMENSION)
        self.log_scale = nn.Parameter(torch.tensor(2.3))

    def embed_pictures(self, pictures: Tensor) -> Tensor:
        """Unit vectors (N, D) of pictures (N, 4, SIDE, SIDE) in [0, 1], the object's mask last."""
        mask = pictures[:, 3:]
        features, pooled = pictures - 0.5, [_mean_inside(pictures[:, :3], mask)]
        for k, layer in enumerate(self.layers):
            features = layer(features)
            mask = functional.avg_pool2d(mask, 2)
            if k in (0, 1, 3):
                pooled.append(_mean_inside(features, mask))
        pooled.append(features.mean(dim=(2, 3)))
        return functional.normalize(self.head(torch.cat(pooled, dim=1)), dim=1)

    def embed_words(self, bags: Tensor) -> Tensor:
        """Unit vectors (M, D) of bags of words (M, W): 1 where a word is in it."""
        return functional.normalize(bags @ self.text.weight, dim=1)


def _mean_inside(features: Tensor, mask: Tensor) -> Tensor:
    """(N, C) the mean of features (N, C, H, W) where the mask (N, 1, H, W) is."""
    return (features * mask).sum(dim=(2, 3)) / mask.sum(dim=(2, 3)).clamp(min=1e-3)


class RoomWords(ImageTextModel):
    """The network of a file."""

    side = SIDE
    sees_mask = True

    def __init__(self, path: Path, device: torch.device) -> None:
        self._network = load_room_words(path).to(device)
        self._device = device
        self._classes = tuple(word for word in self._network.words if word not in COLOR_NAMES)
        self.space = f"{path.name}@{path_hash(path)[:HASH_DIGITS]}"

    @torch.inference_mode()
    def embed_crops(self, crops: UInt8) -> Float32:
        if not len(crops):
            return np.zeros((0, DIMENSION), np.float32)
        embedded = self._network.embed_pictures(as_pictures(torch.from_numpy(crops).to(self._device)))
        return unit_rows(embedded.cpu().numpy(), self.space)

    @torch.inference_mode()
    def embed_text(self, text: str) -> Float32:
        words = object_words(text, self._classes)
        known = [*words.colors, *words.classes]
        if words.unknown or not known:
            unknown = f"{', '.join(map(repr, words.unknown))} in {text!r}" if words.unknown else repr(text)
            raise DataError(
                f"{self.space} does not know {unknown}; it knows {', '.join(COLOR_NAMES)}, {', '.join(self._classes)}"
            )
        embedded = self._network.embed_words(bags_of([known], self._network.words).to(self._device))
        return np.asarray(unit_rows(embedded.cpu().numpy(), self.space)[0])


def as_pictures(crops: Tensor) -> Tensor:
    """The network's input (N, 4, SIDE, SIDE) of crops (N, SIDE, SIDE, 4) uint8."""
    return crops.permute(0, 3, 1, 2).float() / 255


def bags_of(texts: Sequence[Sequence[str]], words: Sequence[str]) -> Tensor:
    """Bags (M, W) of texts that are lists of known words."""
    bags = torch.zeros(len(texts), len(words))
    for k, text in enumerate(texts):
        for word in text:
            bags[k, words.index(word)] = 1
    return bags


def save_room_words(network: RoomWordsNetwork, path: Path, card: Mapping[str, Fact]) -> None:
    """Writes the network, its weights as float16 but for biases and statistics, and what is said of it in the card."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    halved = {name: tensor.half() if tensor.ndim >= 2 else tensor for name, tensor in tensors.items()}
    metadata = {"kind": "room_words", "words": json.dumps(network.words), "card": json.dumps(dict(card))}
    with written_whole(path) as temporary:
        save_file(halved, temporary, metadata)


def load_room_words(path: Path) -> RoomWordsNetwork:
    """The network in `path`, ready to run. Raises DataError when it is no such file."""
    check_regular(path)
    if path.stat().st_size > LARGEST_FILE:
        raise DataError(f"{path} has {path.stat().st_size} bytes, more than the {LARGEST_FILE} of such a network")
    try:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as error:
        raise DataError(f"{path} is no safetensors file: {in_one_line(error)}") from error
    if metadata.get("kind") != "room_words":
        raise DataError(f"{path} is of another kind of network; train-words writes those that are meant")
    words = parse_json(f"{path}: words", metadata.get("words", "null").encode())
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words) or len(words) > MOST_WORDS:
        raise DataError(f"{path}: its words must be a list of at most {MOST_WORDS} names, found {words!r:.60}")
    network = RoomWordsNetwork(words)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{path} does not have the weights of such a network: {in_one_line(error)}") from error
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise DataError(f"{path}: its weights are not all finite")
    return network.requires_grad_(False).eval()
