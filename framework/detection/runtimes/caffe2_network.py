"""Runtime of Caffe2 networks with 8-bit quantization.

The network is computed in integers on a CPU, or in float on any device. An integer q represents the value scale * (q -
zero_point). See Jacob et al., "Quantization and Training of Neural Networks for Efficient Integer-Arithmetic-Only
Inference", 2018. Integer convolutions use oneDNN and require an x86 processor with VNNI. On other processors, sums of
8-bit products overflow 16 bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.data import Array
from framework.detection.runtimes.caffe2_network_kernels import MAX_UINT8, round_to_bytes
from framework.errors import DataError

Operator = Mapping[str, Any]  # type, inputs (blobs, then weights), outputs (one blob), args
Tensors = Mapping[str, Tensor]  # float32; kernels are (out, in, h, w), or (in, out, h, w) in transposed convolutions
Run = Callable[..., Tensor]  # computes an operator's output from its blobs (N, C, H, W)
Window = tuple[list[int], list[int], list[int], int]  # strides, pads, dilations, groups

CONVOLUTIONS = ("Int8Conv", "Int8ConvRelu")
OPERATORS = (  # supported operators
    *CONVOLUTIONS, "Int8ConvTranspose", "Int8FC", "Int8AveragePool", "Int8Sum", "Int8Relu", "Int8Quantize",
)  # fmt: skip
MAX_WEIGHT = 127  # largest int8 weight; oneDNN requires weights symmetric about 0


class Step(NamedTuple):
    """The computation of one blob."""

    run: Run
    inputs: tuple[str, ...]  # blobs
    output: str


@dataclass(frozen=True)
class Network:
    """A network with float32 inputs and outputs."""

    steps: tuple[Step, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __call__(self, *values: Tensor) -> tuple[Tensor, ...]:
        blobs = dict(zip(self.inputs, values, strict=True))
        for step in self.steps:
            blobs[step.output] = step.run(*(blobs[name] for name in step.inputs))
        return tuple(blobs[name] for name in self.outputs)


class Quantization(NamedTuple):
    """Quantization parameters of a blob."""

    scale: float
    zero_point: int

    def quantize(self, x: Tensor) -> Tensor:
        """Quantize a tensor (N, C, H, W) on the CPU to uint8."""
        channels_last = x.permute(0, 2, 3, 1).contiguous()
        rounded = torch.empty_like(channels_last, dtype=torch.uint8)
        flat = channels_last.numpy().reshape(-1), rounded.numpy().reshape(-1)
        round_to_bytes(*flat, np.float32(1 / self.scale), np.float32(self.zero_point))
        return rounded.permute(0, 3, 1, 2)

    def dequantize(self, q: Tensor) -> Tensor:
        return (q.float() - self.zero_point) * self.scale


def dequantized_weights(values: Array, scale_zero: tuple[float, int] | None) -> Tensor:
    """Return the weights as float32, with the axis order of torch.

    Args:
        values: The stored weights. Kernels are (out, h, w, in) or (in, h, w, out).
        scale_zero: The scale and zero point; None = the weights are not quantized.
    """
    if scale_zero is None:
        return torch.from_numpy(values)
    scale, zero_point = scale_zero
    tensor = torch.from_numpy(((values.astype(np.float64) - zero_point) * scale).astype(np.float32))
    return tensor.permute(0, 3, 1, 2) if tensor.ndim == 4 else tensor  # a permuted view is already channels last


@cache
def has_int8_kernels() -> bool:
    """Return True if torch computes integer convolutions correctly on this processor."""
    has_mkldnn = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
    if not has_mkldnn or torch.backends.quantized.engine != "x86":
        return False
    channels = 16
    kernel = torch.full((1, channels, 1, 1), float(MAX_WEIGHT))
    window = [1, 1], [0, 0], [1, 1], 1
    convolve = _int8_convolution(kernel, torch.zeros(1), 1.0, window, Quantization(1.0, 0), None, False)
    found = convolve(torch.full((1, channels, 8, 8), MAX_UINT8, dtype=torch.uint8))
    return bool((found == channels * MAX_WEIGHT * MAX_UINT8).all())


def network_between(
    graph: list[Operator],
    tensors: Tensors,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    spacings: Mapping[str, float] | None = None,
) -> Network:
    """Build the part of a network that computes some blobs from others.

    In an integer network, these results are not rounded to 8 bits: linear convolutions between blocks, means, sums,
    fully connected layers, transposed convolutions, and outputs. Rounding errors of the linear convolutions would
    accumulate (Sandler et al., "MobileNetV2", 2018).

    Args:
        graph: The operators of the complete network.
        tensors: The weights by name.
        inputs: The names of the input blobs.
        outputs: The names of the output blobs.
        spacings: The quantization step of each kernel by name, for integer convolutions; None = compute in float.

    Raises:
        DataError: An operator is not supported.
    """
    operators = _between(graph, tensors, inputs, outputs)
    if spacings is None:
        steps = [Step(_in_float(one, tensors), _blobs(one, tensors), one["outputs"][0]) for one in operators]
    else:
        steps = [*_int8_steps(operators, tensors, spacings, outputs)]
    return Network(tuple(steps), inputs, outputs)


def _between(
    graph: list[Operator], tensors: Tensors, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> list[Operator]:
    """Return the operators that are required to compute `outputs` from `inputs`."""
    needed, found = set(outputs), []
    for operator in reversed(graph):
        name = operator["outputs"][0]
        if name in needed and name not in inputs:
            needed.update(_blobs(operator, tensors))
            found.append(operator)
    return found[::-1]


def _blobs(operator: Operator, tensors: Tensors) -> tuple[str, ...]:
    return tuple(name for name in operator["inputs"] if name not in tensors)


def _weights(operator: Operator, tensors: Tensors) -> tuple[Tensor, ...]:
    """Return the kernel and bias of an operator, if any."""
    return tuple(tensors[name] for name in operator["inputs"] if name in tensors)


def _in_float(operator: Operator, tensors: Tensors) -> Run:
    kind, args = operator["type"], operator["args"]
    if kind == "Int8AveragePool":
        return lambda x: functional.avg_pool2d(x, args["kernel"], args["stride"])
    if kind == "Int8Sum":
        return torch.add
    if kind == "Int8Relu":
        return torch.relu
    if kind == "Int8Quantize":
        return lambda x: x
    if kind not in OPERATORS:
        raise DataError(
            f"graph.json: expected one of the operators {', '.join(OPERATORS)}, got {kind}; use another network"
        )
    weight, bias = _weights(operator, tensors)
    if kind == "Int8FC":
        return lambda x: functional.linear(x.flatten(1), weight, bias)
    stride, pad, group = args["stride"], args["pad"], args.get("group", 1)
    if kind == "Int8ConvTranspose":
        return lambda x: functional.conv_transpose2d(x, weight, bias, stride, pad)
    if kind == "Int8Conv":
        return lambda x: functional.conv2d(x, weight, bias, stride, pad, 1, group)
    return lambda x: functional.conv2d(x, weight, bias, stride, pad, 1, group).relu_()


def _int8_steps(
    operators: list[Operator], tensors: Tensors, spacings: Mapping[str, float], outputs: tuple[str, ...]
) -> Iterator[Step]:
    quantizations = {
        operator["outputs"][0]: Quantization(operator["args"]["Y_scale"], operator["args"]["Y_zero_point"])
        for operator in operators
    }
    in_integers: set[str] = set()  # uint8 blobs; other blobs are float32
    converted: dict[str, str] = {}  # blob -> its name in the other type
    for operator in operators:
        kind, name, blobs = operator["type"], operator["outputs"][0], _blobs(operator, tensors)
        on_integers = kind in CONVOLUTIONS and name not in outputs
        for blob in blobs:
            if on_integers and blob not in quantizations:
                expected = "quantization parameters for the input of an 8-bit convolution"
                raise DataError(f"graph.json: {blob}: expected {expected}, got none")
            if blob not in converted and (blob in in_integers) != on_integers:
                converted[blob] = f"{blob}, converted"
                convert = quantizations[blob].quantize if on_integers else quantizations[blob].dequantize
                yield Step(convert, (blob,), converted[blob])
        sources = tuple(converted[blob] if (blob in in_integers) != on_integers else blob for blob in blobs)
        if not on_integers:
            yield Step(_in_float(operator, tensors), sources, name)
            continue
        args, group = operator["args"], operator["args"].get("group", 1)
        linear = kind == "Int8Conv" and group == 1
        if not linear:
            in_integers.add(name)
        kernel, bias = _weights(operator, tensors)
        window = [args["stride"]] * 2, [args["pad"]] * 2, [1, 1], group
        result = None if linear else quantizations[name]
        spacing, relu = spacings[operator["inputs"][1]], kind == "Int8ConvRelu"
        run = _int8_convolution(kernel, bias, spacing, window, quantizations[blobs[0]], result, relu)
        yield Step(run, sources, name)


def _int8_convolution(
    kernel: Tensor,
    bias: Tensor,
    spacing: float,
    window: Window,
    source: Quantization,
    result: Quantization | None,
    relu: bool,
) -> Run:
    """Return a oneDNN convolution from uint8 to uint8 or float32.

    Args:
        kernel: The kernel (out, in, h, w).
        bias: The bias (out,).
        spacing: The quantization step of the kernel. It is increased for channels that would exceed int8.
        window: The strides, pads, dilations and groups.
        source: The quantization of the input.
        result: The quantization of the output; None = float32.
        relu: True = apply a ReLU to the output.
    """
    scales = torch.clamp(kernel.abs().amax(dim=(1, 2, 3)) / MAX_WEIGHT, min=spacing)
    integers = torch.round(kernel / scales[:, None, None, None]).to(torch.int8)
    packed = torch.ops.onednn.qconv_prepack(integers, scales, *source, *window, None)
    zeros = torch.zeros(len(scales), dtype=torch.int32)
    before = *source, packed, scales, zeros, bias.contiguous(), *window
    kind: tuple[Any, ...] = (1.0, 0, torch.float32) if result is None else (*result, torch.uint8)
    after = *kind, "relu" if relu else "none", list[Any](), ""

    def convolve(q: Tensor) -> Tensor:
        found: Tensor = torch.ops.onednn.qconv2d_pointwise(q, *before, *after)
        return found

    return convolve
