"""Tests for 8-bit networks. Each operator is compared with its definition, in float and in integers."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from framework.detection.runtimes.caffe2_network import (
    Quantization,
    dequantized_weights,
    has_int8_kernels,
    network_between,
)
from framework.errors import DataError

pytestmark = pytest.mark.integration

in_integers = pytest.mark.skipif(not has_int8_kernels(), reason="torch has no 8-bit convolutions for this processor")


def quantized_values(rng, shape, zero_point=120):
    return rng.integers(0, 256, shape).astype(np.uint8), (0.01, zero_point)


def real(values, scale_zero):
    return (values.astype(np.float64) - scale_zero[1]) * scale_zero[0]


def run_one(kind, args, x_nhwc, tensors):
    """Run a single operator of a graph. Input and output are NHWC."""
    operator = {"type": kind, "inputs": ["x", *tensors], "outputs": ["y"], "args": args}
    network = network_between([operator], tensors, ("x",), ("y",))
    (y,) = network(torch.from_numpy(x_nhwc.astype(np.float32)).permute(0, 3, 1, 2))
    return y.permute(0, 2, 3, 1).numpy() if y.ndim == 4 else y.numpy()


@pytest.mark.parametrize(("stride", "pad", "group"), [(1, 1, 1), (2, 1, 1), (1, 1, 6), (2, 0, 3)])
@pytest.mark.parametrize("relu", [False, True])
def test_caffe2_convolution_matches_dequantized_window_sum(stride, pad, group, relu):
    rng = np.random.default_rng(7)
    x = rng.normal(0, 1, (1, 7, 8, 6))
    weight, weight_scale = quantized_values(rng, (6, 3, 3, 6 // group))
    bias, bias_scale = rng.integers(-200, 200, 6).astype(np.int32), (0.002, 0)
    tensors = {"w": dequantized_weights(weight, weight_scale), "b": dequantized_weights(bias, bias_scale)}
    args = {"kernel": 3, "stride": stride, "pad": pad, "group": group}
    y = run_one("Int8ConvRelu" if relu else "Int8Conv", args, x, tensors)

    padded, w = np.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0))), real(weight, weight_scale)
    for i, j, out in np.ndindex(*y.shape[1:]):
        first = out // (6 // group) * (6 // group)
        window = padded[0, i * stride : i * stride + 3, j * stride : j * stride + 3, first : first + 6 // group]
        expected = (window * w[out]).sum() + bias[out] * 0.002
        assert y[0, i, j, out] == pytest.approx(max(expected, 0) if relu else expected, abs=1e-4)


@pytest.mark.parametrize(("kernel", "pad"), [(2, 0), (4, 1)])
def test_caffe2_transposed_convolution_matches_definition(kernel, pad):
    rng = np.random.default_rng(8)
    x = rng.normal(0, 1, (1, 5, 6, 3))
    weight, scale = quantized_values(rng, (3, kernel, kernel, 4))
    tensors = {"w": dequantized_weights(weight, scale), "b": torch.zeros(4)}
    y = run_one("Int8ConvTranspose", {"kernel": kernel, "stride": 2, "pad": pad}, x, tensors)

    expected, w = np.zeros((2 * 5 + kernel, 2 * 6 + kernel, 4)), real(weight, scale)
    for i, j, ky, kx in np.ndindex(5, 6, kernel, kernel):
        expected[2 * i + ky, 2 * j + kx] += x[0, i, j] @ w[:, ky, kx]
    assert y.shape == (1, 10, 12, 4)
    np.testing.assert_allclose(y[0], expected[pad : pad + 10, pad : pad + 12], atol=1e-4)


def test_caffe2_fully_connected_mean_and_relu_match_definition():
    rng = np.random.default_rng(9)
    x = rng.normal(0, 1, (2, 3, 3, 5))
    mean = run_one("Int8AveragePool", {"kernel": 3, "stride": 1}, x, {})
    np.testing.assert_allclose(mean[:, 0, 0], x.mean(axis=(1, 2)), atol=1e-6)
    weight, scale = quantized_values(rng, (4, 5))
    tensors = {"w": dequantized_weights(weight, scale), "b": torch.ones(4)}
    np.testing.assert_allclose(
        run_one("Int8FC", {}, mean, tensors), mean[:, 0, 0] @ real(weight, scale).T + 1, atol=1e-5
    )
    np.testing.assert_allclose(run_one("Int8Relu", {}, x, {}), np.maximum(x, 0), atol=1e-6)


def test_caffe2_network_runs_only_operators_for_outputs():
    tensors = {"w": torch.ones(1, 1, 1, 1), "b": torch.zeros(1)}
    conv = {"type": "Int8Conv", "args": {"kernel": 1, "stride": 1, "pad": 0}}
    graph = [
        {**conv, "inputs": ["x", "w", "b"], "outputs": ["y"]},
        {"type": "Unknown", "inputs": ["y"], "outputs": ["elsewhere"], "args": {}},
        {"type": "Int8Sum", "inputs": ["x", "y"], "outputs": ["z"], "args": {}},
    ]
    (z,) = network_between(graph, tensors, ("x",), ("z",))(torch.full((1, 1, 2, 2), 3.0))
    assert (z == 6).all()
    with pytest.raises(DataError, match=r"graph\.json: expected one of the operators Int8Conv, .*, got Unknown; use"):
        network_between(graph, tensors, ("x",), ("elsewhere",))


# Integer arithmetic

IMAGE = {"type": "Int8Quantize", "inputs": ["image"], "outputs": ["x"], "args": {"Y_scale": 0.02, "Y_zero_point": 110}}
LAST = {  # the output is computed in float from the integers "y"
    "type": "Int8Relu", "inputs": ["y"], "outputs": ["z"], "args": {"Y_scale": 1.0, "Y_zero_point": 0}
}  # fmt: skip


def integer_network(kind, args, weight, weight_scale, bias):
    """Return a network with one quantized operator and a ReLU, and the quantization between them."""
    tensors = {"w": dequantized_weights(weight, weight_scale), "b": torch.from_numpy(bias)}
    result = Quantization(0.05, 0 if kind == "Int8ConvRelu" else 128)
    operator = {
        "type": kind, "inputs": ["x", "w", "b"], "outputs": ["y"],
        "args": {**args, "Y_scale": result.scale, "Y_zero_point": result.zero_point},
    }  # fmt: skip
    network = network_between([IMAGE, operator, LAST], tensors, ("image",), ("z",), {"w": weight_scale[0]})
    return network, result


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_caffe2_quantize_rounds_half_to_even(memory_format):
    quantization = Quantization(0.25, 100)
    steps = torch.arange(-1000, 1000).reshape(1, 5, 20, 20) / 2  # multiples of half a step, also outside of the range
    found = quantization.quantize((steps * 0.25).contiguous(memory_format=memory_format))
    assert found.dtype == torch.uint8
    np.testing.assert_array_equal(found, np.clip(np.rint(steps.numpy() + 100), 0, 255))
    uneven = torch.from_numpy(np.random.default_rng(3).normal(0, 20, (3, 7, 5, 4)).astype(np.float32))
    found = Quantization(0.0312, 7).quantize(uneven)
    np.testing.assert_array_equal(found, (uneven * (1 / 0.0312)).add(7).round().clamp(0, 255).to(torch.uint8))
    assert quantization.quantize(uneven[:0]).shape == (0, 7, 5, 4)


@in_integers
@pytest.mark.parametrize(("stride", "pad", "group"), [(1, 1, 1), (2, 1, 1), (1, 1, 6), (2, 0, 3)])
@pytest.mark.parametrize("kind", ["Int8Conv", "Int8ConvRelu"])
def test_caffe2_integer_convolution_is_exact_and_rounded_once(kind, stride, pad, group):
    rng = np.random.default_rng(11)
    image = rng.integers(0, 256, (1, 6, 7, 8))
    weight = rng.integers(20, 220, (6, 3, 3, 6 // group)).astype(np.uint8)  # within 127 of the zero point: exact
    bias = rng.normal(0, 1, 6).astype(np.float32)
    args = {"kernel": 3, "stride": stride, "pad": pad, "group": group}
    network, result = integer_network(kind, args, weight, (0.001, 120), bias)
    z = network(torch.from_numpy(((image - 110) * 0.02).astype(np.float32)))[0].numpy()

    padded = np.pad(image - 110, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
    for out, i, j in np.ndindex(*z.shape[1:]):
        first = out // (6 // group) * (6 // group)
        window = padded[0, first : first + 6 // group, i * stride : i * stride + 3, j * stride : j * stride + 3]
        y = int((window.transpose(1, 2, 0) * (weight[out].astype(int) - 120)).sum()) * 0.02 * 0.001 + bias[out]
        if kind == "Int8ConvRelu" or group > 1:  # the other results are not rounded
            y = (np.clip(np.rint(y / result.scale) + result.zero_point, 0, 255) - result.zero_point) * result.scale
        assert z[0, out, i, j] == pytest.approx(max(y, 0), abs=1e-4), (out, i, j)


@in_integers
def test_caffe2_int8_kernels_with_overflow_are_detected():
    """Without VNNI, the int8 kernels of oneDNN add products in 16 bits and can overflow."""
    asked = "from framework.detection.runtimes.caffe2_network import has_int8_kernels; print(has_int8_kernels())"
    for instructions, expected in (("AVX2", "False"), ("DEFAULT", "True")):
        environment = {**os.environ, "ONEDNN_MAX_CPU_ISA": instructions}
        answer = subprocess.run(
            [sys.executable, "-c", asked], env=environment, capture_output=True, text=True, check=True
        )
        assert answer.stdout.strip() == expected, instructions


@in_integers
def test_caffe2_int8_weight_overflow_rounds_only_its_channel():
    rng = np.random.default_rng(12)
    image = rng.integers(0, 256, (1, 4, 3, 3))
    weight = rng.integers(100, 140, (2, 1, 1, 4)).astype(np.uint8)
    weight[1, 0, 0, 0] = 255  # 155 above the zero point
    network, _ = integer_network(
        "Int8Conv", {"kernel": 1, "stride": 1, "pad": 0}, weight, (0.01, 100), np.full(2, 50, np.float32)
    )
    z = network(torch.from_numpy(((image - 110) * 0.02).astype(np.float32)))[0].numpy()[0]
    exact = np.einsum("chw,oc->ohw", image[0] - 110, weight[:, 0, 0].astype(int) - 100) * 0.0002 + 50
    np.testing.assert_allclose(z[0], exact[0], atol=1e-4)
    error = np.abs(z[1] - exact[1]).max()
    assert 1e-3 < error <= 4 * 145 * 0.02 * (155 / 127 * 0.01) / 2


@in_integers
def test_caffe2_blob_is_rounded_only_for_convolution():
    """The sum is y = x + linear(relu(linear(x)))."""
    one = {"Y_scale": 0.02, "Y_zero_point": 100}
    convolution = {"kernel": 1, "stride": 1, "pad": 0, **one}
    rectified = convolution | {"Y_zero_point": 0}
    tensors = {"w": torch.ones(1, 1, 1, 1), "b": torch.zeros(1)}
    graph = [
        {"type": "Int8Relu", "inputs": ["image"], "outputs": ["x"], "args": one},
        {"type": "Int8ConvRelu", "inputs": ["x", "w", "b"], "outputs": ["a"], "args": rectified},
        {"type": "Int8Conv", "inputs": ["a", "w", "b"], "outputs": ["c"], "args": convolution},
        {"type": "Int8Sum", "inputs": ["c", "x"], "outputs": ["y"], "args": one},
    ]  # fmt: skip
    network = network_between(graph, tensors, ("image",), ("y",), {"w": 1.0})
    x = torch.tensor([[[[0.011, 0.5, 1.2345]]]])
    np.testing.assert_allclose(network(x)[0], x + torch.round(x / 0.02) * 0.02, atol=1e-6)


@in_integers
def test_caffe2_integers_without_scale_raise():
    tensors = {"w": torch.ones(1, 1, 1, 1), "b": torch.zeros(1)}
    args = {"kernel": 1, "stride": 1, "pad": 0, "Y_scale": 0.1, "Y_zero_point": 0}
    graph = [{"type": "Int8Conv", "inputs": ["x", "w", "b"], "outputs": ["y"], "args": args}, LAST]
    with pytest.raises(DataError, match="x: expected quantization parameters for the input of an 8-bit convolution"):
        network_between(graph, tensors, ("x",), ("z",), {"w": 1.0})
