"""Networks that Caffe2 wrote in 8-bit integers, computed in these integers on a CPU, or in float on any device.

A number q of a blob stands for scale * (q - zero point) (Jacob et al., "Quantization and Training of Neural Networks
for Efficient Integer-Arithmetic-Only Inference", 2018). Convolutions of integers are oneDNN's, through torch, on
x86 processors with VNNI: on others, sums of products of 8 bits overflow 16 bits.
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
from framework.detection.runtimes.quantization import MOST, round_to_bytes
from framework.errors import DataError

Operator = Mapping[str, Any]  # type, inputs (blobs, then weights), outputs (one blob), args
Tensors = Mapping[str, Tensor]  # float32; kernels are (out, in, h, w), those of transposed convolutions (in, out, h, w)
Run = Callable[..., Tensor]  # from an operator's blobs (N, C, H, W) to its output

CONVOLUTIONS = ("Int8Conv", "Int8ConvRelu")
MOST_OF_WEIGHTS = 127  # of int8, which oneDNN wants to be symmetric about 0


class Step(NamedTuple):
    """What one operator does."""

    run: Run
    inputs: tuple[str, ...]  # blobs
    output: str


@dataclass(frozen=True)
class Network:
    """The steps that compute the blobs `outputs` from the blobs `inputs`, all of which are float32."""

    steps: tuple[Step, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __call__(self, *values: Tensor) -> tuple[Tensor, ...]:
        blobs = dict(zip(self.inputs, values, strict=True))
        for step in self.steps:
            blobs[step.output] = step.run(*(blobs[name] for name in step.inputs))
        return tuple(blobs[name] for name in self.outputs)


class Quantisation(NamedTuple):
    """What the numbers of a blob stand for."""

    scale: float
    zero_point: int

    def quantised(self, x: Tensor) -> Tensor:
        """uint8, rounded to the nearest, of x (N, C, H, W) on the CPU."""
        channels_last = x.permute(0, 2, 3, 1).contiguous()
        rounded = torch.empty_like(channels_last, dtype=torch.uint8)
        flat = channels_last.numpy().reshape(-1), rounded.numpy().reshape(-1)
        round_to_bytes(*flat, np.float32(1 / self.scale), np.float32(self.zero_point))
        return rounded.permute(0, 3, 1, 2)

    def real(self, q: Tensor) -> Tensor:
        return (q.float() - self.zero_point) * self.scale


def dequantised(values: Array, scale_zero: tuple[float, int] | None) -> Tensor:
    """scale * (q - zero point) as float32, kernels from (out, h, w, in) or, transposed, (in, h, w, out) to torch's.

    Without a scale the values are numbers already.
    """
    if scale_zero is None:
        return torch.from_numpy(values)
    scale, zero_point = scale_zero
    tensor = torch.from_numpy(((values.astype(np.float64) - zero_point) * scale).astype(np.float32))
    return tensor.permute(0, 3, 1, 2) if tensor.ndim == 4 else tensor  # a permuted view is channels last already


@cache
def has_int8_kernels() -> bool:
    """Whether torch computes convolutions of integers here, and the largest numbers right."""
    has_mkldnn = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
    if not has_mkldnn or torch.backends.quantized.engine != "x86":
        return False
    channels = 16
    kernel = torch.full((1, channels, 1, 1), float(MOST_OF_WEIGHTS))
    window = [1, 1], [0, 0], [1, 1], 1
    convolution = Int8Convolution(kernel, torch.zeros(1), 1.0, window, Quantisation(1.0, 0), None, False)
    found = convolution(torch.full((1, channels, 8, 8), MOST, dtype=torch.uint8))
    return bool((found == channels * MOST_OF_WEIGHTS * MOST).all())


def float_network(
    graph: list[Operator], tensors: Tensors, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> Network:
    """The part of a graph between some blobs in float: the weights' integers as they are, and no rounding between.

    Raises DataError for an operator that is not known.
    """
    steps = [
        Step(_in_float(operator, tensors), _blobs(operator, tensors), operator["outputs"][0])
        for operator in _between(graph, tensors, inputs, outputs)
    ]
    return Network(tuple(steps), inputs, outputs)


def int8_network(
    graph: list[Operator],
    tensors: Tensors,
    spacings: Mapping[str, float],
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
) -> Network:
    """The same in integers; `spacings` has the distance between neighboring numbers of each kernel.

    As the graph has it, but for what costs little: the few linear channels from block to block (Sandler et al.,
    "MobileNetV2", 2018), whose rounding errors would add up, what leaves the network, means, fully connected layers
    and transposed convolutions are not rounded. Mask R-CNN 2Go's features are off by 0.037 of their standard deviation
    from those in float (six frames of redkitchen and replica_floor2).

    Raises DataError for an operator that is not known.
    """
    steps = _int8_steps(_between(graph, tensors, inputs, outputs), tensors, spacings, outputs)
    return Network(tuple(steps), inputs, outputs)


def _between(
    graph: list[Operator], tensors: Tensors, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> list[Operator]:
    """The operators that the outputs need, in order."""
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
    """Those of an operator that has any: kernel and bias."""
    return tuple(tensors[name] for name in operator["inputs"] if name in tensors)


def _in_float(operator: Operator, tensors: Tensors) -> Run:
    kind, args = operator["type"], operator["args"]
    weights = _weights(operator, tensors)
    if kind in CONVOLUTIONS:
        weight, bias = weights
        stride, pad, group = args["stride"], args["pad"], args.get("group", 1)
        if kind == "Int8Conv":
            return lambda x: functional.conv2d(x, weight, bias, stride, pad, 1, group)
        return lambda x: functional.conv2d(x, weight, bias, stride, pad, 1, group).relu_()
    if kind == "Int8ConvTranspose":
        weight, bias = weights
        return lambda x: functional.conv_transpose2d(x, weight, bias, args["stride"], args["pad"])
    if kind == "Int8FC":
        weight, bias = weights
        return lambda x: functional.linear(x.flatten(1), weight, bias)
    if kind == "Int8AveragePool":
        return lambda x: functional.avg_pool2d(x, args["kernel"], args["stride"])
    if kind == "Int8Sum":
        return torch.add
    if kind == "Int8Relu":
        return torch.relu
    if kind == "Int8Quantize":
        return lambda x: x
    raise DataError(f"graph.json: the operator {kind} is not known")


def _int8_steps(
    operators: list[Operator], tensors: Tensors, spacings: Mapping[str, float], outputs: tuple[str, ...]
) -> Iterator[Step]:
    quantisations = {
        operator["outputs"][0]: Quantisation(operator["args"]["Y_scale"], operator["args"]["Y_zero_point"])
        for operator in operators
    }
    in_integers: set[str] = set()  # blobs that are uint8; the others are float32
    rounded: dict[str, str] = {}  # blobs in float to their names in integers
    for operator in operators:
        kind, name, blobs = operator["type"], operator["outputs"][0], _blobs(operator, tensors)
        if kind in CONVOLUTIONS and name not in outputs:
            (blob,) = blobs
            if blob not in quantisations:
                raise DataError(f"graph.json: {blob} goes into a convolution, and its integers have no scale")
            if blob not in in_integers and blob not in rounded:
                rounded[blob] = f"{blob}, rounded"
                yield Step(quantisations[blob].quantised, blobs, rounded[blob])
            linear = kind == "Int8Conv" and operator["args"].get("group", 1) == 1
            if not linear:
                in_integers.add(name)
            spacing = spacings[operator["inputs"][1]]
            run = _in_integers(operator, tensors, spacing, quantisations[blob], None if linear else quantisations[name])
            yield Step(run, (rounded.get(blob, blob),), name)
        else:
            real = tuple(quantisations[blob].real if blob in in_integers else _same for blob in blobs)
            yield Step(_composed(_in_float(operator, tensors), real), blobs, name)


def _same(x: Tensor) -> Tensor:
    return x


def _composed(run: Run, before: tuple[Run, ...]) -> Run:
    return lambda *blobs: run(*(real(blob) for real, blob in zip(before, blobs, strict=True)))


def _in_integers(
    operator: Operator, tensors: Tensors, spacing: float, source: Quantisation, result: Quantisation | None
) -> Run:
    """A convolution from uint8 to uint8 or, without `result`, to float32; `spacing` is the kernel's."""
    args = operator["args"]
    kernel, bias = _weights(operator, tensors)
    window = [args["stride"]] * 2, [args["pad"]] * 2, [1, 1], args.get("group", 1)
    return Int8Convolution(kernel, bias, spacing, window, source, result, operator["type"] == "Int8ConvRelu")


class Int8Convolution:
    """A convolution (out, in, h, w) of integers by oneDNN."""

    def __init__(
        self,
        kernel: Tensor,
        bias: Tensor,
        spacing: float,
        window: tuple[list[int], list[int], list[int], int],  # strides, pads, dilations, groups
        source: Quantisation,
        result: Quantisation | None,
        relu: bool,
    ) -> None:
        """The kernel's integers stay as they are in all channels where they fit into int8, in 30,194 of 2Go's 30,381;
        in the others they are rounded to numbers that lie farther apart.
        """
        scales = torch.clamp(kernel.abs().amax(dim=(1, 2, 3)) / MOST_OF_WEIGHTS, min=spacing)
        integers = torch.round(kernel / scales[:, None, None, None]).to(torch.int8)
        packed = torch.ops.onednn.qconv_prepack(integers, scales, *source, *window, None)
        zeros = torch.zeros(len(scales), dtype=torch.int32)
        self._before = *source, packed, scales, zeros, bias.contiguous(), *window
        kind: tuple[Any, ...] = (1.0, 0, torch.float32) if result is None else (*result, torch.uint8)
        self._after = *kind, "relu" if relu else "none", list[Any](), ""

    def __call__(self, q: Tensor) -> Tensor:
        found: Tensor = torch.ops.onednn.qconv2d_pointwise(q, *self._before, *self._after)
        return found
