"""Reading an ONNX file's signature, against the onnx package that writes it."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from framework.detection.onnx_file import TensorType, read_signature
from framework.errors import DataError
from tests.tiny_networks import constant_network, doubling_network


def test_inputs_outputs_and_metadata(tmp_path):
    outputs = {"boxes": np.zeros((1, 7, 4)), "scores": np.zeros((1, 7))}
    path = constant_network(tmp_path / "n.onnx", (1, 3, "height", 300), outputs)
    model = onnx.load(path)
    helper.set_model_props(model, {"names": "{0: 'Stühle'}", "stride": "32"})
    signature = read_signature(path, model.SerializeToString())
    assert signature.inputs == (TensorType("images", "float32", (1, 3, 0, 300)),)
    assert signature.outputs == (
        TensorType("boxes", "float32", (1, 7, 4)),
        TensorType("scores", "float32", (1, 7)),
    )
    assert signature.metadata == {"names": "{0: 'Stühle'}", "stride": "32"}
    assert str(signature.inputs[0]) == "images (1, 3, any, 300) float32"


@pytest.mark.parametrize(
    ("element", "dtype"),
    [(TensorProto.UINT8, "uint8"), (TensorProto.FLOAT16, "float16"), (TensorProto.BOOL, "unknown")],
)
def test_dtypes(tmp_path, element, dtype):
    path = doubling_network(tmp_path / "n.onnx", (1, 4, 4, 3), element)
    assert read_signature(path, path.read_bytes()).inputs == (TensorType("images", dtype, (1, 4, 4, 3)),)


def test_weights_that_are_listed_as_inputs_are_none(tmp_path):
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3))
    weight = helper.make_tensor_value_info("weight", TensorProto.FLOAT, (1, 3))
    value = numpy_helper.from_array(np.ones((1, 3), np.float32), "weight")
    graph = helper.make_graph(
        [helper.make_node("Add", ["images", "weight"], ["y"])], "g", [weight, image], [image], [value]
    )
    content = helper.make_model(graph).SerializeToString()
    assert [tensor.name for tensor in read_signature(tmp_path, content).inputs] == ["images"]


def test_whatever_is_cut_off_or_mixed_up_it_answers_in_one_line(tmp_path):
    path = constant_network(tmp_path / "n.onnx", (1, 3, 4, 4), {"y": np.zeros((2, 4))})
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [content[:n] for n in range(0, len(content) - 1, 3)]
    damaged += [rng.integers(0, 256, 64, np.uint8).tobytes() for _ in range(300)]
    refused = 0
    for part in damaged:
        try:
            read_signature(path, part)
        except DataError as error:
            assert str(error).startswith(f"{path} is not an ONNX file or is damaged: ")
            assert "\n" not in str(error)
            refused += 1
    assert refused > 0.9 * len(damaged)
