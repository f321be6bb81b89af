"""LiteRT networks, beside the same ones in ONNX files; whatever does not fit is said in one line."""

import json
import sys
import zipfile

import numpy as np
import pytest

from framework.detection.litert_network import LitertNetwork
from framework.errors import ConfigError, DataError

pytest.importorskip("ai_edge_litert")
from tests.support.networks.tiny_litert import Graph, constant_litert_network, doubling_litert_network

IMAGE = np.random.default_rng(1).random((4, 6, 3)).astype(np.float32)


@pytest.mark.parametrize("shape", [(1, 3, 4, 6), (1, 4, 6, 3)])
def test_the_image_arrives_as_it_is(tmp_path, shape):
    network = LitertNetwork(doubling_litert_network(tmp_path / "n.tflite", shape), "", "cpu", 0)
    assert network.shape == (4, 6)
    assert network.dtype == "float32"
    (doubled,) = network(IMAGE).values()
    expected = 2.0 * IMAGE[None] if network.channels_last else 2.0 * IMAGE.transpose(2, 0, 1)[None]
    np.testing.assert_array_equal(doubled, expected)


@pytest.mark.parametrize(("dtype", "zero_point"), [("uint8", 0), ("int8", -128)])
def test_a_quantised_network_takes_and_gives_real_numbers(tmp_path, dtype, zero_point):
    path = doubling_litert_network(tmp_path / "n.tflite", (1, 4, 6, 3), dtype, (1 / 255, zero_point))
    network = LitertNetwork(path, "", "cpu", 0)
    assert network.dtype == "float32"
    np.testing.assert_allclose(network(IMAGE)["doubled"][0], 2 * IMAGE, atol=3 / 255)
    assert network(np.full((4, 6, 3), 7, np.float32))["doubled"].max() == pytest.approx(2)  # the largest that there is


def test_outputs_keep_their_names(tmp_path):
    rng = np.random.default_rng(2)
    outputs = {"scores": rng.random((1, 5)), "boxes": rng.random((1, 5, 4)), "last": rng.random((1, 2, 3, 4))}
    network = LitertNetwork(constant_litert_network(tmp_path / "n.tflite", (1, 8, 8, 3), outputs), "", "auto", 0)
    found = network(np.zeros((8, 8, 3), np.float32))
    assert list(found) == list(outputs)
    for name, value in outputs.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], value.astype(np.float32))


def with_metadata(path, name, text):
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, text)
    return path


def test_the_size_of_an_input_that_takes_any(tmp_path):
    path = doubling_litert_network(tmp_path / "n.tflite", (1, 1, 1, 3), signature=(1, -1, -1, 3))
    network = LitertNetwork(path, "", "cpu", 32)
    assert network.shape == (32, 32)
    assert network(np.ones((32, 32, 3), np.float32))["doubled"].shape == (1, 32, 32, 3)
    with pytest.raises(ConfigError, match=r"detector\.input_size must be given in px: .*\(1, any, any, 3\) float32"):
        LitertNetwork(path, "", "cpu", 0)
    with_metadata(path, "metadata.json", json.dumps({"imgsz": [24, 32], "batch": 1, "dynamic": True}))
    assert LitertNetwork(path, "", "cpu", 0).shape == (24, 32)


@pytest.mark.parametrize(
    ("name", "text", "names"),
    [
        ("metadata.json", '{"names": {"0": "cup", "1": "bed"}, "nms": false}', ("cup", "bed")),
        ("temp_meta.txt", "{'names': {0: 'cup', 1: 'bed'}, 'nms': False}", ("cup", "bed")),
        ("metadata.json", "[1]", ()),
        ("metadata.json", "{", ()),
        ("other.txt", "{}", ()),
    ],
)
def test_what_the_file_says_about_itself(tmp_path, name, text, names):
    path = with_metadata(doubling_litert_network(tmp_path / "n.tflite", (1, 4, 6, 3)), name, text)
    network = LitertNetwork(path, "", "cpu", 0)
    assert network.metadata.names == names
    np.testing.assert_array_equal(network(IMAGE)["doubled"][0], 2 * IMAGE)


def test_what_does_not_fit_is_said(tmp_path, monkeypatch):
    path = doubling_litert_network(tmp_path / "n.tflite", (1, 4, 6, 3))
    with pytest.raises(ConfigError, match=r"input_size must be 0 or the network's own, found 32"):
        LitertNetwork(path, "", "cpu", 32)
    with pytest.raises(ConfigError, match=r"detector\.device must be cpu or auto for a \.tflite file, found cuda"):
        LitertNetwork(path, "", "cuda", 0)
    with pytest.raises(DataError, match=r"n\.tflite has the sha256 [0-9a-f]{64}, expected 0{64}"):
        LitertNetwork(path, "0" * 64, "cpu", 0)
    with pytest.raises(DataError, match=r"detector\.weights: there is no file .*absent\.tflite"):
        LitertNetwork(tmp_path / "absent.tflite", "", "cpu", 0)
    with pytest.raises(DataError, match=r"expected one image .*, found images \(1, 4, 6, 5\) float32"):
        LitertNetwork(doubling_litert_network(tmp_path / "m.tflite", (1, 4, 6, 5)), "", "cpu", 0)
    with pytest.raises(DataError, match=r"int8 with a scale, found images \(1, 4, 6, 3\) int8"):
        LitertNetwork(doubling_litert_network(tmp_path / "m.tflite", (1, 4, 6, 3), "int8"), "", "cpu", 0)
    graph = Graph()
    both = [graph.tensor("a", (1, 4, 6, 3)), graph.tensor("b", (1, 4, 6, 3))]
    graph.node(0, both, graph.tensor("sum", (1, 4, 6, 3)))
    with pytest.raises(DataError, match=r"expected one image .*, found 2 inputs: a .*, b "):
        LitertNetwork(graph.save(tmp_path / "m.tflite", both, [2]), "", "cpu", 0)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(ConfigError, match=r"pip install instancemap\[litert\]"):
        LitertNetwork(path, "", "cpu", 0)


def test_no_network_is_refused_in_one_line(tmp_path):
    path = tmp_path / "n.tflite"
    for content in (b"", b"no network", bytes(200)):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"n\.tflite is not a \.tflite file that LiteRT can load: ") as refused:
            LitertNetwork(path, "", "cpu", 0)
        assert "\n" not in str(refused.value)


def test_numbers_that_are_not_finite_are_an_error(tmp_path):
    network = LitertNetwork(doubling_litert_network(tmp_path / "n.tflite", (1, 4, 6, 3)), "", "cpu", 0)
    with pytest.raises(DataError, match="the output doubled holds values that are not finite"):
        network(np.full((4, 6, 3), 3e38, np.float32))
