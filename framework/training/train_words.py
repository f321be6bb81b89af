"""One training of the network of words from its config: render objects, train, measure on rooms never learned from.

Leaves in its folder: room_words.safetensors, for `detector=room_words detector.model=...`; recall.json.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path

import platformdirs
from omegaconf import DictConfig

from framework.detection.domain import RENDERED_ROOMS
from framework.detection.room_words import Fact, load_room_words, save_room_words
from framework.detection.runtimes.device import torch_device
from framework.files.atomic_write import written_whole
from framework.runtime.process_settings import Settings, available_cores
from framework.training.room_crops import read_crops, render_crops
from framework.training.word_trainer import WordSchedule, recall, train_words

log = logging.getLogger(__name__)

HELD_OUT = 1_000_000  # the number of the first room that is never learned from
NETWORK, RECALL = "room_words.safetensors", "recall.json"


def train(config: DictConfig, folder: Path) -> Mapping[str, float]:
    """Renders the rooms that are missing, trains, measures; returns the recall."""
    Settings.of(config).apply()
    schedule = WordSchedule(**dict(config.schedule), seed=config.seed)
    wanted = config.pictures
    crops = Path(wanted.folder or Path(platformdirs.user_cache_dir("instancemap")) / "room_crops")
    processes = wanted.processes or available_cores()
    render_crops(crops, 0, wanted.rooms, wanted.views, processes)
    render_crops(crops, HELD_OUT, wanted.held_out, wanted.held_out_views, processes)

    learned = read_crops(crops, 0, wanted.rooms)
    log.info("%d pictures of objects", len(learned))
    network = train_words(learned, schedule, torch_device(config.device, "device")).cpu()
    card: dict[str, Fact] = {
        "data": f"{len(learned)} pictures of objects in {wanted.rooms} rendered rooms",
        "epochs": schedule.epochs,
        "batch": schedule.batch,
        "seed": int(config.seed),
        "domain": RENDERED_ROOMS,
        "limits": "trained on rendered rooms only; it knows its own few words and nothing else",
    }
    folder.mkdir(parents=True, exist_ok=True)
    save_room_words(network, folder / NETWORK, card)
    measured = recall(load_room_words(folder / NETWORK), read_crops(crops, HELD_OUT, wanted.held_out))
    with written_whole(folder / RECALL) as path:
        path.write_text(json.dumps(measured, indent=1))
    log.info(
        "of %d other rooms' objects: colour %.3f, class %.3f, both %.3f",
        wanted.held_out, measured["color"], measured["class"], measured["color_and_class"],
    )  # fmt: skip
    return measured
