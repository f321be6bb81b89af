"""Networks that Caffe2 wrote in 8-bit integers, computed in these integers on a CPU, or in float on any device.

A number q of a blob stands for scale * (q - zero point) (Jacob et al., "Quantization and Training of Neural Networks
for Efficient Integer-Arithmetic-Only Inference", 2018). Convolutions of integers are oneDNN's, through torch; where a
processor would overflow when it adds products of 8 bits, oneDNN leaves the weights' lowest bit out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.data import Array
from framework.errors import DataError

Operator = Mapping[str, Any]  # type, inputs (blobs, then weights), outputs (one blob), args
Tensors = Mapping[str, Tensor]  # float32; kernels are (out, in, h, w), those of transposed convolutions (in, out, h, w)
Run = Callable[..., Tensor]  # from an operator's blobs (N, C, H, W) to its output

CONVOLUTIONS = ("Int8Conv", "Int8ConvRelu")
MOST_OF_WEIGHTS = 127  # of int8, which oneDNN wants to be symmetric about 0
MOST = 255  # of uint8


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
        """uint8, rounded to the nearest."""
        return (x * (1 / self.scale)).add_(self.zero_point).round_().clamp_(0, MOST).to(torch.uint8)

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


def has_int8_kernels() -> bool:
    """Whether torch computes convolutions of integers on this CPU."""
    return bool(torch.backends.mkldnn.is_available() and torch.backends.quantized.engine == "x86")


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


def int8_network(graph: list[Operator], tensors: Tensors, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Network:
    """The same in integers, as the graph has it, with two differences, both for the better.

    A convolution whose result is added to another blob is not rounded before. What leaves the network is computed in
    float from the last integers, and so are means and fully connected layers: few numbers, of which rounding would make
    different scores equal.

    Raises DataError for an operator that is not known.
    """
    return Network(tuple(_int8_steps(_between(graph, tensors, inputs, outputs), tensors, outputs)), inputs, outputs)


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


def _int8_steps(operators: list[Operator], tensors: Tensors, outputs: tuple[str, ...]) -> Iterator[Step]:
    quantisations = {
        operator["outputs"][0]: Quantisation(operator["args"]["Y_scale"], operator["args"]["Y_zero_point"])
        for operator in operators
    }
    sums = {operator["inputs"][0]: operator for operator in operators if operator["type"] == "Int8Sum"}
    convolved = {operator["outputs"][0] for operator in operators if operator["type"] == "Int8Conv"}
    for operator in operators:
        kind, args = operator["type"], operator["args"]
        name, blobs = operator["outputs"][0], _blobs(operator, tensors)
        weights = _weights(operator, tensors)
        if kind == "Int8Quantize":
            yield Step(quantisations[name].quantised, blobs, name)
        elif kind == "Int8Conv" and name in sums:
            total, (_, other) = sums[name]["outputs"][0], sums[name]["inputs"]
            convolution = Int8Convolution.of(weights, args, quantisations[blobs[0]], quantisations[total])
            yield Step(convolution.added_to(quantisations[other]), (*blobs, other), total)
        elif kind in CONVOLUTIONS and name not in outputs:
            convolution = Int8Convolution.of(weights, args, quantisations[blobs[0]], quantisations[name])
            yield Step(convolution if kind == "Int8Conv" else convolution.rectified, blobs, name)
        elif kind == "Int8ConvTranspose" and name not in outputs:
            yield Step(_transposed(weights, args, quantisations[blobs[0]], quantisations[name]), blobs, name)
        elif kind == "Int8Relu":
            yield Step(_rectified(quantisations[name]), blobs, name)
        elif kind == "Int8Sum" and operator["inputs"][0] not in convolved:
            raise DataError(f"graph.json: {name} is the sum of something else than a convolution and a blob")
        elif kind != "Int8Sum":
            run = _in_float(operator, tensors)
            yield Step(_after(run, quantisations.get(blobs[0])), blobs, name)
            quantisations.pop(name, None)
    for name in outputs:
        if name in quantisations:
            yield Step(quantisations[name].real, (name,), name)


def _after(run: Run, quantisation: Quantisation | None) -> Run:
    """`run` for a blob of integers, or for one in float."""
    return run if quantisation is None else lambda q: run(quantisation.real(q))


def _rectified(quantisation: Quantisation) -> Run:
    return lambda q: q.clamp(min=quantisation.zero_point)


@dataclass(frozen=True)
class Int8Convolution:
    """A convolution from uint8 to uint8, whose weights are rounded to int8 channel by channel."""

    weight: Tensor  # packed by oneDNN
    scales: Tensor  # (out,) float32, of the weights
    bias: Tensor  # (out,) float32
    window: tuple[list[int], list[int], list[int], int]  # strides, pads, dilations, groups
    source: Quantisation
    result: Quantisation

    @classmethod
    def of(
        cls, weights: tuple[Tensor, ...], args: Mapping[str, Any], source: Quantisation, result: Quantisation
    ) -> Int8Convolution:
        """With a kernel (out, in, h, w) and a bias (out,), both float32."""
        weight, bias = weights
        scales = weight.abs().amax(dim=(1, 2, 3)).clamp(min=torch.finfo(torch.float32).tiny) / MOST_OF_WEIGHTS
        rounded = torch.round(weight / scales[:, None, None, None]).to(torch.int8)
        window = [args["stride"]] * 2, [args["pad"]] * 2, [1, 1], args.get("group", 1)
        packed = torch.ops.onednn.qconv_prepack(rounded, scales, *source, *window, None)
        return cls(packed, scales, bias.contiguous(), window, source, result)

    def __call__(self, q: Tensor) -> Tensor:
        found: Tensor = torch.ops.onednn.qconv2d_pointwise(*self._from(q), *self.result, torch.uint8, "none", [], "")
        return found

    def rectified(self, q: Tensor) -> Tensor:
        found: Tensor = torch.ops.onednn.qconv2d_pointwise(*self._from(q), *self.result, torch.uint8, "relu", [], "")
        return found

    def added_to(self, other: Quantisation) -> Run:
        """The result plus another blob."""

        def run(q: Tensor, summand: Tensor) -> Tensor:
            total: Tensor = torch.ops.onednn.qconv2d_pointwise.binary(
                *self._from(q, summand.clone()), *self.result, torch.uint8, *other, "sum", 1.0, "none", [], ""
            )
            return total

        return run

    def _from(self, q: Tensor, *total: Tensor) -> tuple[Any, ...]:
        zeros = torch.zeros(len(self.scales), dtype=torch.int32)
        return q, *self.source, self.weight, self.scales, zeros, *total, self.bias, *self.window


def _transposed(
    weights: tuple[Tensor, ...], args: Mapping[str, Any], source: Quantisation, result: Quantisation
) -> Run:
    """A transposed convolution without overlaps: a convolution to all places of a cell, which are then spread out."""
    weight, bias = weights
    _, out, cell, _ = weight.shape
    if cell != args["stride"] or args["pad"]:
        raise DataError(f"graph.json: a transposed convolution of {cell} px and stride {args['stride']} is not known")
    each = weight.permute(1, 2, 3, 0).reshape(out * cell * cell, -1, 1, 1)
    biases = bias.repeat_interleave(cell * cell)
    convolution = Int8Convolution.of((each, biases), {"stride": 1, "pad": 0}, source, result)
    return lambda q: functional.pixel_shuffle(convolution(q), cell)
