"""Training of a detector on synthetic rooms, with evaluation on held-out rooms.

Outputs: network.safetensors (for `detector=mask_rcnn detector.weights=...`), checkpoint.pt (to resume), losses.csv,
losses.png and average_precision.json.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from framework.config.validation import require
from framework.data import Bool, Camera, Detections, Frame
from framework.detection.domain import RENDERED_ROOMS
from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.network_file import Fact, load_network, save_network
from framework.detection.mask_rcnn.resnet import DEPTHS, ResNetShape
from framework.detection.runtimes.device import torch_device
from framework.errors import ConfigError
from framework.evaluation.detection_ap import AveragePrecision, detection_ap
from framework.files.atomic_write import atomic_write
from framework.interfaces import Detector
from framework.registry import build
from framework.runtime.process_settings import Settings, available_cores
from framework.training.augmentation import MIN_PIXELS
from framework.training.room_pictures import HEIGHT, WIDTH, RoomPictures, render_rooms
from framework.training.trainer import Schedule, Trainer
from framework.vocabulary.label_spaces import COCO, SCENENN_TO_COCO

log = logging.getLogger(__name__)

DETECTOR = "plugins.detectors.mask_rcnn.MaskRCNNDetector"
HELD_OUT = 1_000_000  # number of the first held-out room
NETWORK, PRECISION = "network.safetensors", "average_precision.json"


def train(config: DictConfig, folder: Path) -> AveragePrecision:
    """Render missing rooms, train a network and return its mask AP on held-out rooms.

    Args:
        config: The training config.
        folder: The output folder. Training resumes from the checkpoint in this folder, if any.
    """
    Settings.of(config).apply()
    torch.manual_seed(config.seed)
    network = _started(config.network)
    schedule = Schedule(**dict(config.schedule), seed=config.seed)
    wanted = config.pictures
    for key in ("rooms", "views", "held_out_rooms", "held_out_views"):
        require(wanted[key] >= 1, f"pictures.{key}", wanted[key], "at least 1")
    rooms = Path(wanted.folder or Path(platformdirs.user_cache_dir("instancemap")) / "rooms")
    processes = wanted.processes or available_cores()
    render_rooms(rooms, 0, wanted.rooms, wanted.views, processes)
    render_rooms(rooms, HELD_OUT, wanted.held_out_rooms, wanted.held_out_views, processes)

    device = str(torch_device(config.device, "device"))
    pictures = RoomPictures(rooms, 0, wanted.rooms, wanted.views)
    trainer = Trainer(network, pictures, schedule, folder, device)
    log.info("%d images, step %d of %d, on %s", len(pictures), trainer.step, schedule.steps, device)
    trainer.run()

    card: dict[str, Fact] = {
        "data": f"{len(pictures)} images of {wanted.rooms} rendered rooms",
        "steps": trainer.step,
        "batch": schedule.batch,
        "seed": int(config.seed),
        "bfloat16": schedule.bfloat16,
        "domain": RENDERED_ROOMS,
        "limits": "trained on rendered rooms only, at 320x240; not for photographs",
    }
    weights = folder / NETWORK
    save_network(trainer.trained(), weights, card, half=True)
    node = {"_target_": DETECTOR, "weights": str(weights.absolute()), "device": device}
    detector = build(Detector, OmegaConf.create(node))
    precision = detection_ap(
        _detected(detector, RoomPictures(rooms, HELD_OUT, wanted.held_out_rooms, wanted.held_out_views)),
        detector.classes, MIN_PIXELS,
    ).masks  # fmt: skip
    card |= _known({"held_out_rooms": wanted.held_out_rooms, "mask_ap50": precision.ap50, "mask_ap": precision.ap})
    save_network(trainer.trained(), weights, card, half=True)
    with atomic_write(folder / PRECISION) as path:
        path.write_text(json.dumps(_known(asdict(precision)), indent=1))
    log.info("mask AP50 %.3f, AP %.3f on %d held-out rooms", precision.ap50, precision.ap, wanted.held_out_rooms)
    return precision


def _started(config: DictConfig) -> MaskRCNN:
    """Return the initial network, with random weights or those of `start_from`."""
    network = MaskRCNN(architecture(config))
    if config.start_from:
        start = load_network(Path(config.start_from))
        if start.architecture != network.architecture:
            wanted, found = asdict(network.architecture), asdict(start.architecture)
            key = next(key for key in wanted if wanted[key] != found[key])
            raise ConfigError(
                f"network.start_from: expected weights of the configured architecture ({key}={wanted[key]}), got "
                f"{key}={found[key]} in {config.start_from}"
            )
        network.load_state_dict(start.state_dict())
    return network


def architecture(network: DictConfig) -> Architecture:
    """Return the architecture that is configured in the section `network`."""
    require(network.backbone in DEPTHS, "network.backbone", network.backbone, f"one of {', '.join(DEPTHS)}")
    return Architecture(
        classes=tuple(name for name in COCO if name in SCENENN_TO_COCO.values()),
        backbone=ResNetShape(network.backbone, network.width),
        fpn_channels=network.fpn_channels,
        head_features=network.head_features,
        anchor_sides=tuple(float(side) for side in network.anchor_sides),
        rounded_anchors=False,
        half_pixel=True,
        short_side=HEIGHT,
        long_side=WIDTH,
    )


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace non-finite numbers with None, because JSON does not support them."""
    inner = {name: _known(value) if isinstance(value, Mapping) else value for name, value in values.items()}
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in inner.items()}


def _detected(detector: Detector, pictures: RoomPictures) -> Iterator[tuple[Bool, Sequence[str], Detections]]:
    """Yield the ground-truth masks, the class names and the detections of each image."""
    for k in tqdm(range(len(pictures)), desc="evaluating", unit="image", disable=None):
        example = pictures[k]
        height, width = example.color.shape[:2]
        camera = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
        frame = Frame(k, float(k), example.color, np.zeros((height, width), np.float32), camera)
        yield example.masks, example.class_names, detector.detect(frame)
