"""Residual networks (He et al., "Deep Residual Learning", 2016) as feature extractors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

DEPTHS = {
    "resnet18": (2, 2, 2, 2),
    "resnet34": (3, 4, 6, 3),
    "resnet50": (3, 4, 6, 3),
    "resnet101": (3, 4, 23, 3),
}
WITH_BOTTLENECKS = ("resnet50", "resnet101")
EXPANSION = 4  # number of output channels per inner channel of a bottleneck


@dataclass(frozen=True)
class ResNetShape:
    """Hyperparameters of a residual network."""

    name: str = "resnet50"  # a key of DEPTHS
    width: int = 64  # number of channels of the stem; 64 in He et al. 2016
    # convolution with the stride in a bottleneck: True = first convolution (He et al., Detectron), False = second
    # convolution (torchvision, "v1.5")
    stride_in_1x1: bool = False
    norm_eps: float = 1e-5  # epsilon of the batch normalization

    @property
    def channels(self) -> tuple[int, ...]:
        """The number of output channels of each of the four levels."""
        factor = EXPANSION if self.name in WITH_BOTTLENECKS else 1
        return tuple(self.width * 2**level * factor for level in range(4))


class ResNet(nn.Module):
    """Residual network that returns the levels C2 to C5, with strides of 4, 8, 16 and 32 px."""

    def __init__(self, shape: ResNetShape) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, shape.width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(shape.width, shape.norm_eps)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = (shape.width, *shape.channels)
        self.layer1 = _layer(channels[0], channels[1], 1, DEPTHS[shape.name][0], shape)
        self.layer2 = _layer(channels[1], channels[2], 2, DEPTHS[shape.name][1], shape)
        self.layer3 = _layer(channels[2], channels[3], 2, DEPTHS[shape.name][2], shape)
        self.layer4 = _layer(channels[3], channels[4], 2, DEPTHS[shape.name][3], shape)

    def forward(self, image: Tensor) -> list[Tensor]:
        c2 = self.layer1(self.maxpool(self.relu(self.bn1(self.conv1(image)))))
        c3 = self.layer2(c2)
        c4 = self.layer3(c3)
        return [c2, c3, c4, self.layer4(c4)]


def _layer(channels: int, out: int, stride: int, blocks: int, shape: ResNetShape) -> nn.Sequential:
    return nn.Sequential(Block(channels, out, stride, shape), *(Block(out, out, 1, shape) for _ in range(blocks - 1)))


class Block(nn.Module):
    """A residual block with two 3x3 convolutions, or a bottleneck with 1x1, 3x3 and 1x1 convolutions."""

    def __init__(self, channels: int, out: int, stride: int, shape: ResNetShape) -> None:
        super().__init__()
        inner, kernels, strides = out, [3, 3], [stride, 1]
        if shape.name in WITH_BOTTLENECKS:
            inner, kernels = out // EXPANSION, [1, 3, 1]
            strides = [stride, 1, 1] if shape.stride_in_1x1 else [1, stride, 1]
        self.depth = len(kernels)
        widths = (channels, *[inner] * (self.depth - 1), out)
        for k in range(self.depth):
            convolution = nn.Conv2d(widths[k], widths[k + 1], kernels[k], strides[k], kernels[k] // 2, bias=False)
            self.add_module(f"conv{k + 1}", convolution)
            self.add_module(f"bn{k + 1}", nn.BatchNorm2d(widths[k + 1], shape.norm_eps))
        self.downsample: nn.Module | None = None
        if stride != 1 or channels != out:
            shortcut = nn.Conv2d(channels, out, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(out, shape.norm_eps))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        for k in range(1, self.depth + 1):
            x = getattr(self, f"bn{k}")(getattr(self, f"conv{k}")(x))
            if k == self.depth:
                x += shortcut
            x = functional.relu(x, inplace=True)
        return x
