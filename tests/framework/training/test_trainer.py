"""Tests for training with a tiny network."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.resnet import ResNetShape
from framework.errors import ConfigError, DataError
from framework.training.losses import Budget
from framework.training.room_pictures import RoomPictures
from framework.training.trainer import CHECKPOINT, CURVE, HISTORY, Schedule, Trainer
from tests.support.tiny_rooms import PICTURES, write_room

TINY = Architecture(
    classes=("chair", "bed"),
    backbone=ResNetShape("resnet18", 8),
    fpn_channels=8,
    head_features=16,
    anchor_sides=(16, 24, 32, 48, 64),
)
SHORT = Schedule(steps=6, batch=2, warmup=2, checkpoint_interval=3, budget=Budget(50, 30, 16))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> RoomPictures:
    folder = tmp_path_factory.mktemp("rooms")
    write_room(folder, 0)
    return RoomPictures(folder, 0, 1, PICTURES)


def network() -> MaskRCNN:
    torch.manual_seed(0)
    return MaskRCNN(TINY)


@pytest.mark.integration
def test_trainer_reduces_loss(pictures: RoomPictures, tmp_path: Path) -> None:
    schedule = Schedule(
        steps=40, batch=2, learning_rate=3e-3, warmup=5, checkpoint_interval=40, budget=Budget(50, 30, 16)
    )
    trainer = Trainer(network(), pictures, schedule, tmp_path, "cpu")
    trainer.run()
    losses = [sum(terms.values()) for terms in trainer.history]
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])
    assert {file.name for file in tmp_path.iterdir()} == {CHECKPOINT, CURVE, HISTORY}
    assert len((tmp_path / HISTORY).read_text().splitlines()) == 41
    assert cv2.imread(str(tmp_path / CURVE)) is not None
    assert not trainer.trained().training


@pytest.mark.integration
def test_trainer_resumed_run_equals_uninterrupted_run(
    pictures: RoomPictures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Trainer(network(), pictures, SHORT, tmp_path / "whole", "cpu")
    whole.run()
    stopped = Trainer(network(), pictures, SHORT, tmp_path / "stopped", "cpu")
    learn = Trainer._learn

    def interrupted(self: Trainer) -> dict[str, float]:
        if self.step == 4:
            raise KeyboardInterrupt
        return learn(self)

    monkeypatch.setattr(Trainer, "_learn", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stopped.run()
    monkeypatch.setattr(Trainer, "_learn", learn)
    resumed = Trainer(network(), pictures, SHORT, tmp_path / "stopped", "cpu")
    assert resumed.step == 3
    resumed.run()
    assert resumed.history == whole.history
    assert all(torch.equal(resumed.averaged[name], whole.averaged[name]) for name in whole.averaged)


def test_trainer_invalid_checkpoint_raises(pictures: RoomPictures, tmp_path: Path) -> None:
    Trainer(network(), pictures, Schedule(steps=1, batch=1, budget=SHORT.budget), tmp_path, "cpu").run()
    wider = MaskRCNN(Architecture(**{**vars(TINY), "fpn_channels": 16}))
    with pytest.raises(DataError, match=r"checkpoint\.pt: expected an intact checkpoint of this network"):
        Trainer(wider, pictures, SHORT, tmp_path, "cpu")
    whole = (tmp_path / CHECKPOINT).read_bytes()
    for content in (b"", whole[: len(whole) // 2]):
        (tmp_path / CHECKPOINT).write_bytes(content)
        with pytest.raises(DataError, match=r"checkpoint\.pt: expected an intact checkpoint"):
            Trainer(network(), pictures, SHORT, tmp_path, "cpu")


def test_trainer_loss_depends_on_seed(pictures: RoomPictures, tmp_path: Path) -> None:
    histories = []
    for seed in (0, 1):
        schedule = Schedule(steps=1, batch=2, seed=seed, budget=SHORT.budget)
        trainer = Trainer(network(), pictures, schedule, tmp_path / str(seed), "cpu")
        trainer.run()
        histories.append(trainer.history)
    assert histories[0] != histories[1]


def test_trainer_unknown_picture_classes_raise(pictures: RoomPictures, tmp_path: Path) -> None:
    only_chairs = MaskRCNN(Architecture(**{**vars(TINY), "classes": ("chair",)}))
    with pytest.raises(DataError, match=r"pictures\.folder: expected rendered scenes with only .*, got bed"):
        Trainer(only_chairs, pictures, SHORT, tmp_path, "cpu").run()


def test_room_pictures_missing_room_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="room_000003_6: expected a rendered room"):
        RoomPictures(tmp_path, 3, 1, PICTURES)


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"batch": 0}, {"learning_rate": 0.0}, {"ema_decay": 1.0}, {"checkpoint_interval": 0}]
)
def test_schedule_out_of_range_raises(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Schedule(**wrong)  # type: ignore[arg-type]
