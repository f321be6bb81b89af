"""Tests for ONNX networks, including unsupported files."""

import sys

import cv2
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from framework.detection.runtimes.onnx_network import ExportMetadata, OnnxNetwork, find_file
from framework.errors import ConfigError, DataError
from tests.support.networks.tiny_networks import constant_network, doubling_network, save


@pytest.mark.parametrize(
    ("shape", "element", "dtype"),
    [
        ((1, 3, 4, 6), TensorProto.FLOAT, np.float32),
        ((1, 4, 6, 3), TensorProto.FLOAT, np.float32),
        ((1, 4, 6, 3), TensorProto.UINT8, np.uint8),
    ],
)
def test_onnx_network_receives_unchanged_image(tmp_path, shape, element, dtype):
    network = OnnxNetwork(doubling_network(tmp_path / "n.onnx", shape, element), "", "cpu", 0)
    image = np.random.default_rng(1).integers(0, 256, (4, 6, 3)).astype(dtype)
    assert network.shape == (4, 6)
    (doubled,) = network(image).values()
    expected = 2.0 * image[None] if network.channels_last else 2.0 * image.transpose(2, 0, 1)[None]
    np.testing.assert_array_equal(doubled, expected)


def test_onnx_network_outputs_keep_names(tmp_path):
    rng = np.random.default_rng(2)
    outputs = {"scores": rng.random((1, 5)), "boxes": rng.random((1, 5, 4)), "last": rng.random((1, 2, 3, 4))}
    network = OnnxNetwork(constant_network(tmp_path / "n.onnx", (1, 3, 8, 8), outputs), "", "cpu", 0)
    found = network(np.zeros((8, 8, 3), np.float32))
    assert list(found) == list(outputs)
    for name, value in outputs.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], value.astype(np.float32))


def test_onnx_network_dynamic_input_requires_size(tmp_path):
    path = doubling_network(tmp_path / "n.onnx", (1, 3, "h", "w"))
    network = OnnxNetwork(path, "", "cpu", 32)
    assert network.shape == (32, 32)
    assert network(np.ones((32, 32, 3), np.float32))["doubled"].shape == (1, 3, 32, 32)
    with pytest.raises(
        ConfigError, match=r"detector\.input_size: expected a size in px, got 0 for .* with dynamic input size "
    ):
        OnnxNetwork(path, "", "cpu", 0)
    fixed = doubling_network(tmp_path / "f.onnx", (1, 3, 8, 8))
    with pytest.raises(
        ConfigError, match=r"detector\.input_size: expected 0 or the size of the network \(.*\), got .* for"
    ):
        OnnxNetwork(fixed, "", "cpu", 32)


def test_onnx_network_without_onnxruntime_error_names_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"pip install 'instancemap\[onnx\]'"):
        OnnxNetwork(doubling_network(tmp_path / "n.onnx", (1, 3, 8, 8)), "", "cpu", 0)


def test_onnx_network_thread_count_matches_opencv(tmp_path, monkeypatch):
    import onnxruntime

    taken = []
    start = onnxruntime.InferenceSession
    monkeypatch.setattr(
        onnxruntime, "InferenceSession", lambda p, o, **k: taken.append(o.intra_op_num_threads) or start(p, o, **k)
    )
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        OnnxNetwork(doubling_network(tmp_path / "n.onnx", (1, 3, 8, 8)), "", "cpu", 0)
    finally:
        cv2.setNumThreads(threads)
    assert taken == [1]


def test_onnx_network_cuda_unavailable_raises(tmp_path):
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("onnxruntime with CUDA is installed")
    path = doubling_network(tmp_path / "n.onnx", (1, 3, 8, 8))
    with pytest.raises(
        ConfigError, match=r"detector\.device: expected cpu or auto without onnxruntime-gpu and a GPU, got cuda"
    ):
        OnnxNetwork(path, "", "cuda", 0)


@pytest.mark.parametrize(("device", "loaded"), [("cpu", 0), ("auto", 1)])
def test_onnx_network_cuda_libraries_are_loaded_before_session(tmp_path, monkeypatch, device, loaded):
    import onnxruntime

    calls = []
    start = onnxruntime.InferenceSession
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: calls.append("libraries"))
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda p, o, **_: calls.append("session") or start(p, o))
    OnnxNetwork(doubling_network(tmp_path / "n.onnx", (1, 3, 8, 8)), "", device, 0)
    assert calls == ["libraries"] * loaded + ["session"]


def test_onnx_file_missing_or_invalid_raises(tmp_path):
    with pytest.raises(DataError, match=r"detector\.weights: expected the file .*, got none"):
        find_file(tmp_path / "absent.onnx")
    path = doubling_network(tmp_path / "n.onnx", (1, 3, 8, 8))
    with pytest.raises(DataError, match=r"n\.onnx: expected sha256 0{64}, got [0-9a-f]{64}"):
        OnnxNetwork(path, "0" * 64, "cpu", 0)
    sha256 = OnnxNetwork(path, "", "cpu", 0).sha256
    assert OnnxNetwork(path, sha256.upper(), "cpu", 0).sha256 == sha256
    path.write_bytes(b"no network")
    with pytest.raises(DataError, match=r"n\.onnx: expected an ONNX file for onnxruntime, got "):
        OnnxNetwork(path, "", "cpu", 0)


def test_onnx_network_rejected_by_onnxruntime_error_names_file(tmp_path):
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 8, 8))
    node = helper.make_node("NoSuchThing", ["images"], ["y"], domain="unknown")
    graph = helper.make_graph(
        [node], "g", [image], [helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 3, 8, 8))]
    )
    path = tmp_path / "n.onnx"
    path.write_bytes(
        helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", 13), helper.make_opsetid("unknown", 1)]
        ).SerializeToString()
    )
    with pytest.raises(DataError, match=r"n\.onnx: expected an ONNX file for onnxruntime, got ") as refused:
        OnnxNetwork(path, "", "cpu", 0)(np.zeros((8, 8, 3), np.float32))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("shape", [(1, 1, 8, 8), (2, 3, 8, 8), (1, 8, 8)])
def test_onnx_network_non_image_input_raises(tmp_path, shape):
    with pytest.raises(DataError, match="expected one image"):
        OnnxNetwork(doubling_network(tmp_path / "n.onnx", shape), "", "cpu", 0)


def test_onnx_network_input_type_unsupported_raises(tmp_path):
    path = doubling_network(tmp_path / "n.onnx", (1, 4, 4, 3), TensorProto.BOOL)
    with pytest.raises(
        DataError, match=r"one of float32, float16, uint8 as input, got images \(1, 4, 4, 3\) tensor\(bool\)"
    ):
        OnnxNetwork(path, "", "cpu", 0)


def test_onnx_network_weights_listed_as_inputs_are_ignored(tmp_path):
    """Format versions before 4 require weights to be listed as inputs."""
    image, weight = (helper.make_tensor_value_info(n, TensorProto.FLOAT, (1, 3, 4, 4)) for n in ("images", "weight"))
    path = save(
        tmp_path / "n.onnx",
        [helper.make_node("Add", ["images", "weight"], ["y"])],
        [weight, image],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 3, 4, 4))],
        [numpy_helper.from_array(np.ones((1, 3, 4, 4), np.float32), "weight")],
    )
    assert OnnxNetwork(path, "", "cpu", 0)(np.ones((4, 4, 3), np.float32))["y"].max() == 2


def test_onnx_network_damaged_file_error_is_one_line(tmp_path):
    path = constant_network(tmp_path / "n.onnx", (1, 3, 4, 4), {"y": np.zeros((2, 4))})
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [content[:n] for n in range(0, len(content) - 1, 3)]
    damaged += [rng.integers(0, 256, 64, np.uint8).tobytes() for _ in range(300)]
    refused = 0
    for part in damaged:
        path.write_bytes(part)
        try:
            OnnxNetwork(path, "", "cpu", 0)
        except DataError as error:
            assert str(error).startswith(f"{path}: expected an ONNX file for onnxruntime, got ")
            assert "\n" not in str(error)
            refused += 1
    assert refused > 0.9 * len(damaged)


def test_onnx_network_non_finite_output_raises(tmp_path):
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 4, 4))
    path = save(
        tmp_path / "n.onnx",
        [helper.make_node("Log", ["images"], ["y"])],
        [image],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 3, 4, 4))],
        [],
    )
    network = OnnxNetwork(path, "", "cpu", 0)
    network(np.ones((4, 4, 3), np.float32))
    with pytest.raises(DataError, match="expected finite values in the output y, got NaN or infinity"):
        network(np.zeros((4, 4, 3), np.float32))


def test_export_metadata_of_ultralytics_is_parsed():
    texts = {"names": "{0: 'person', 1: 'dog'}", "imgsz": "[480, 640]", "author": "Ultralytics", "stride": "32"}
    assert ExportMetadata.parse(texts) == ExportMetadata(("person", "dog"), (480, 640), "Ultralytics")
    assert ExportMetadata.parse({"names": '{"1": "dog", "0": "person"}', "imgsz": "640"}) == ExportMetadata(
        ("person", "dog"), (640, 640)
    )


OTHER = (
    "",
    "person",
    "[",
    "{0: 'a', 2: 'b'}",
    "{'x': 'a'}",
    "['a']",
    "[1, 2, 3]",
    "[0, 0]",
    "[-1, 5]",
    "{[]: 1}",
    "__import__('os')",
)


@pytest.mark.parametrize("text", OTHER)
def test_export_metadata_invalid_text_is_ignored(text):
    assert ExportMetadata.parse({"names": text, "imgsz": text}) == ExportMetadata()
