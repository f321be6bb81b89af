"""Training of the network that knows rooms in words (framework/detection/room_words.py), by contrast.

InfoNCE (van den Oord et al. 2018; Radford et al. 2021): a picture is nearer to the words for it than to any other words
that there are. The words of a room are few, so that all of them are in each step: "red chair" among all colours and
classes, "red" among the colours, "chair" among the classes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from framework.config.validation import require
from framework.detection.room_words import RoomWordsNetwork, as_pictures, bags_of
from framework.training.room_crops import Crops
from framework.vocabulary.color_names import COLOR_NAMES
from framework.vocabulary.label_spaces import COCO

CROP_BATCH = 256  # pictures that are evaluated at once
BRIGHTNESS = 0.25  # by how much a picture may be brighter or darker, as a logarithm
WARMTH = 0.06  # by how much one of its channels may


@dataclass(frozen=True)
class WordSchedule:
    """How long and how fast to learn."""

    epochs: int = 8  # >= 1, times that each picture is seen
    batch: int = 128  # pictures a step, >= 1
    learning_rate: float = 3e-3  # > 0, at its height (AdamW), from which it falls as a cosine
    weight_decay: float = 1e-2  # >= 0
    warmup: float = 0.05  # in [0, 1): share of the steps in which the learning rate rises
    seed: int = 0

    def __post_init__(self) -> None:
        require(self.epochs >= 1, "schedule.epochs", self.epochs, "at least 1")
        require(self.batch >= 1, "schedule.batch", self.batch, "at least 1")
        require(self.learning_rate > 0, "schedule.learning_rate", self.learning_rate, "positive")
        require(self.weight_decay >= 0, "schedule.weight_decay", self.weight_decay, "0 or positive")
        require(0 <= self.warmup < 1, "schedule.warmup", self.warmup, "in [0, 1)")

    def rate(self, share: float) -> float:
        """The learning rate when this share of all steps is done."""
        if share < self.warmup:
            return self.learning_rate * share / self.warmup
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * (share - self.warmup) / (1 - self.warmup)))


class Captions(NamedTuple):
    """All that can be said of an object, as bags of words."""

    colors: Tensor  # (C, W)
    classes: Tensor  # (K, W)
    both: Tensor  # (C * K, W), the class fastest


def captions(colors: Sequence[str], classes: Sequence[str]) -> Captions:
    """The captions over the words `(*colors, *classes)`."""
    words = (*colors, *classes)
    both = [[color, class_] for color in colors for class_ in classes]
    return Captions(*(bags_of(texts, words) for texts in ([[c] for c in colors], [[k] for k in classes], both)))


def train_words(crops: Crops, schedule: WordSchedule, device: torch.device) -> RoomWordsNetwork:
    """A network that learned from the crops, for the colours that people name and the classes in them."""
    torch.manual_seed(schedule.seed)
    rng = np.random.default_rng(schedule.seed)
    classes = tuple(COCO[k] for k in np.unique(crops.classes))
    said = Captions(*(bags.to(device) for bags in captions(COLOR_NAMES, classes)))
    network = RoomWordsNetwork((*COLOR_NAMES, *classes)).to(device).train()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=schedule.weight_decay)
    class_of = torch.from_numpy(np.searchsorted(np.unique(crops.classes), crops.classes))
    color_of = torch.from_numpy(crops.colors.astype(np.int64))
    pictures = torch.from_numpy(crops.pictures)
    steps = len(crops) // schedule.batch * schedule.epochs
    bar = tqdm(total=steps, desc="training", unit="step", disable=None)
    done = 0
    for _ in range(schedule.epochs):
        order = torch.from_numpy(rng.permutation(len(crops)))
        for chosen in torch.split(order, schedule.batch):
            if len(chosen) < schedule.batch:
                continue
            for group in optimizer.param_groups:
                group["lr"] = schedule.rate(done / steps)
            embedded = network.embed_pictures(_augmented(as_pictures(pictures[chosen]), rng).to(device))
            loss = contrast(network, embedded, said, color_of[chosen].to(device), class_of[chosen].to(device))
            optimizer.zero_grad(set_to_none=True)
            torch.autograd.backward(loss)
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            done += 1
            bar.update()
            bar.set_postfix(loss=f"{float(loss.detach()):.3f}")
    bar.close()
    return network.eval()


def contrast(network: RoomWordsNetwork, embedded: Tensor, said: Captions, colors: Tensor, classes: Tensor) -> Tensor:
    """The InfoNCE of pictures (N, D) against all captions; those without a colour (-1) count for their class alone."""
    scale = network.log_scale.exp().clamp(max=50.0)
    named = colors >= 0
    by_class, by_color, by_both = (
        scale * embedded @ network.embed_words(bags).T for bags in (said.classes, said.colors, said.both)
    )
    loss = functional.cross_entropy(by_class, classes)
    if named.any():
        both = colors[named] * len(said.classes) + classes[named]
        loss = loss + functional.cross_entropy(by_color[named], colors[named], label_smoothing=0.05)
        loss = loss + functional.cross_entropy(by_both[named], both, label_smoothing=0.05)
    return loss


def _augmented(pictures: Tensor, rng: np.random.Generator) -> Tensor:
    """Pictures (N, 4, H, W) turned over, brighter or darker, their masks a little too large, too small or beside."""
    n = len(pictures)
    flipped = torch.from_numpy(rng.uniform(size=n) < 0.5)
    pictures = torch.where(flipped[:, None, None, None], pictures.flip(3), pictures)
    gains = np.exp(rng.uniform(-BRIGHTNESS, BRIGHTNESS, (n, 1)) + rng.uniform(-WARMTH, WARMTH, (n, 3)))
    color = (pictures[:, :3] * torch.from_numpy(gains).float()[:, :, None, None]).clamp(0, 1)
    mask = pictures[:, 3:]
    shape = int(rng.integers(4))
    if shape == 1:
        mask = functional.max_pool2d(mask, 5, 1, 2)
    elif shape == 2:
        smaller = -functional.max_pool2d(-mask, 3, 1, 1)
        mask = torch.where(smaller.sum(dim=(1, 2, 3), keepdim=True) > 0, smaller, mask)
    elif shape == 3:
        mask = torch.roll(mask, tuple(int(shift) for shift in rng.integers(-2, 3, 2)), (2, 3))
    return torch.cat([color, mask], dim=1)


@torch.inference_mode()
def recall(network: RoomWordsNetwork, crops: Crops) -> Mapping[str, float]:
    """Of pictures with one colour, the share that is nearest to its own words among all of the kind."""
    classes = tuple(word for word in network.words if word not in COLOR_NAMES)
    said = captions(COLOR_NAMES, classes)
    one = crops.colors >= 0
    pictures = torch.from_numpy(crops.pictures[one])
    embedded = torch.cat([network.embed_pictures(as_pictures(part)) for part in torch.split(pictures, CROP_BATCH)])
    class_of = torch.tensor([classes.index(COCO[k]) for k in crops.classes[one]])
    color_of = torch.from_numpy(crops.colors[one].astype(np.int64))
    wanted = {"color": color_of, "class": class_of, "color_and_class": color_of * len(classes) + class_of}
    bags = {"color": said.colors, "class": said.classes, "color_and_class": said.both}
    best = {name: (embedded @ network.embed_words(bags[name]).T).argmax(dim=1) for name in wanted}
    return {name: float((best[name] == wanted[name]).float().mean()) for name in wanted}
