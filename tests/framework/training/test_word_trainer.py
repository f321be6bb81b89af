"""The network of words: what it is taught it knows, and its training from a config."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from framework.detection.room_words import (
    SIDE,
    RoomWords,
    RoomWordsNetwork,
    bags_of,
    load_room_words,
    save_room_words,
)
from framework.errors import ConfigError, DataError
from framework.files.search_paths import CONF
from framework.training.room_crops import Crops, crops_file, read_crops, room_crops
from framework.training.train_words import HELD_OUT, NETWORK, RECALL, train
from framework.training.word_trainer import WordSchedule, captions, contrast, recall, train_words
from framework.vocabulary.color_names import COLOR_NAMES, nearest_names
from framework.vocabulary.label_spaces import COCO

CPU = torch.device("cpu")
PAINTS = {"red": (200, 30, 35), "blue": (40, 80, 190), "green": (50, 140, 60)}
KINDS = ("chair", "bed")


def colored_shapes(seed: int, n: int) -> Crops:
    """Discs (chairs) and bars (beds) of three colours, on noise."""
    rng = np.random.default_rng(seed)
    pictures = rng.integers(90, 160, (n, SIDE, SIDE, 4)).astype(np.uint8)
    v, u = np.mgrid[:SIDE, :SIDE]
    colors, classes = rng.integers(len(PAINTS), size=n), rng.integers(2, size=n)
    for k in range(n):
        x, y, r = rng.integers(22, 42), rng.integers(22, 42), rng.integers(10, 18)
        disc = (u - x) ** 2 + (v - y) ** 2 < r**2
        bar = (abs(u - x) < 28) & (abs(v - y) < r / 3)
        inside = bar if classes[k] else disc
        pictures[k, inside, :3] = list(PAINTS.values())[colors[k]]
        pictures[k, ..., 3] = np.where(inside, 255, 0)
    names = [COLOR_NAMES.index(name) for name in PAINTS]
    kinds = [COCO.index(name) for name in KINDS]
    return Crops(pictures, np.int32(names)[colors], np.int32(kinds)[classes])


@pytest.fixture(scope="module")
def trained() -> RoomWordsNetwork:
    return train_words(colored_shapes(0, 384), WordSchedule(epochs=6, batch=32), CPU)


def test_it_knows_what_it_was_taught(trained: RoomWordsNetwork) -> None:
    measured = recall(trained, colored_shapes(1, 128))
    assert measured["color"] > 0.95
    assert measured["class"] > 0.95
    assert measured["color_and_class"] > 0.9


def test_an_untrained_one_knows_nothing() -> None:
    torch.manual_seed(0)
    assert recall(RoomWordsNetwork((*COLOR_NAMES, *KINDS)).eval(), colored_shapes(1, 128))["color_and_class"] < 0.3


def test_the_loss_is_the_cross_entropy_of_the_captions() -> None:
    torch.manual_seed(0)
    network = RoomWordsNetwork(("red", "blue", *KINDS)).eval()
    said = captions(("red", "blue"), KINDS)
    assert said.both.tolist() == [[1, 0, 1, 0], [1, 0, 0, 1], [0, 1, 1, 0], [0, 1, 0, 1]]
    embedded = torch.nn.functional.normalize(torch.randn(3, 64), dim=1)
    colorless = contrast(network, embedded, said, torch.tensor([-1, -1, -1]), torch.tensor([0, 1, 0]))
    logits = network.log_scale.exp() * embedded @ network.embed_words(said.classes).T
    expected = -torch.log_softmax(logits, dim=1)[torch.arange(3), torch.tensor([0, 1, 0])].mean()
    torch.testing.assert_close(colorless, expected)
    assert contrast(network, embedded, said, torch.tensor([0, 1, -1]), torch.tensor([0, 1, 0])) > colorless


def test_a_room_s_objects_have_names_for_colors_that_they_show() -> None:
    """The light is not white, so that the mean of an object's pixels often has another name, but not by chance."""
    crops = room_crops(3, 6)
    assert len(crops) > 10
    assert set(crops.classes.tolist()) <= {COCO.index(name) for name in COCO}
    assert (crops.pictures[..., 3].reshape(len(crops), -1).max(axis=1) > 0).all()
    named = np.flatnonzero(crops.colors >= 0)
    means = np.array([crops.pictures[k][crops.pictures[k, ..., 3] > 128][:, :3].mean(axis=0) for k in named])
    alike = nearest_names(np.float32(means / 255)) == crops.colors[named]
    assert alike.mean() > 0.3, "by chance it would be 0.08"
    again = room_crops(3, 6)
    np.testing.assert_array_equal(again.pictures, crops.pictures)


def written_rooms(folder: Path, numbers: Sequence[int]) -> None:
    folder.mkdir()
    for number in numbers:
        crops = colored_shapes(number, 64)
        np.savez(crops_file(folder, number), crops=crops.pictures, colors=crops.colors, classes=crops.classes)


def config(folder: Path, *overrides: str) -> DictConfig:
    small = ["device=cpu", f"pictures.folder={folder}", "pictures.rooms=2", "pictures.held_out=1", "schedule.epochs=2"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train_words", overrides=[*small, "schedule.batch=32", *overrides])


def test_a_training_leaves_a_network_that_says_what_it_is(tmp_path: Path) -> None:
    written_rooms(tmp_path / "rooms", (0, 1, HELD_OUT))
    measured = train(config(tmp_path / "rooms"), tmp_path / "run")
    assert {path.name for path in (tmp_path / "run").iterdir()} == {NETWORK, RECALL}
    assert json.loads((tmp_path / "run" / RECALL).read_text()) == measured
    with safetensors.safe_open(tmp_path / "run" / NETWORK, "pt") as file:
        card = json.loads(file.metadata()["card"])
    assert (card["epochs"], card["domain"]) == (2, "rendered rooms")
    train(config(tmp_path / "rooms"), tmp_path / "again")
    first, again = (safetensors.torch.load_file(tmp_path / run / NETWORK) for run in ("run", "again"))
    assert all(torch.equal(first[name], again[name]) for name in first)
    with pytest.raises(ConfigError, match=r"schedule\.epochs must be at least 1"):
        train(config(tmp_path / "rooms", "schedule.epochs=0"), tmp_path / "run")
    (tmp_path / "rooms" / "room_000001.npz").unlink()
    with pytest.raises(DataError, match=r"room_000001\.npz is missing"):
        read_crops(tmp_path / "rooms", 0, 2)


def test_a_network_comes_back_from_its_file_and_others_are_refused(trained: RoomWordsNetwork, tmp_path: Path) -> None:
    path = tmp_path / "words.safetensors"
    save_room_words(trained, path, {})
    loaded = load_room_words(path)
    bags = bags_of([["red"], ["red", "chair"]], trained.words)
    torch.testing.assert_close(loaded.embed_words(bags), trained.embed_words(bags), atol=2e-3, rtol=0)
    content = safetensors.torch.load(path.read_bytes())
    for tensors, metadata, fault in (
        (content, {}, "another kind of network"),
        (content, {"kind": "room_words"}, "its words must be a list"),
        (content, {"kind": "room_words", "words": '["red"]'}, "does not have the weights"),
        ({"a": torch.zeros(1)}, {"kind": "room_words", "words": "[]"}, "does not have the weights"),
    ):
        safetensors.torch.save_file(tensors, path, metadata)
        with pytest.raises(DataError, match=fault) as refused:
            load_room_words(path)
        assert "\n" not in str(refused.value)
    path.write_bytes(b"nothing")
    with pytest.raises(DataError, match="is no safetensors file"):
        load_room_words(path)


def test_words_that_it_was_not_taught_are_refused(trained: RoomWordsNetwork, tmp_path: Path) -> None:
    save_room_words(trained, tmp_path / "words.safetensors", {})
    words = RoomWords(tmp_path / "words.safetensors", CPU)
    assert np.linalg.norm(words.embed_text("the red chairs")) == pytest.approx(1)
    np.testing.assert_array_equal(words.embed_text("grey chair"), words.embed_text("a gray chair"))
    assert words.embed_crops(np.zeros((0, SIDE, SIDE, 4), np.uint8)).shape == (0, 64)
    for query, named in (("a wooden chair", "'wooden'"), ("a toaster", "'toaster'"), ("the", "'the'")):
        with pytest.raises(DataError, match=f"does not know {named} ?.*; it knows black, gray"):
            words.embed_text(query)
