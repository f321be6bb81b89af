"""Tests for the command `convert-weights`."""

import hashlib
import pickle
import sys

import pytest
import torch

from framework.commands.installation import convert_weights
from framework.detection.mask_rcnn.network_file import describe_network, load_network
from framework.vocabulary.label_spaces import COCO
from plugins.detectors.mask_rcnn import MaskRCNNDetector
from tests.framework.detection.mask_rcnn.test_detectron2_checkpoint import synthetic_state
from tests.support.networks.tiny_mask_rcnn import TINY, tiny_network

pytestmark = pytest.mark.integration


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["convert_weights", *map(str, arguments)])
    convert_weights.main()


def test_convert_weights_detectron2_checkpoint_is_usable(tmp_path, monkeypatch, capsys):
    source, target = tmp_path / "model_final_abc123.pkl", tmp_path / "r101.safetensors"
    source.write_bytes(pickle.dumps({"model": synthetic_state("resnet101"), "__author__": "Detectron2"}))
    command(monkeypatch, source, target, "--kind", "detectron2", "--half")
    assert f"detector=mask_rcnn detector.weights={target}" in capsys.readouterr().out
    described = describe_network(target)
    assert described.card["converted_from"] == "model_final_abc123.pkl"
    assert described.card["converted_from_sha256"] == hashlib.sha256(source.read_bytes()).hexdigest()
    assert described.architecture.backbone.stride_in_1x1
    assert MaskRCNNDetector(weights=target, device="cpu").classes == COCO


def test_convert_weights_torchvision_keeps_classes_and_eps(tmp_path, monkeypatch):
    source, target = tmp_path / "own.pth", tmp_path / "own.safetensors"
    torch.save(tiny_network().state_dict(), source)
    command(monkeypatch, source, target, "--classes", "chair, couch,dining table", "--norm-eps", "1e-5")
    architecture = load_network(target).architecture
    assert architecture.classes == TINY.classes
    assert architecture.backbone == TINY.backbone


@pytest.mark.parametrize(
    ("source", "target", "fault"),
    [
        ("absent.pkl", "out.safetensors", "expected a file or one of"),
        ("broken.pkl", "out.safetensors", "broken.pkl: expected a pickle of numpy arrays"),
        ("broken.pkl", "out.pth", "OUT: expected a file name with the suffix .safetensors, got out.pth"),
    ],
)
def test_convert_weights_errors_are_one_line(tmp_path, monkeypatch, capsys, source, target, fault):
    (tmp_path / "broken.pkl").write_bytes(b"broken")
    with pytest.raises(SystemExit, match="1"):
        command(monkeypatch, tmp_path / source, tmp_path / target)
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert fault in line
    assert not (tmp_path / target).exists()
