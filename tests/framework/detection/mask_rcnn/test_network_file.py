"""Tests for network files, including damaged files."""

import json
import re

import pytest
import torch
from safetensors.torch import load_file, save_file

from framework.detection.mask_rcnn.network_file import describe_network, filled, load_network, save_network
from framework.errors import DataError
from tests.support.networks.tiny_mask_rcnn import TINY, tiny_network, tiny_network_file


def rewritten(path, tensors=None, **metadata):
    """Write the file again with other tensors or metadata, and return the path."""
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        before = file.metadata()
    save_file(load_file(path) if tensors is None else tensors, path, before | metadata)
    return path


def weights(network):
    return {name: tensor for name, tensor in network.state_dict().items() if "num_batches" not in name}


def assert_one_line(path, *parts):
    with pytest.raises(DataError) as caught:
        load_network(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_network_file_round_trip_keeps_weights_and_model_card(tmp_path):
    network, path = tiny_network(), tmp_path / "network.safetensors"
    save_network(network, path, {"steps": 300, "mask_ap50": 0.51, "data": "rooms"})
    loaded = load_network(path)
    assert loaded.architecture == TINY
    assert not loaded.training
    for name, tensor in weights(network).items():
        assert torch.equal(weights(loaded)[name], tensor), name
    assert describe_network(path).card == {"steps": 300, "mask_ap50": 0.51, "data": "rooms"}
    assert describe_network(path).architecture == TINY
    assert [file.name for file in tmp_path.iterdir()] == ["network.safetensors"]


def test_network_file_half_precision_keeps_float32_statistics(tmp_path):
    network, path = tiny_network(), tmp_path / "half.safetensors"
    network.backbone.body.bn1.running_var.fill_(1e6)  # the largest float16 value is 65504
    save_network(network, path, {}, half=True)
    loaded = weights(load_network(path))
    assert loaded["backbone.body.bn1.running_var"][0] == 1e6
    for name, tensor in weights(network).items():
        expected = tensor.half().float() if tensor.ndim >= 2 else tensor
        assert torch.equal(loaded[name], expected), name
        assert loaded[name].dtype == torch.float32
    whole = tiny_network_file(tmp_path)
    assert path.stat().st_size < 0.8 * whole.stat().st_size


def test_network_file_non_finite_weights_are_not_written(tmp_path):
    network = tiny_network()
    network.rpn.head.cls_logits.bias.data[0] = torch.nan
    with pytest.raises(DataError, match=r"cls_logits\.bias: expected finite weights"):
        save_network(network, tmp_path / "network.safetensors", {})
    assert not list(tmp_path.iterdir())


def test_network_file_missing_raises(tmp_path):
    assert_one_line(tmp_path / "absent.safetensors", "expected a network file, got none")


def test_network_file_truncated_raises(tmp_path):
    path = tiny_network_file(tmp_path)
    path.write_bytes(path.read_bytes()[:-100])
    assert_one_line(path, "damaged")
    path.write_bytes(b"<html>not found</html>")
    assert_one_line(path, "damaged")


def test_network_file_with_flipped_bit_raises(tmp_path):
    path = tiny_network_file(tmp_path)
    content = bytearray(path.read_bytes())
    content[-1000] ^= 1
    path.write_bytes(content)
    assert_one_line(path, "expected tensors with sha256")


def test_network_file_without_architecture_raises(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(1)}, path)
    assert_one_line(path, "expected an architecture in the metadata, got none")


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda fields: fields | {"color_space": "BGR"}, "architecture: expected known fields, got"),
        (lambda fields: {k: v for k, v in fields.items() if k != "classes"}, "fields, got none for: classes"),
        (lambda fields: fields | {"fpn_channels": "8"}, "fpn_channels: expected a value of type int, got '8'"),
        (lambda fields: fields | {"sampling_ratio": True}, "sampling_ratio: expected a value of type int, got True"),
        (lambda fields: fields | {"pixel_mean": [1.0, 2.0]}, "architecture.pixel_mean: expected 3 values, got 2"),
        (lambda fields: fields | {"classes": "chair"}, "architecture.classes: expected a list"),
        (lambda fields: fields | {"backbone": "resnet18"}, "architecture.backbone: expected a JSON object"),
        (
            lambda fields: fields | {"backbone": fields["backbone"] | {"name": "vgg"}},
            "expected a known architecture, got an error ('vgg'",
        ),
        (lambda fields: fields | {"head_features": 17}, "fc6.bias: expected shape 17, got 16"),
    ],
)
def test_network_file_invalid_architecture_raises(tmp_path, change, fault):
    path = tiny_network_file(tmp_path)
    fields = json.loads(json.dumps(vars(TINY) | {"backbone": vars(TINY.backbone)}))
    rewritten(path, architecture=json.dumps(change(fields)))
    assert_one_line(path, fault)


def test_network_file_malformed_architecture_json_raises(tmp_path):
    assert_one_line(rewritten(tiny_network_file(tmp_path), architecture="{"))


def test_network_file_missing_field_uses_default(tmp_path):
    fields = json.loads(json.dumps(vars(TINY) | {"backbone": vars(TINY.backbone)}))
    del fields["truncated_strides"]
    path = rewritten(tiny_network_file(tmp_path), architecture=json.dumps(fields))
    assert load_network(path).architecture == TINY


def test_network_weights_mismatch_raises():
    tensors = weights(tiny_network())
    with pytest.raises(
        DataError,
        match=r"^here: expected the weights backbone\.body\.bn1\.bias and 1 more, got none$",
    ):
        filled(
            TINY, {k: v for k, v in tensors.items() if "backbone.body.bn1.b" not in k and "fc7.bias" not in k}, "here"
        )
    with pytest.raises(DataError, match=r"^here: expected only the weights of this network, got extra$"):
        filled(TINY, tensors | {"extra": torch.zeros(1)}, "here")
    wrong = tensors | {"rpn.head.cls_logits.weight": torch.zeros(3, 9, 1, 1)}
    with pytest.raises(
        DataError, match=re.escape("here: rpn.head.cls_logits.weight: expected shape 3 x 8 x 1 x 1, got 3 x 9")
    ):
        filled(TINY, wrong, "here")
    with pytest.raises(
        DataError, match=r"^here: rpn\.head\.cls_logits\.bias: expected finite weights, got NaN or infinity"
    ):
        filled(TINY, tensors | {"rpn.head.cls_logits.bias": torch.full((3,), torch.inf)}, "here")
