"""Tests for the command `train-detector`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from framework.detection.mask_rcnn.network_file import describe_network
from framework.errors import ConfigError
from framework.files.search_paths import CONF
from framework.training.train import HELD_OUT, NETWORK, PRECISION, architecture, train
from framework.training.trainer import CHECKPOINT, CURVE, HISTORY
from tests.support.tiny_rooms import PICTURES, write_room

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]
ROOMS = CHECKOUT / "plugins" / "detectors" / "mask_rcnn_rooms.safetensors"


def config(folder: Path, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(
            "train_detector",
            overrides=[
                "device=cpu", "network.width=8", "network.fpn_channels=8", "network.head_features=16",
                f"pictures.folder={folder}", "pictures.rooms=1", "pictures.held_out_rooms=1",
                f"pictures.views={PICTURES}", f"pictures.held_out_views={PICTURES}",
                "schedule.batch=2", *overrides,
            ],
        )  # fmt: skip


def test_train_writes_network_usable_for_further_training(tmp_path: Path) -> None:
    for number in (0, HELD_OUT):
        write_room(tmp_path / "rooms", number)
    first = train(config(tmp_path / "rooms", "schedule.steps=2"), tmp_path / "run")
    assert {path.name for path in (tmp_path / "run").iterdir()} == {CHECKPOINT, CURVE, HISTORY, NETWORK, PRECISION}
    assert 0 <= first.ap50 <= 1
    assert first.objects == 2 * PICTURES
    written = json.loads((tmp_path / "run" / PRECISION).read_text(), parse_constant=pytest.fail)
    assert written["objects"] == 2 * PICTURES
    assert written["ap50_by_class"]["toilet"] is None, "expected no AP: no image has a toilet"
    train(config(tmp_path / "rooms", "schedule.steps=3"), tmp_path / "run")
    described = describe_network(tmp_path / "run" / NETWORK)
    assert described.card["steps"] == 3
    assert described.architecture == architecture(config(tmp_path).network)
    assert len(described.architecture.classes) == 9
    other = f"network.start_from={tmp_path / 'run' / NETWORK}"
    train(config(tmp_path / "rooms", "schedule.steps=1", "schedule.bfloat16=true", other), tmp_path / "tuned")
    assert describe_network(tmp_path / "tuned" / NETWORK).card["bfloat16"] is True


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("schedule.steps=0", r"schedule\.steps: expected at least 1"),
        (f"network.start_from={ROOMS}", "expected weights of the configured architecture"),
    ],
)
def test_train_invalid_config_raises_before_rendering(tmp_path: Path, wrong: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        train(config(tmp_path / "rooms", wrong), tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_architecture_unknown_backbone_raises(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"network\.backbone"):
        architecture(config(tmp_path, "network.backbone=vgg16").network)
