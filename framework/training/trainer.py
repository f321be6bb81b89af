"""Training loop with checkpoints and a plot of the losses.

The random numbers of a step depend only on the seed and the step. The result of a resumed run therefore equals that of
an uninterrupted run.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from framework.config.validation import require
from framework.detection.mask_rcnn.network import MaskRCNN
from framework.detection.masks.binary_masks import tight_boxes
from framework.errors import DataError, in_one_line
from framework.files.atomic_write import atomic_write
from framework.training.augmentation import augmented
from framework.training.losses import Budget, Objects, losses
from framework.training.room_pictures import Example, RoomPictures

CHECKPOINT, CURVE, HISTORY = "checkpoint.pt", "losses.png", "losses.csv"
LARGEST_GRADIENT = 10.0  # maximum norm of the gradient


@dataclass(frozen=True)
class Schedule:
    """Length and optimizer parameters of a training run."""

    steps: int = 8000  # number of training steps, >= 1
    batch: int = 4  # number of images per step, >= 1
    learning_rate: float = 1e-3  # maximum learning rate of AdamW, > 0
    weight_decay: float = 1e-2  # weight decay of AdamW, >= 0
    warmup: int = 300  # number of steps of linear warmup before the cosine decay of the learning rate, >= 0
    ema_decay: float = 0.998  # decay per step of the saved moving average of the weights, in [0, 1)
    checkpoint_interval: int = 250  # interval between checkpoints, in steps, >= 1
    bfloat16: bool = False  # true = compute matrix products in bfloat16, which is faster on GPUs and on CPUs with AMX
    seed: int = 0  # seed of the order of the images and their augmentation
    budget: Budget = field(default_factory=Budget)  # limits of the proposals per image

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "checkpoint_interval"):
            require(getattr(self, name) >= 1, f"schedule.{name}", getattr(self, name), "at least 1")
        for name in ("weight_decay", "warmup"):
            require(getattr(self, name) >= 0, f"schedule.{name}", getattr(self, name), "at least 0")
        require(self.learning_rate > 0, "schedule.learning_rate", self.learning_rate, "a positive value")
        require(0 <= self.ema_decay < 1, "schedule.ema_decay", self.ema_decay, "a value in [0, 1)")

    def rate(self, step: int) -> float:
        """Return the learning rate of a step.

        It increases linearly during the warmup, then follows a cosine decay to 1% of the maximum.
        """
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        done = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))


class Trainer:
    """Trainer of a Mask R-CNN.

    Training resumes from the last checkpoint in `folder`, if any.
    """

    def __init__(
        self, network: MaskRCNN, pictures: RoomPictures, schedule: Schedule, folder: Path, device: str
    ) -> None:
        self.device = torch.device(device)
        self.network = network.to(self.device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
        self.pictures = pictures
        self.schedule = schedule
        self.folder = folder
        self.step = 0
        self.history: list[dict[str, float]] = []  # terms of the loss by name, for each step
        self.averaged = {name: value.detach().clone() for name, value in network.state_dict().items()}
        decayed = [p for p in network.parameters() if p.ndim > 1]
        rest = [p for p in network.parameters() if p.ndim <= 1]  # biases and normalization parameters
        self._optimizer = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": schedule.weight_decay}, {"params": rest, "weight_decay": 0.0}],
            lr=schedule.learning_rate,
        )
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / CHECKPOINT).is_file():
            self._resume()

    def run(self) -> None:
        """Run the remaining training steps.

        If training is interrupted, the steps after the last checkpoint are lost.
        """
        with tqdm(total=self.schedule.steps, initial=self.step, desc="training", unit="step", disable=None) as bar:
            while self.step < self.schedule.steps:
                terms = self._learn()
                self.history.append(terms)
                self.step += 1
                bar.update()
                bar.set_postfix(loss=f"{sum(terms.values()):.3f}")
                if self.step % self.schedule.checkpoint_interval == 0 or self.step == self.schedule.steps:
                    self._save()

    def trained(self) -> MaskRCNN:
        """Return the network with averaged weights, on the CPU."""
        network = MaskRCNN(self.network.architecture)
        network.load_state_dict({name: value.cpu() for name, value in self.averaged.items()})
        return network.eval()

    def _learn(self) -> dict[str, float]:
        """Run one training step and return the loss terms by name."""
        rng = np.random.default_rng([self.schedule.seed, self.step])
        chosen = rng.integers(len(self.pictures), size=self.schedule.batch)
        examples = [augmented(self.pictures[int(k)], rng) for k in chosen]
        images = torch.from_numpy(np.stack([e.color for e in examples])).permute(0, 3, 1, 2).to(self.device)
        objects = [self._objects(example).to(self.device) for example in examples]
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.schedule.bfloat16):
            terms = losses(self.network, images, objects, self.schedule.budget, generator)
        loss = torch.stack(list(terms.values())).sum()
        if not torch.isfinite(loss):
            raise DataError(
                f"step {self.step}: expected a finite loss, got {loss.item()}; set a smaller schedule.learning_rate"
            )
        for group in self._optimizer.param_groups:
            group["lr"] = self.schedule.rate(self.step)
        self._optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), LARGEST_GRADIENT)
        self._optimizer.step()
        self._average()
        return {name: float(value.detach()) for name, value in terms.items()}

    def _objects(self, example: Example) -> Objects:
        index = {name: k for k, name in enumerate(self.network.architecture.classes, start=1)}
        unknown = sorted(set(example.class_names) - set(index))
        if unknown:
            raise DataError(
                f"pictures.folder: expected rendered scenes with only the classes of the network, got "
                f"{', '.join(unknown)}; set pictures.folder to an empty folder"
            )
        boxes = tight_boxes(example.masks) + np.array([0, 0, 1, 1], np.float32)  # from pixel centers to borders
        return Objects(
            boxes=torch.from_numpy(boxes),
            labels=torch.tensor([index[name] for name in example.class_names], dtype=torch.int64),
            masks=torch.from_numpy(example.masks),
        )

    @torch.no_grad()
    def _average(self) -> None:
        keep = min(self.schedule.ema_decay, (1 + self.step) / (10 + self.step))  # adapts faster at the start
        for name, value in self.network.state_dict().items():
            if value.is_floating_point():
                self.averaged[name].lerp_(value, 1 - keep)
            else:
                self.averaged[name].copy_(value)

    def _save(self) -> None:
        state = {
            "step": self.step,
            "network": self.network.state_dict(),
            "averaged": self.averaged,
            "optimizer": self._optimizer.state_dict(),
            "history": self.history,
        }
        with atomic_write(self.folder / CHECKPOINT) as path:
            torch.save(state, path)
        with atomic_write(self.folder / HISTORY) as path, path.open("w", newline="") as file:
            writer = csv.DictWriter(file, ["step", *self.history[0]])
            writer.writeheader()
            writer.writerows({"step": k, **terms} for k, terms in enumerate(self.history))
        with atomic_write(self.folder / CURVE) as path:
            draw_losses(self.history, path)

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT
        try:
            state = torch.load(path, map_location=self.device, weights_only=True)
            self.network.load_state_dict(state["network"])
            self.averaged = state["averaged"]
            self._optimizer.load_state_dict(state["optimizer"])
            self.step, self.history = state["step"], state["history"]
        except Exception as error:  # torch raises many exception types for a damaged file
            raise DataError(
                f"{path}: expected an intact checkpoint of this network, got an error ({in_one_line(error)}); remove "
                "it, or train in another folder"
            ) from error


def draw_losses(history: Sequence[dict[str, float]], path: Path) -> None:
    """Plot the running means of the loss terms."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    width = max(1, len(history) // 60)
    for name in history[0]:
        values = np.array([terms[name] for terms in history])
        means = np.convolve(values, np.ones(width) / width, mode="valid")
        axes.plot(np.arange(len(means)) + width, np.maximum(means, 1e-6), label=name)
    axes.set(xlabel="step", ylabel=f"loss, mean of {width} steps", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
